"""Named inputs are computed correctly, and invalid names are rejected with the nearest valid one."""

import math

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import RecipeError
from pisigma.network.correction_network import CorrectionNetwork, JointGroup
from pisigma.network.inputs import Inputs
from pisigma.network.pi_sigma import PiSigma
from pisigma.robot import Robot, Row
from pisigma.robot.se3 import transform_from_xyz_zyx

Q = torch.tensor([0.3, -1.2, 0.7, 2.0, -0.4, 1.1], dtype=torch.float64)
POSE = torch.tensor([0.1, -0.2, 0.3, 0.4, -0.5, 0.6], dtype=torch.float64)

VALUES = {
    "x": 0.1,
    "y": -0.2,
    "z": 0.3,
    "roll": 0.4,
    "pitch": -0.5,
    "yaw": 0.6,
    "theta_4": 2.0,
    "sin(theta_1)": math.sin(0.3),
    "cos(theta_2)": math.cos(-1.2),
    "cos(theta_2 + theta_3)": math.cos(-0.5),
    "sin(theta_5-theta_4)": math.sin(-2.4),
    "sin(-theta_1 + theta_6)": math.sin(0.8),
    "sin( theta_1+theta_1 )": math.sin(0.6),
    "sin(3*theta_1 - 2 * theta_2)": math.sin(3.3),
}


@pytest.fixture(scope="module")
def ur10() -> Robot:
    return Robot.load("ur10")


def test_values_by_hand(ur10):
    inputs = Inputs.from_names(ur10, list(VALUES))
    expected = torch.tensor(list(VALUES.values()), dtype=torch.float64)
    assert_close(inputs(transform_from_xyz_zyx(POSE), Q), expected, atol=1e-15)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (0,)])
def test_batch_shapes_and_dtypes(ur10, batch, dtype):
    inputs = Inputs.from_names(ur10, ["x", "yaw", "sin(theta_1 + theta_2)"])
    values = inputs(
        transform_from_xyz_zyx(POSE).to(dtype).expand(*batch, 4, 4), Q.to(dtype).expand(*batch, 6)
    )
    assert values.shape == (*batch, 3)
    assert values.dtype == dtype


def test_angles_are_relative_to_the_reference(ur10):
    reference = np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])
    T = transform_from_xyz_zyx(POSE)
    T[:3, :3] = torch.from_numpy(reference) @ T[:3, :3]
    values = Inputs.from_names(ur10, ["roll", "pitch", "yaw"], reference)(T, Q)
    assert_close(values, POSE[3:], atol=1e-15)


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("sin(theta_7)", "did you mean 'sin(theta_"),
        ("tan(theta_1)", "(theta_1)'?"),
        ("rol", "did you mean 'roll'"),
        ("theta1", "did you mean 'theta_1'"),
        ("sin(theta_1 theta_2)", ""),
        ("sin(theta_1 +)", ""),
        ("sin(theta_1 ++ theta_2)", ""),
        ("sin(0*theta_1)", ""),
        ("sin(1.5*theta_1)", ""),
        ("sin(2 theta_1)", ""),
        ("sin(2*)", ""),
        ("sin()", ""),
        ("sin(+)", ""),
        ("", ""),
    ],
)
def test_unknown_names_are_rejected(ur10, name, nearest):
    with refused(RecipeError, value=name) as caught:
        Inputs.from_names(ur10, [name])
    assert nearest in caught.value.remedy


@pytest.mark.parametrize(
    "names",
    [["x", "x"], ["sin(theta_1)", "sin( theta_1 )"], ["cos(theta_1 + theta_2)", "cos(theta_2+theta_1)"]],
)
def test_duplicate_inputs_are_rejected(ur10, names):
    with refused(RecipeError, value=names[1], expected=""):
        Inputs.from_names(ur10, names)


def test_sines_of_lengths_and_constants_are_rejected(ur10):
    with refused(RecipeError, expected="a revolute joint", value="sin(theta_1 + d_3)"):
        Inputs.from_names(Robot.load("kiro3"), ["sin(theta_1 + d_3)"])
    with refused(RecipeError, expected="a variable angle", value="cos(theta_1 - theta_1)"):
        Inputs.from_names(ur10, ["cos(theta_1 - theta_1)"])
    assert Inputs.from_names(Robot.load("kiro3"), ["d_3"]).names == ("d_3",)


def test_a_joint_named_like_a_coordinate_is_not_confused_with_it():
    gantry = Robot("gantry", "", "", (Row("x", "prismatic"), Row("a-1", "revolute")), np.zeros((2, 5)))
    with refused(RecipeError, value="x", remedy="rename the joint"):
        Inputs.from_names(gantry, ["x"])
    q = torch.tensor([0.5, 0.25], dtype=torch.float64)
    T = torch.eye(4, dtype=torch.float64)
    assert_close(Inputs.from_names(gantry, ["sin(a-1)", "y"])(T, q)[0], math.sin(0.25), atol=1e-16)


def test_only_joints_in_groups_are_corrected(ur10, generator):
    groups, networks = [], []
    for joints, names in (((4, 0), ("x", "y")), ((2,), ("sin(theta_1)",))):
        groups.append(JointGroup(joints, Inputs.from_names(ur10, names)))
        networks.append(PiSigma(len(names), len(joints), (2,)))
        networks[-1].initialise(0.3, generator)
    network = CorrectionNetwork(6, groups, networks)
    T = transform_from_xyz_zyx(POSE).expand(3, 4, 4)
    correction = network(T, Q.expand(3, 6))
    first, second = networks[0](groups[0].inputs(T, Q.expand(3, 6))), networks[1](Q[:1].sin().expand(3, 1))
    assert_close(correction[:, [4, 0]], first, rtol=1e-14)
    assert_close(correction[:, [2]], second, rtol=1e-14)
    assert_close(correction[:, [1, 3, 5]], torch.zeros(3, 3, dtype=torch.float64), atol=0)
    assert network.scaled_inputs(T, Q.expand(3, 6)).shape == (3, 3)


def test_inconsistent_groups_are_rejected(ur10):
    group = JointGroup((0, 1), Inputs.from_names(ur10, ["x"]))
    with pytest.raises(ValueError, match=r"\[0, 1, 0, 1\]"):
        CorrectionNetwork(6, [group, group], [PiSigma(1, 2, (1,))] * 2)
    with pytest.raises(ValueError, match="2 outputs and 1 inputs"):
        CorrectionNetwork(6, [group], [PiSigma(2, 2, (1,))])
