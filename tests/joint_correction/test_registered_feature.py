"""A feature of a plug-in is calibrated, inverted, stored in a model folder and exported as ONNX."""

import dataclasses
import functools

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.models import no_type_checker
from testing.refusals import refused

import pisigma
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.deployment.export.onnx_model import export_onnx
from pisigma.files.errors import ModelError
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.onnx_graph import OnnxGraph
from pisigma.joint_correction.registry import FEATURES, register_feature
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.robot import Robot
from pisigma.robot.kernels.forms import FORMS, CompiledForm
from pisigma.robot.kinematics.forward import forward_kinematics

ROBOT = Robot.load("rb5")
SIZE = 4e-4


class Coupling(AbstractFeature):
    """Columns sin(q_j + q_1) and cos(q_j + q_1): gears that are driven through the first joint."""

    name = "coupling"
    group_names = ("coupling",)

    def __init__(self, robot: Robot) -> None:
        """Make two columns per joint."""
        super().__init__(robot)
        self.used = torch.ones(robot.dof, 2, dtype=torch.bool)
        self.group = torch.zeros(robot.dof, 2, dtype=torch.int64)

    def columns(self, state: JointState) -> torch.Tensor:
        """See `AbstractFeature.columns`."""
        angle = state.q + state.q[..., :1]
        return torch.stack([angle.sin(), angle.cos()], -1)

    def add_onnx(self, graph: OnnxGraph, weight: np.ndarray, q: str) -> str:
        """See `AbstractFeature.add_onnx`."""
        angle = graph.add_node("Add", q, graph.column(q, 0))
        sine, cosine = (
            graph.add_node("Mul", graph.add_node(name, angle), weight[:, k])
            for k, name in enumerate(("Sin", "Cos"))
        )
        return graph.add_node("Add", sine, cosine)


@pytest.fixture(autouse=True)
def _registered(monkeypatch):
    """The feature, registered for one test."""
    monkeypatch.setitem(FEATURES, "coupling", Coupling)


def true_poses(q: torch.Tensor) -> torch.Tensor:
    return forward_kinematics(ROBOT, q + SIZE * torch.sin(q + q[:, :1]))


@functools.cache
def model() -> CalibratedModel:
    rng = np.random.default_rng(0)
    q = torch.from_numpy(rng.uniform(-2.5, 2.5, (60, 6)))
    with no_type_checker():
        position = true_poses(q)[:, :3, 3] + 1e-5 * torch.from_numpy(rng.normal(size=(60, 3)))
        rows = Measurements(q=q, position=position)
        result = HybridCalibrator(ROBOT, features=("coupling",), products=False).fit(rows)
        assert result.learned is not None
        return model_of_hybrid("coupled", ROBOT, result, rows)


def test_the_evidence_finds_its_weights():
    arm = model().hybrid
    assert arm is not None
    assert [feature.name for feature in arm.correction.features] == ["coupling"]
    # The last joint rotates the tool about itself, and constants of the first joints are base and offsets.
    assert_close(arm.correction.linear[0][1:5, 0], torch.full((4,), SIZE).double(), atol=5e-5)


def test_inverse_kinematics_uses_it_through_torch(tmp_path):
    save_model(model(), tmp_path)
    ik = pisigma.load(tmp_path)
    q = torch.from_numpy(np.random.default_rng(5).uniform(-1.5, 1.5, (5, 6)))
    with no_type_checker():
        T = true_poses(q)
        solution = ik(T, near=q)
        assert_close(true_poses(solution.q)[:, :3, 3], T[:, :3, 3], atol=5e-5)
        assert_close(ik.model.forward(solution.q), T, atol=1e-9)
        assert bool((solution.q - q).abs().max() > 1e-5)


def test_a_folder_restores_it(tmp_path):
    save_model(model(), tmp_path)
    again = load_model(tmp_path)
    q = torch.linspace(-1, 1, 12).double().reshape(2, 6)
    with no_type_checker():
        assert_close(again.forward(q), model().forward(q), atol=0)
    del FEATURES["coupling"]
    with refused(ModelError, file="model.yaml", value="coupling"):
        load_model(tmp_path)


def test_the_onnx_graph_agrees_with_the_model():
    pytest.importorskip("onnx")
    runtime = pytest.importorskip("onnxruntime")
    q = torch.linspace(-2, 2, 18).double().reshape(3, 6)
    session = runtime.InferenceSession(export_onnx(model()), providers=["CPUExecutionProvider"])
    (delta,) = session.run(["correction"], {"q": q.numpy()})
    assert_close(torch.from_numpy(delta), model().hybrid.correction(q), atol=1e-15)


def test_a_name_is_registered_once():
    with pytest.raises(ValueError, match="'coupling'"):
        register_feature(dataclasses.make_dataclass("Other", [], bases=(Coupling,)))


def test_a_compiled_form_is_registered_with_the_kernels(monkeypatch):
    monkeypatch.setattr(Coupling, "compiled", CompiledForm(lambda arms, correction, first, memory, q: None))
    monkeypatch.setitem(FORMS, "coupling", None)
    assert register_feature(Coupling) is Coupling
    assert FORMS["coupling"] is Coupling.compiled
