"""Verification: the verdict on new measurements, setup faults and warnings."""

from dataclasses import replace

import pytest
import torch
from testing.calibrated_ur5 import calibrated_ur5, measured
from testing.closeness import assert_close
from testing.hybrid import hybrid_of, joints_in
from testing.models import hand_made_model, joints_around, no_type_checker
from testing.refusals import refused
from testing.simulated_arm import simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import nominal_poses_of_rows
from pisigma.model.geometric_model import model_of_calibration, model_of_hybrid
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import transform_from_xyz_zyx
from pisigma.workflow.settings.verification import VerificationSettings
from pisigma.workflow.verify import read_for_verification, verify

pytestmark = pytest.mark.usefixtures("without_type_checker")

ROWS = 30
FRAME = transform_from_xyz_zyx(torch.tensor([0.3, -0.2, 0.1, 0.5, 0.2, -0.3], dtype=torch.float64))


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
    """Return the rows with other logged joint values."""
    q = rows.q if order is None else rows.q[:, order]
    return replace(rows, q=q * torch.as_tensor(factor) + torch.as_tensor(offset).double())


def from_elsewhere(rows: Measurements, turned: bool) -> Measurements:
    """Return the rows as measured by a relocated tracker."""
    R, p = FRAME[:3, :3], FRAME[:3, 3]
    return replace(
        rows,
        position=rows.position @ R.T + p,
        rotation=R @ rows.rotation if turned else None,
        frame=("east",) * rows.rows,
    )


def test_good_data_are_explained_better_without_faults(geometric):
    model, _, rows = geometric
    found = verify(model, rows)
    assert found.verdict == "better"
    assert found.setup_faults == ()
    assert found.warnings == ()
    assert found.corrected_to_nominal_error_ratio < 0.3
    assert found.better_share > 0.9


def test_good_data_of_a_hybrid(hybrid):
    found = verify(*hybrid)
    assert [model.name for model in found.comparison.models] == ["nominal", "geometric", "corrected"]
    assert found.verdict == "better"
    assert found.setup_faults == ()


def test_a_setup_fault_decides_the_verdict(geometric):
    """Neither the model nor the nominal robot counts as better."""
    model, rows, _ = geometric
    found = verify(model, joints(rows, [1, 1, -1.0, 1, 1, 1]))
    assert found.verdict == "setup_fault"
    assert not found.accepted
    (fault,) = found.setup_faults
    assert (fault.kinds, fault.joints) == (("joint_sign",), (2,))
    assert fault.rms_after < fault.nominal_rms_after
    assert found.to_json()["setup_faults"][0]["kinds"] == ["joint_sign"]


def test_the_nominal_robot_is_not_better(geometric, hybrid):
    for model, rows in (geometric[:2], hybrid):
        found = verify(model, measured(rows.q, nominal_poses_of_rows(model, rows), False))
        assert found.verdict != "better"
        assert [fault.kinds for fault in found.setup_faults] == [("correction",)]


def test_few_or_random_rows_are_no_evidence(geometric):
    model, rows, _ = geometric
    few = verify(model, rows.select(torch.arange(3)))
    assert few.verdict == "undecided"
    assert few.setup_faults == ()
    order = torch.randperm(ROWS, generator=torch.Generator().manual_seed(2))
    random = verify(model, replace(rows, q=rows.q[order]))
    assert random.setup_faults == ()
    assert random.verdict == "implausible"
    assert len(random.diagnostics) == 1


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


@pytest.mark.parametrize("turned", [False, True])
def test_a_moved_tracker_is_no_setup_fault(geometric, turned):
    model, _, rows = geometric
    here = verify(model, rows if turned else replace(rows, rotation=None))
    there = verify(model, from_elsewhere(rows, turned), VerificationSettings(fit_frame=True))
    assert there.verdict == "better"
    assert there.setup_faults == ()
    assert there.warnings != here.warnings
    for before, after in zip(here.comparison.models, there.comparison.models, strict=True):
        assert after.position.statistics["rms"] < 1.3 * before.position.statistics["rms"]
    last, first = (found.comparison.models[-1].position.statistics["rms"] for found in (there, here))
    assert last > 0.8 * first
    if turned:
        assert verify(model, replace(from_elsewhere(rows, True), frame=())).verdict == "setup_fault"


def test_rows_outside_the_joint_limits_are_read_with_warnings(geometric, tmp_path):
    model, rows, _ = geometric
    far = joints(rows, 180 / torch.pi)
    far.write_csv(tmp_path / "far.csv", None, revolute=[True] * 6)
    with refused(MeasurementError, file="far.csv"):
        Measurements.read_csv(tmp_path / "far.csv", model.robot)
    read = read_for_verification(tmp_path / "far.csv", model)
    assert_close(read.q, far.q, atol=1e-9)
    remarks = verify(model, read).warnings[: len(model.robot.joints)]
    for joint, remark in zip(model.robot.joints, remarks, strict=True):
        assert f"'{joint.name}'" in remark
        assert f"{tmp_path / 'far.csv'}, line " in remark


def test_rows_of_training_are_left_out(geometric, tmp_path):
    model, rows, _ = geometric
    path = tmp_path / "rows.csv"
    replace(rows, split=("train", "test") * (ROWS // 2)).write_csv(path, model.robot)
    assert read_for_verification(path, model).line == tuple(range(3, ROWS + 2, 2))
    replace(rows, split=("train",) * ROWS).write_csv(path, model.robot)
    with refused(MeasurementError, file=path, column="set", value="train"):
        read_for_verification(path, model)


def test_measured_ur5(shared_data):
    """Held-out rows, as measured and with the sign of a joint reversed."""
    everything = replace(Measurements.read_csv(shared_data / "ur5" / "grid.csv"), split=None)
    model_robot = simulate("ur5", rows=1).nominal
    chosen = torch.arange(0, everything.rows, 4)
    trained = everything.select(chosen)
    rows = everything.select(torch.arange(1, everything.rows, 10))
    model = model_of_calibration("ur5", model_robot, GeometricCalibrator(model_robot).fit(trained), trained)
    good = verify(model, rows)
    assert good.verdict == "better"
    assert good.setup_faults == ()
    assert good.corrected_to_nominal_error_ratio < 0.25
    (setup_fault,) = verify(model, joints(rows, [1, 1, 1, 1, -1.0, 1])).setup_faults
    assert (setup_fault.kinds, setup_fault.joints) == (("joint_sign",), (4,))
    assert setup_fault.rms_after < 2e-4
