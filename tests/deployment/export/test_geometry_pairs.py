"""A hybrid's exported geometry and correction together yield the model's pose."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.identified import geometric_model, hybrid_model
from testing.models import hand_made_model, joints_around
from testing.refusals import refused

from pisigma.deployment.export.export_format import ExportRequest
from pisigma.deployment.export.geometry import GEOMETRIC, HYBRID, chosen_geometry
from pisigma.deployment.export.onnx_model import export_onnx
from pisigma.deployment.export.registry import export_format, export_model, export_names
from pisigma.files.errors import ModelError, OutputError
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

SUFFIXES = {"urdf": ".urdf", "dh": ".yaml", "mjcf": ".xml"}


@pytest.fixture(params=["kiro4", "ur10"])
def model(request, monkeypatch):
    robot = Robot.load(request.param)
    made = hybrid_model(request.param, [FourierSeries(robot, 110), GravityTorques(robot)], size=0.02)
    monkeypatch.setattr(ExportRequest, "load", lambda request: made)
    return made


def exported(form: str, geometry: str | None, folder) -> tuple[Robot, object]:
    """The robot of an exported file, and its geometry according to `--json`."""
    out = folder / f"{form}{SUFFIXES[form]}"
    done = export_model(form, ExportRequest(folder / "model", out, geometry=geometry))
    return Robot.load(out), done.facts["geometry"]


@pytest.mark.parametrize("form", ["urdf", "dh"])
def test_hybrid_geometry_and_onnx_correction_yield_the_pose_of_the_model(form, model, tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    robot, named = exported(form, HYBRID, tmp_path)
    q = joints_around(model.robot.name, 50, spread=1.0)
    session = onnxruntime.InferenceSession(export_onnx(model), providers=["CPUExecutionProvider"])
    (correction,) = session.run(["correction"], {"q": q.numpy()})
    corrected = q + torch.from_numpy(correction)
    assert named == HYBRID
    assert_close(forward_kinematics(robot, corrected), model.hybrid.forward(q), atol=1e-9)
    geometric, _ = exported(form, GEOMETRIC, tmp_path)
    off = forward_kinematics(geometric, corrected) - model.hybrid.forward(q)
    assert float(off[:, :3, 3].norm(dim=-1).max()) > 1e-6


def test_base_and_tool_of_a_correction_are_those_of_its_geometry(model):
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    base, tool = np.array([0.2, -0.1, 0.3, 0.4, 0.1, -0.2]), np.array([0.01, 0.02, 0.1, 0.0, 0.2, 0.5])
    arm = replace(model.hybrid, robot=model.hybrid.robot.with_geometry(base=base, tool=tool))
    own = replace(model, hybrid=arm)
    opened = onnxruntime.InferenceSession(export_onnx(own), providers=["CPUExecutionProvider"])
    about = opened.get_modelmeta().custom_metadata_map
    assert about["geometry"] == HYBRID
    stated = {name: np.array(json.loads(about[f"{name}_xyzrpy"])) for name in ("base", "tool")}
    rows = chosen_geometry(own, HYBRID).robot.with_geometry(base=np.zeros(6), tool=np.zeros(6))
    q = joints_around(model.robot.name, 20, spread=1.0)
    (correction,) = opened.run(["correction"], {"q": q.numpy()})
    T = forward_kinematics(rows.with_geometry(**stated), q + torch.from_numpy(correction))
    assert_close(T, own.hybrid.forward(q), atol=1e-12)


def test_base_and_tool_of_a_network_are_those_of_the_nominal_robot():
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    model = hand_made_model("kiro4")
    opened = onnxruntime.InferenceSession(export_onnx(model), providers=["CPUExecutionProvider"])
    about = opened.get_modelmeta().custom_metadata_map
    assert about["geometry"] == "nominal"
    assert_close(json.loads(about["base_xyzrpy"]), model.robot.base, atol=0.0)
    assert_close(json.loads(about["tool_xyzrpy"]), model.robot.tool, atol=0.0)


@pytest.mark.parametrize("form", ["urdf", "dh"])
@pytest.mark.parametrize("stated", [None, GEOMETRIC])
def test_the_geometric_fit_is_the_default(form, stated, model, tmp_path):
    robot, named = exported(form, stated, tmp_path)
    q = joints_around(model.robot.name, 50, spread=1.0)
    assert named == GEOMETRIC
    assert_close(forward_kinematics(robot, q), forward_kinematics(model.calibrated, q), atol=1e-9)


def test_every_file_states_its_geometry(model):
    said = {name: chosen_geometry(model, name).comments for name in (GEOMETRIC, HYBRID)}
    assert said[GEOMETRIC] != said[HYBRID]
    assert not np.array_equal(
        chosen_geometry(model, GEOMETRIC).robot.dh, chosen_geometry(model, HYBRID).robot.dh
    )


@pytest.mark.parametrize("made", [geometric_model, hand_made_model])
def test_models_without_a_correction_of_joints_have_no_hybrid_geometry(made):
    with refused(ModelError, option="--geometry", value=HYBRID):
        chosen_geometry(made("kiro4"), HYBRID)


@pytest.mark.parametrize("form", [name for name in export_names() if name not in SUFFIXES])
def test_other_formats_refuse_the_option_geometry(form, tmp_path):
    out = tmp_path / f"out{''.join(export_format(form).suffixes[:1])}"
    with refused(OutputError, option="--geometry", value=form):
        export_model(form, ExportRequest(tmp_path, out, geometry=HYBRID))
    assert not out.exists()


@pytest.mark.parametrize("form", SUFFIXES)
def test_an_unknown_geometry_is_refused(form, tmp_path):
    with refused(OutputError, option="--geometry", value="hybird"):
        export_model(form, ExportRequest(tmp_path, tmp_path / f"a{SUFFIXES[form]}", geometry="hybird"))
