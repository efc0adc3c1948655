"""Setup faults are recognised by name, and never on good data."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from testing.calibrated_ur5 import NOISE, calibrated_ur5, measured
from testing.closeness import assert_close
from testing.hybrid import hybrid_of, joints_in
from testing.models import no_type_checker

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import nominal_poses_of_rows, poses_of_rows
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.robot.se3 import transform_from_xyz_zyx
from pisigma.validation.held_out.reference_models import nominal_model
from pisigma.validation.setup_faults.setup_fault import SetupFault
from pisigma.validation.setup_faults.setup_faults import find_setup_faults

pytestmark = pytest.mark.usefixtures("without_type_checker")

ROWS = 50
FRAME = transform_from_xyz_zyx(torch.tensor([0.3, -0.2, 0.1, 0.5, 0.2, -0.3], dtype=torch.float64))
TOOL = transform_from_xyz_zyx(torch.tensor([0.03, -0.02, 0.05, 0.2, 0.1, 0.0], dtype=torch.float64))


@pytest.fixture(scope="module")
def geometric():
    """The geometric calibration of a simulated UR5, and new measurements of it: positions, and poses."""
    model, q, T = calibrated_ur5(ROWS)
    with no_type_checker():
        return model, measured(q, T, False), measured(q, T, True)


@pytest.fixture(scope="module")
def hybrid():
    """The hybrid calibration of a simulated kiro4, and new positions of it."""
    arm = hybrid_of("kiro4", share=0.5)
    with no_type_checker():
        model = model_of_hybrid("kiro4", arm.true.nominal, arm.result, arm.measurements)
        q = joints_in(arm.true.nominal, ROWS, seed=5, share=0.5)
        return model, measured(q, arm.true.forward(q), False)


def joints(rows: Measurements, factor=1.0, offset=0.0, order=None) -> Measurements:
    """The rows with other joint values in the log."""
    q = rows.q if order is None else rows.q[:, order]
    return replace(rows, q=q * torch.as_tensor(factor) + torch.as_tensor(offset).double())


def moved(rows: Measurements, T_measured, X, Y) -> Measurements:
    """The rows as seen from another frame X, and of another tool Y."""
    T = X @ T_measured @ Y
    noise = (rows.position - T_measured[:, :3, 3]) @ X[:3, :3].T
    rotation = None if rows.rotation is None else T[:, :3, :3]
    return replace(rows, position=T[:, :3, 3] + noise, rotation=rotation)


EYE = torch.eye(4, dtype=torch.float64)
QUARTER = torch.pi / 2
FAULTS = {
    "frame": (
        lambda rows, T: moved(rows, T, FRAME, EYE),
        ("frame",),
        {"cause_amounts": [0.680]},
    ),
    "tool": (
        lambda rows, T: moved(rows, T, EYE, TOOL),
        ("tool",),
        {"cause_amounts": [0.0616]},
    ),
    "frame and tool": (
        lambda rows, T: moved(rows, T, FRAME, TOOL),
        ("frame", "tool"),
        {},
    ),
    "mm named m": (
        lambda rows, T: replace(rows, position=rows.position * 1e3),
        ("position_unit",),
        {"cause_amounts": [1e-3]},
    ),
    "radians named degrees": (
        lambda rows, T: joints(rows, torch.pi / 180),
        ("joint_unit",),
        {"joints": (0, 1, 2, 3, 4, 5), "cause_amounts": [180 / torch.pi]},
    ),
    "another order": (
        lambda rows, T: joints(rows, order=[2, 0, 1, 3, 4, 5]),
        ("joint_order",),
        {"joints": (0, 1, 2)},
    ),
    "a sign": (
        lambda rows, T: joints(rows, [1, 1, -1.0, 1, 1, 1]),
        ("joint_sign",),
        {"joints": (2,)},
    ),
    "two signs": (
        lambda rows, T: joints(rows, [1, -1.0, 1, -1, 1, 1]),
        ("joint_sign",),
        {"joints": (1, 3)},
    ),
    "a quarter turn": (
        lambda rows, T: joints(rows, offset=[0, QUARTER, 0, 0, 0, 0]),
        ("joint_zero",),
        {"joints": (1,), "moved": torch.pi / 2},
    ),
    "half a turn": (
        lambda rows, T: joints(rows, offset=[0, 0, torch.pi, 0, 0, 0]),
        ("joint_zero",),
        {"joints": (2,), "moved": torch.pi},
    ),
    "two quarter turns": (
        lambda rows, T: joints(rows, offset=[0, -QUARTER, 0, QUARTER, 0, 0]),
        ("joint_zero",),
        {"joints": (1, 3), "moved": torch.pi / 2},
    ),
    "any zero": (
        lambda rows, T: joints(rows, offset=[0, 0, 0.2, 0, 0, 0]),
        ("joint_zero",),
        {"joints": (2,), "moved": 0.2},
    ),
    "a sign, from elsewhere": (
        lambda rows, T: joints(moved(rows, T, FRAME, EYE), [1, 1, -1.0, 1, 1, 1]),
        ("joint_sign", "frame"),
        {"joints": (2,)},
    ),
}
"""By name: how good measurements are spoilt, and kinds and fields of the fault that is to be found."""
IN_POSES = ("frame and tool", "a sign")


def assert_fault(fault: SetupFault, kinds: tuple[str, ...], fields: dict[str, Any]) -> None:
    """Assert kinds, joints, motion of zeros and amounts of a fault."""
    assert fault.kinds == kinds
    assert fault.joints == fields.get("joints", ())
    if "moved" in fields:
        assert_close(fault.largest_zero_shift, fields["moved"], atol=1e-3)
    if "cause_amounts" in fields:
        assert_close(fault.cause_amounts, fields["cause_amounts"], rtol=1e-3)


@pytest.mark.parametrize("name", sorted(set(FAULTS) - set(IN_POSES)))
def test_faults_are_recognised(geometric, name):
    model, rows, _ = geometric
    spoil, kinds, fields = FAULTS[name]
    (setup_fault,) = find_setup_faults(
        model, nominal_model(model, False), spoil(rows, poses_of_rows(model, rows))
    )
    assert_fault(setup_fault, kinds, fields)
    assert setup_fault.rms_before > 20 * setup_fault.rms_after
    assert_close(setup_fault.rms_after, NOISE * 3**0.5, rtol=0.3)
    assert setup_fault.nominal_rms_after > 3 * setup_fault.rms_after


@pytest.mark.parametrize("name", IN_POSES)
def test_faults_are_recognised_in_poses(geometric, name):
    model, _, rows = geometric
    spoil, kinds, fields = FAULTS[name]
    (setup_fault,) = find_setup_faults(model, model, spoil(rows, poses_of_rows(model, rows)))
    assert_fault(setup_fault, kinds, fields)
    assert setup_fault.rotation_rms_after < 1e-3 < setup_fault.rotation_rms_before
    assert {"before_rms_deg", "after_rms_deg"} <= set(setup_fault.to_json())


def test_a_zero_that_only_orientations_show(geometric):
    model, _, rows = geometric
    (setup_fault,) = find_setup_faults(model, model, joints(rows, offset=[0, 0, 0, 0, 0, torch.pi]))
    assert_fault(setup_fault, ("joint_zero",), {"joints": (5,), "moved": torch.pi})


@pytest.mark.parametrize("name", ["tool", "a sign, from elsewhere"])
def test_faults_are_recognised_by_a_hybrid(hybrid, name):
    model, rows = hybrid
    spoil, kinds, _ = FAULTS[name]
    spoilt = spoil(rows, poses_of_rows(model, rows))
    assert kinds in [fault.kinds for fault in find_setup_faults(model, nominal_model(model, False), spoilt)]


def test_good_data_have_no_fault(geometric, hybrid):
    for model, rows in (geometric[:2], geometric[::2], hybrid):
        assert find_setup_faults(model, model, rows) == ()


@pytest.mark.parametrize("fixture", ["geometric", "hybrid"])
def test_the_nominal_robot_is_recognised(request, fixture):
    model, rows = request.getfixturevalue(fixture)[:2]
    rows = measured(rows.q, nominal_poses_of_rows(model, rows), False)
    (setup_fault,) = find_setup_faults(model, nominal_model(model, False), rows)
    assert_fault(setup_fault, ("correction",), {"cause_amounts": [1.0]})
    assert "after_nominal_rms_mm" not in setup_fault.to_json()


def test_corrected_values_in_the_log_of_uncorrected_moves(geometric):
    """The log holds what corrects a pose, the robot was sent to the nominal joint values."""
    model, rows, _ = geometric
    T_nominal = nominal_poses_of_rows(model, rows)
    logged = rows.q.clone()
    for _ in range(4):  # the joint values at which the model is where the nominal robot is at rows.q
        T = poses_of_rows(model, replace(rows, q=logged))
        logged = logged + pose_steps(model, rows, logged, T, T_nominal)
    off = (poses_of_rows(model, replace(rows, q=logged)) - T_nominal).abs().amax((1, 2))
    regular = (off < 1e-6) & (
        (logged - rows.q).abs().amax(1) < 0.02
    )  # near singular poses corrections are large
    assert int(regular.sum()) > ROWS / 2
    T = poses_of_rows(model, rows)
    (setup_fault,) = find_setup_faults(model, model, measured(logged[regular], T[regular], False))
    assert_fault(setup_fault, ("correction",), {"cause_amounts": [-1.0]})


def pose_steps(model, rows, q, T, T_wanted):
    """Newton steps of the joint values towards poses, by differences."""
    step = 1e-6
    columns = []
    for joint in range(q.shape[1]):
        other = q.clone()
        other[:, joint] += step
        columns.append(((poses_of_rows(model, replace(rows, q=other)) - T) / step)[:, :3].flatten(1))
    J = torch.stack(columns, -1)
    return torch.linalg.lstsq(J, (T_wanted - T)[:, :3].flatten(1)[..., None]).solution[..., 0]
