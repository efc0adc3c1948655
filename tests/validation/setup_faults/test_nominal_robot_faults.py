"""Setup faults of a simulated robot are found with the nominal robot, and healthy rows have none."""

import numpy as np
import pytest
import torch
from hostile.mistakes import POSES, POSITIONS
from scipy.spatial.transform import Rotation
from testing.closeness import assert_close
from testing.simulated_arm import simulate

from pisigma.robot.frame_fits import MeasuredPoses, affine_squared_error, best_base_and_tool
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.validation.setup_faults.explanations import other_conventions
from pisigma.validation.setup_faults.nominal_robot_faults import (
    are_positions_unrelated,
    find_nominal_robot_faults,
    prior_rms_position_error,
)

pytestmark = pytest.mark.usefixtures("without_type_checker")
MISTAKES = {mistake.name: mistake for mistake in (*POSITIONS, *POSES)}


@pytest.fixture(scope="module")
def arm():
    """A UR5 with errors of the usual size, and 60 poses of it."""
    return simulate("ur5", rows=60, noise=5e-5, turn_noise=1e-4)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("sign of q4", "joint_sign"),
        ("q3 logged as q3 +1 q2", "joint_coupling"),
        ("gradians named degrees", "joint_unit"),
        ("joint 5 logged constant", "joint_values"),
        ("a row lost half-way", "rows"),
        ("inches named mm", "position_unit"),
        ("sign of y, not of rotations", "handedness"),
        ("quaternion conjugated", "rotation"),
    ],
)
def test_faults_are_named(arm, name, kind):
    (fault,) = find_nominal_robot_faults(arm.nominal, MISTAKES[name].change(arm.measurements, arm.nominal))
    assert fault.kinds == (kind,)
    assert fault.rms_after < 3 * prior_rms_position_error(arm.nominal, arm.measurements.q) < fault.rms_before
    assert fault.explains_orientation == (kind not in ("position_unit",))


def test_healthy_and_unrelated_rows_have_no_fault(arm):
    rows = arm.measurements
    assert find_nominal_robot_faults(arm.nominal, rows) == ()
    assert not are_positions_unrelated(arm.nominal, rows)
    mixed = MISTAKES["rows in another order"].change(rows, arm.nominal)
    assert find_nominal_robot_faults(arm.nominal, mixed) == ()
    assert are_positions_unrelated(arm.nominal, mixed)


def test_no_rigid_base_and_tool_leave_less_than_affine_ones(arm):
    measured = MeasuredPoses.from_tensors(arm.measurements.position, arm.measurements.rotation, 0.2)
    T = forward_kinematics(arm.nominal, arm.measurements.q)
    base, tool = best_base_and_tool(T, measured)
    rigid = measured.squared_errors(base @ T @ tool).mean()
    assert (1 - 13 / len(T)) * affine_squared_error(T, measured) < rigid
    batch = torch.stack([T, T.flip(0)])
    assert_close(affine_squared_error(batch, measured)[0], affine_squared_error(T, measured), atol=1e-12)
    assert_close(best_base_and_tool(batch, measured)[0][0], base, atol=1e-6)


def test_conventions_give_the_rotations_back(arm):
    """Rotations written in another convention are recovered by exactly one of the conventions that are tried."""
    R = Rotation.from_matrix(arm.measurements.rotation.numpy())
    written = (
        Rotation.from_quat(np.roll(R.as_quat(), 1, 1)),  # scalar part first
        R.inv(),
        Rotation.from_euler("ZYX", R.as_euler("XYZ")),
        Rotation.from_euler("ZYX", R.as_euler("ZYX") * [1, -1, 1]),
    )
    for read in written:
        tried = other_conventions(torch.from_numpy(read.as_matrix()))
        off = [float((rotation - arm.measurements.rotation).abs().max()) for rotation, _, _ in tried]
        assert sum(one < 1e-12 for one in off) == 1
