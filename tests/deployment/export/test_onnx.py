"""The ONNX graph has the outputs of the model, and describes its inputs and outputs."""

import json
import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.identified import geometric_model, hybrid_model
from testing.models import hand_made_model, joints_around, with_limits
from testing.refusals import refused

from pisigma.deployment.export.onnx_model import FORWARD, INVERSE, export_onnx
from pisigma.files.errors import MissingExtraError, ModelError
from pisigma.joint_correction.conditions import ConditionFeatures
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gear_lines import GearLines
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.shared_features import NominalPose, ScaledJoints, SinesCosines
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import transform_from_xyz_zyx

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")

POSE_INPUTS = ("x", "y", "z", "roll", "pitch", "yaw", "theta_1", "cos(3*theta_2)", "sin(theta_2 - theta_1)")
RIGHT = math.pi / 2


def session(content: bytes):
    return onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])


def run(content: bytes, **inputs: torch.Tensor) -> dict[str, np.ndarray]:
    opened = session(content)
    names = [output.name for output in opened.get_outputs()]
    given = {name: values.numpy() for name, values in inputs.items()}
    return dict(zip(names, opened.run(None, given), strict=True))


def everywhere(robot: Robot, rows: int) -> torch.Tensor:
    """Joint values over more than two turns, including 0 and quarter turns."""
    generator = torch.Generator().manual_seed(rows)
    q = 14 * torch.rand(rows, robot.dof, generator=generator, dtype=torch.float64) - 7
    if rows > 10:
        q[0], q[1], q[2], q[3] = 0.0, RIGHT, -math.pi, 2 * math.pi
    return q


def inverse_inputs(model, rows: int) -> dict[str, torch.Tensor]:
    q = everywhere(model.robot, rows)
    T = forward_kinematics(model.robot, q)
    return {"q_nominal": q, "T_base_tool": T}


@pytest.mark.parametrize("rows", [0, 1, 1000])
@pytest.mark.parametrize(
    ("name", "inputs"), [("kiro3", None), ("kiro4", None), ("ur10", None), ("kiro3", POSE_INPUTS)]
)
def test_corrections_of_nominal_joint_values_are_those_of_the_network(name, inputs, rows):
    model = hand_made_model(name, inputs=inputs)
    given = inverse_inputs(model, rows)
    expected = model.correction(given["T_base_tool"], given["q_nominal"])
    if inputs is None:
        del given["T_base_tool"]
    found = run(export_onnx(model), **given)
    assert_close(found["correction"], expected, atol=1e-12)
    assert_close(found["q_corrected"], given["q_nominal"] + expected, atol=1e-12)
    assert rows == 0 or float(expected.abs().max()) > 1e-3


def test_joints_without_correction_are_unchanged():
    model = hand_made_model("kiro3")
    group, network = model.network.members()[0]
    network = type(network)(network.inputs, 1, (2,))
    network.initialise(0.3, torch.Generator().manual_seed(3))
    one = type(model.network)(4, [replace(group, joints=(2,))], [network]).requires_grad_(False)
    given = inverse_inputs(model, 30)
    found = run(export_onnx(replace(model, network=one)), q_nominal=given["q_nominal"])
    assert_close(found["correction"], one(given["T_base_tool"], given["q_nominal"]), atol=1e-12)
    assert not found["correction"][:, [0, 1, 3]].any()


@pytest.mark.parametrize("pitch", [0.0, 0.3, RIGHT, -RIGHT, RIGHT - 1e-13, RIGHT - 1e-7])
def test_angles_of_a_pose_at_branch_cuts(pitch):
    """Roll and yaw at and near multiples of a quarter turn, where the arc functions have branch cuts."""
    model = hand_made_model("kiro3", inputs=POSE_INPUTS, scale=0.3)
    quarters = torch.arange(-4, 5, dtype=torch.float64) * math.pi / 4
    near = torch.cat([quarters, quarters + 1e-9, quarters - 1e-9])
    roll, yaw = (part.flatten() for part in torch.meshgrid(near, near, indexing="ij"))
    zero = torch.zeros_like(roll)
    T = transform_from_xyz_zyx(torch.stack([zero, zero + 0.2, zero, roll, zero + pitch, yaw], -1))
    q = zero[:, None].expand(-1, 4)
    found = run(export_onnx(model), q_nominal=q, T_base_tool=T)
    assert_close(found["correction"], model.correction(T, q), atol=1e-12)


def features_of(robot: Robot, names: str):
    made = {
        "series": lambda: FourierSeries(robot, 110),
        "lines": lambda: GearLines(robot, [(300, 2_020), *[()] * (robot.dof - 2), (101,)]),
        "gravity": lambda: GravityTorques(robot, (0.1, -0.3, -1.0)),
        "joints": lambda: ScaledJoints(robot),
        "sin_cos": lambda: SinesCosines(robot),
        "pose": lambda: NominalPose(robot),
        "conditions": lambda: ConditionFeatures(
            robot, ("payload_kg", "temperature_c"), (2.0, 20.0), (1.0, 3.0), ((0.0, 4.0), (15.0, 26.0))
        ),
    }
    return [made[name]() for name in names.split()]


@pytest.mark.parametrize("rows", [0, 1, 1000])
@pytest.mark.parametrize(
    "names", ["series gravity", "gravity conditions", "lines joints", "sin_cos", "pose", ""]
)
@pytest.mark.parametrize("name", ["kiro3", "kiro4", "ur10"])
def test_the_correction_of_a_hybrid_is_that_of_the_model(name, names, rows):
    robot = with_limits(Robot.load(name), 0, -2.0, 2.5)
    model = hybrid_model(name, features_of(robot, names), orders=(2, 3), robot=robot, size=0.02)
    q = everywhere(robot, rows)
    q[rows // 2 :] = joints_around(name, rows - rows // 2, spread=1.0)
    if names == "pose":
        q += 0.01  # where an angle of the pose is half a turn, its sign is a matter of rounding
    delta, found = model.hybrid.correction(q), run(export_onnx(model), q=q)
    assert_close(found["correction"], delta, atol=1e-12)
    beyond = model.hybrid.coverage.distance_outside(q).amax(-1, keepdim=True)
    assert_close(found["beyond_measured"], beyond, atol=1e-12)
    assert rows < 2 or float(delta.abs().max()) > 1e-3
    assert rows < 2 or float(beyond.max()) > 0.1


def test_reversed_joints_carry_their_masses():
    robot = Robot.load("ur10")
    rows = tuple(replace(row, direction=-1) if i in (1, 4) else row for i, row in enumerate(robot.rows))
    robot = replace(robot, rows=rows)
    model = hybrid_model("ur10", [GravityTorques(robot)], robot=robot)
    q = everywhere(robot, 50)
    assert_close(run(export_onnx(model), q=q)["correction"], model.hybrid.correction(q), atol=1e-12)


@pytest.mark.parametrize("kind", [INVERSE, FORWARD])
def test_the_file_describes_its_numbers(kind):
    forward = kind == FORWARD
    model = (
        hybrid_model("kiro3", features_of(Robot.load("kiro3"), "series conditions"))
        if forward
        else hand_made_model("kiro3", inputs=POSE_INPUTS)
    )
    content = export_onnx(model, "0123")
    opened = session(content)
    about = opened.get_modelmeta().custom_metadata_map
    assert (about["model"], about["model_yaml_sha256"], about["computes"]) == (model.name, "0123", kind)
    assert json.loads(about["joints"]) == [joint.name for joint in model.robot.joints]
    assert json.loads(about["joint_units"]) == ["rad", "rad", "m", "rad"]
    domain = json.loads(about["domain"])
    assert_close(domain["q_lower"], model.starts.amin(0))
    assert ("measured" in domain) == ("usual_conditions" in about) == forward
    graph = onnx.load_from_string(content).graph
    described = {value.name: value.doc_string for value in (*graph.input, *graph.output)}
    assert all(
        "[rad or m]" in text
        for name, text in described.items()
        if name not in ("T_base_tool", "beyond_measured")
    )
    assert {value.type for value in opened.get_inputs()} == {"tensor(double)"}
    assert {value.shape[0] for value in (*opened.get_inputs(), *opened.get_outputs())} == {"batch"}


def test_the_file_is_reproducible():
    assert export_onnx(hand_made_model("kiro4")) == export_onnx(hand_made_model("kiro4"))


def test_a_model_without_a_network_is_refused():
    with refused(ModelError, value=geometric_model("kiro4").kind):
        export_onnx(geometric_model("kiro4"))


def test_without_onnx_the_message_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(MissingExtraError, match=r'`pip install "pisigma\[onnx\]"`'):
        export_onnx(hand_made_model("kiro4"))
