"""Verification: the verdict on new measurements, and setup faults recognised by name and never on good data."""

from dataclasses import replace

import pytest
import torch
from testing.calibrated_ur5 import NOISE, calibrated_ur5, measured
from testing.closeness import assert_close
from testing.hybrid import hybrid_of, joints_in
from testing.models import hand_made_model, joints_around, no_type_checker
from testing.simulated_arm import simulate

from pisigma.errors import MeasurementError
from pisigma.identification.calibrator import GeometricCalibrator
from pisigma.kinematics.forward import forward_kinematics
from pisigma.measurement.dataset import Measurements
from pisigma.model.geometric_model import model_of_calibration, model_of_hybrid
from pisigma.model.row_poses import nominal_poses_of_rows, poses_of_rows
from pisigma.se3 import transform_from_xyzrpy
from pisigma.verification.setup_faults import find_mix_ups
from pisigma.verification.verification import read_for_verification, verify

pytestmark = pytest.mark.usefixtures("without_type_checker")

ROWS = 50
FRAME = transform_from_xyzrpy(torch.tensor([0.3, -0.2, 0.1, 0.5, 0.2, -0.3], dtype=torch.float64))
TOOL = transform_from_xyzrpy(torch.tensor([0.03, -0.02, 0.05, 0.2, 0.1, 0.0], dtype=torch.float64))


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
MIX_UPS = {
    "frame": (lambda rows, T: moved(rows, T, FRAME, EYE), ("frame",), "shifted by 374 mm"),
    "tool": (lambda rows, T: moved(rows, T, EYE, TOOL), ("tool",), "shifted by 61.6 mm"),
    "frame and tool": (lambda rows, T: moved(rows, T, FRAME, TOOL), ("frame", "tool"), "another tool"),
    "mm named m": (
        lambda rows, T: replace(rows, position=rows.position * 1e3),
        ("position_unit",),
        "divided by 1000 (millimetres that are named metres)",
    ),
    "m named mm": (
        lambda rows, T: replace(rows, position=rows.position / 1e3),
        ("position_unit",),
        "multiplied by 1000 (metres that are named millimetres)",
    ),
    "degrees named radians": (
        lambda rows, T: joints(rows, 180 / torch.pi),
        ("joint_unit",),
        "q1 to q6 divided by 57.3 (degrees that are named radians)",
    ),
    "radians named degrees": (
        lambda rows, T: joints(rows, torch.pi / 180),
        ("joint_unit",),
        "q1 to q6 multiplied by 57.3 (radians that are named degrees)",
    ),
    "two exchanged": (
        lambda rows, T: joints(rows, order=[0, 2, 1, 3, 4, 5]),
        ("joint_order",),
        "q2 and q3 exchanged",
    ),
    "another order": (
        lambda rows, T: joints(rows, order=[2, 0, 1, 3, 4, 5]),
        ("joint_order",),
        "columns q2, q3, q1, q4, q5, q6",
    ),
    "a sign": (lambda rows, T: joints(rows, [1, 1, -1.0, 1, 1, 1]), ("joint_sign",), "the sign of q3 turned"),
    "two signs": (
        lambda rows, T: joints(rows, [1, -1.0, 1, -1, 1, 1]),
        ("joint_sign",),
        "the sign of q2 and q4 turned",
    ),
    "a quarter turn": (
        lambda rows, T: joints(rows, offset=[0, QUARTER, 0, 0, 0, 0]),
        ("joint_zero",),
        "-90 deg added to q2",
    ),
    "half a turn": (
        lambda rows, T: joints(rows, offset=[0, 0, torch.pi, 0, 0, 0]),
        ("joint_zero",),
        "180 deg added to q3",
    ),
    "two quarter turns": (
        lambda rows, T: joints(rows, offset=[0, -QUARTER, 0, QUARTER, 0, 0]),
        ("joint_zero",),
        "90 deg added to q2 and -90 deg added to q4",
    ),
    "any zero": (
        lambda rows, T: joints(rows, offset=[0, 0, 0.2, 0, 0, 0]),
        ("joint_zero",),
        "-11.46 deg added to q3",
    ),
    "a sign, from elsewhere": (
        lambda rows, T: joints(moved(rows, T, FRAME, EYE), [1, 1, -1.0, 1, 1, 1]),
        ("joint_sign", "frame"),
        "the sign of q3 turned and another measuring frame",
    ),
}
"""By name: how good measurements are spoilt, what is to be recognised, and words of the sentence."""


@pytest.mark.parametrize("name", MIX_UPS)
def test_mix_ups_are_recognised(geometric, name):
    model, rows, _ = geometric
    spoil, kinds, words = MIX_UPS[name]
    found = verify(model, spoil(rows, poses_of_rows(model, rows)))
    assert [setup_fault.kinds for setup_fault in found.setup_faults] == [kinds]
    (setup_fault,) = found.setup_faults
    assert words in setup_fault.sentence
    assert setup_fault.before > 20 * setup_fault.after
    assert_close(setup_fault.after, NOISE * 3**0.5, rtol=0.3)
    assert setup_fault.after_nominal > 3 * setup_fault.after
    assert found.verdict == "mixed_up"
    assert "something was mixed up" in found.sentence


@pytest.mark.parametrize("name", ["frame and tool", "degrees named radians", "two exchanged", "a sign"])
def test_mix_ups_are_recognised_in_poses(geometric, name):
    model, _, rows = geometric
    spoil, kinds, words = MIX_UPS[name]
    (setup_fault,) = find_mix_ups(model, model, spoil(rows, poses_of_rows(model, rows)))
    assert setup_fault.kinds == kinds
    assert words in setup_fault.sentence
    assert setup_fault.after_rotation < 1e-3 < setup_fault.before_rotation
    assert {"before_rms_deg", "after_rms_deg"} <= set(setup_fault.in_file_units())


def test_a_zero_that_only_orientations_tell(geometric):
    model, _, rows = geometric
    (setup_fault,) = find_mix_ups(model, model, joints(rows, offset=[0, 0, 0, 0, 0, torch.pi]))
    assert setup_fault.kinds == ("joint_zero",)
    assert "180 deg added to q6" in setup_fault.sentence


@pytest.mark.parametrize("name", ["tool", "mm named m", "a sign", "a quarter turn", "a sign, from elsewhere"])
def test_mix_ups_are_recognised_by_a_hybrid(hybrid, name):
    model, rows = hybrid
    spoil, kinds, _ = MIX_UPS[name]
    found = verify(model, spoil(rows, poses_of_rows(model, rows)))
    assert kinds in [setup_fault.kinds for setup_fault in found.setup_faults]
    assert found.verdict == "mixed_up"


@pytest.mark.parametrize("turned", [False, True])
def test_good_data_are_explained_better_and_nothing_is_claimed(geometric, turned):
    model, *rows = geometric
    found = verify(model, rows[turned])
    assert found.verdict == "better"
    assert found.setup_faults == ()
    assert found.remarks == ()
    assert found.ratio < 0.3
    assert found.better_share > 0.9
    assert "explains these measurements better" in found.sentence


def test_good_data_of_a_hybrid(hybrid):
    found = verify(*hybrid)
    assert [model["name"] for model in found.comparison["models"]] == ["nominal", "geometric", "corrected"]
    assert found.verdict == "better"
    assert found.setup_faults == ()


def test_few_or_random_rows_are_no_evidence(geometric):
    model, rows, _ = geometric
    few = verify(model, rows.select(torch.arange(3)))
    assert few.verdict == "undecided"
    assert few.setup_faults == ()
    order = torch.randperm(ROWS, generator=torch.Generator().manual_seed(2))
    random = verify(model, replace(rows, q=rows.q[order]))
    assert random.setup_faults == ()
    assert random.verdict == "mixed_up"
    assert "no usual setup fault" in random.remarks[-1]


@pytest.mark.parametrize("fixture", ["geometric", "hybrid"])
def test_the_nominal_robot_is_recognised(request, fixture):
    model, rows = request.getfixturevalue(fixture)[:2]
    found = verify(model, measured(rows.q, nominal_poses_of_rows(model, rows), False))
    assert found.verdict != "better"
    (setup_fault,) = found.setup_faults
    assert setup_fault.kinds == ("correction",)
    assert "the nominal robot at the joint values of the file" in setup_fault.sentence
    assert "after_nominal_rms_mm" not in setup_fault.in_file_units()


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
    (setup_fault,) = find_mix_ups(model, model, measured(logged[regular], T[regular], False))
    assert setup_fault.kinds == ("correction",)
    assert "the correction taken off" in setup_fault.sentence


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


def test_a_model_of_joint_errors():
    model = hand_made_model("kiro3")
    q = joints_around("kiro3", 40, seed=5, spread=0.2)
    rows = measured(q, model.forward(q), False)
    found = verify(model, rows)
    assert found.verdict == "better"
    assert found.setup_faults == ()
    nominal = verify(model, measured(q, forward_kinematics(model.robot, q), False))
    assert nominal.verdict == "not_better"
    assert [setup_fault.kinds for setup_fault in nominal.setup_faults] == [("correction",)]


def test_reading_minds_no_limits_but_says_so(geometric, tmp_path):
    model, rows, _ = geometric
    far = joints(rows, 180 / torch.pi)
    far.write_csv(tmp_path / "far.csv", None, revolute=[True] * 6)
    with pytest.raises(MeasurementError, match="outside the limits"):
        Measurements.read_csv(tmp_path / "far.csv", model.robot)
    read = read_for_verification(tmp_path / "far.csv", model)
    assert_close(read.q, far.q, atol=1e-9)
    remark = verify(model, read).remarks[0]
    assert remark.startswith(f"{ROWS} of {ROWS} rows, the first in {tmp_path / 'far.csv'}, line 2")


def test_rows_of_training_are_left_out(geometric, tmp_path):
    model, rows, _ = geometric
    path = tmp_path / "rows.csv"
    replace(rows, split=("train", "test") * (ROWS // 2)).write_csv(path, model.robot)
    assert read_for_verification(path, model).line == tuple(range(3, ROWS + 2, 2))
    replace(rows, split=("train",) * ROWS).write_csv(path, model.robot)
    with pytest.raises(MeasurementError, match="marks all rows as 'train'"):
        read_for_verification(path, model)


def test_measured_ur5(shared_data):
    """Rows that were not calibrated with: good as they are, and with the sign of a joint turned."""
    everything = replace(Measurements.read_csv(shared_data / "ur5" / "grid.csv"), split=None)
    model_robot = simulate("ur5", rows=1).nominal
    chosen = torch.arange(0, everything.rows, 4)
    trained = everything.select(chosen)
    rows = everything.select(torch.arange(1, everything.rows, 10))
    model = model_of_calibration("ur5", model_robot, GeometricCalibrator(model_robot).fit(trained), trained)
    good = verify(model, rows)
    assert good.verdict == "better"
    assert good.setup_faults == ()
    assert good.ratio < 0.25
    (setup_fault,) = verify(model, joints(rows, [1, 1, 1, 1, -1.0, 1])).setup_faults
    assert setup_fault.kinds == ("joint_sign",)
    assert "q5" in setup_fault.sentence
    assert setup_fault.after < 2e-4
