"""Joint torques: learned as compliances where rows state them, and replaced by modelled ones where they do not."""

import dataclasses
import functools
import json
import re

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.calibration.geometric.problem.noise import repeat_indices
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.deployment.export.onnx_model import export_onnx, onnx_remarks
from pisigma.deployment.serve.models import ServedModels
from pisigma.files.errors import MeasurementError, ModelError
from pisigma.joint_correction.feature import FeatureOptions
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.joint_torques import JointTorques
from pisigma.measurement.conditions import JointState, repeat_key
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.exceeded_limits import row_warnings
from pisigma.model.accuracy import sigma_of_rows
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.inverse.loading import load
from pisigma.model.stated_conditions import condition_warnings, under_stated_torques
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.validation.checks.check import CheckedCalibration
from pisigma.validation.checks.torques import _negative, check_torques

ROBOT = Robot.load("ur5")
COMPLIANCE = np.array([0.0, 2e-5, 2e-5, 5e-5, 5e-5, 5e-5])
"""[rad/Nm]"""
NOISE = 2e-5


@functools.cache
def measured(rows: int, seed: int, noise: float = NOISE) -> Measurements:
    """Positions of an arm with elastic joints and a payload that differs from row to row and is not stated."""
    rng = np.random.default_rng(seed)
    q = torch.from_numpy(rng.uniform(-2.5, 2.5, (rows, 6)))
    columns = GravityTorques(ROBOT).columns(JointState(q))
    arm = np.zeros((6, 24))
    arm[:, 4:24:4] = ROBOT.reach * 9.81 * np.array([8.0, 2.0, 1.0, 1.0, 0.5])  # masses of the links [kg]
    load = rng.uniform(0, 5, rows)[:, None] * ROBOT.reach * 9.81
    tau = -(
        (columns.numpy() * arm).sum(-1) + columns.numpy()[..., 20] * load
    )  # the drives hold against gravity
    T = forward_kinematics(ROBOT, q - torch.from_numpy(COMPLIANCE * tau))
    position = T[:, :3, 3] + torch.from_numpy(rng.normal(0, noise, (rows, 3)))
    return Measurements(q, position, torque=torch.from_numpy(tau))


@functools.cache
def calibrated() -> HybridResult:
    return HybridCalibrator(ROBOT, features=("gravity", "torques"), products=False).fit(measured(60, 1))


@functools.cache
def model() -> CalibratedModel:
    return model_of_hybrid("ur5", ROBOT, calibrated(), measured(60, 1))


def rms(result: HybridResult, rows: Measurements) -> float:
    return float(result.errors_of(rows)["position"].square().sum(1).mean().sqrt())


def test_the_compliances_are_found_and_predict_an_unknown_payload():
    result, test = calibrated(), measured(100, 2, 0.0)
    (learned,) = (one for one in result.learned.correction.features if one.name == "torques")
    weight = result.learned.correction.linear[result.learned.correction.features.index(learned)]
    found = -weight.detach().numpy()[:, 0] / np.array(learned.scale).clip(1e-9)
    assert_close(found[1:4], COMPLIANCE[1:4], rtol=0.2)
    without = HybridCalibrator(ROBOT, features=("gravity",), products=False).fit(measured(60, 1))
    assert rms(result, test) < 0.5 * rms(without, test)
    assert condition_warnings(model(), test) == ()


def test_rows_without_torques_are_predicted_with_the_mean_load_and_a_larger_deviation():
    test = measured(100, 2, 0.0)
    unstated = dataclasses.replace(test, torque=None)
    stated_error, error = rms(calibrated(), test), rms(calibrated(), unstated)
    assert error > 2 * stated_error
    predicted = float(sigma_of_rows(model(), unstated).square().sum(1).mean().sqrt())
    assert 0.6 < predicted / error < 1.6
    assert len(condition_warnings(model(), unstated)) == len(condition_warnings(model())) == 1


def test_kernels_and_onnx_use_the_modelled_torques():
    ik, q = CorrectedIK(model()), measured(20, 3).q.numpy()
    assert ik.compiled is not None
    assert_close(ik.forward(q), model().forward(torch.from_numpy(q)), atol=1e-12)
    assert ik.warnings == condition_warnings(model())
    runtime = pytest.importorskip("onnxruntime")
    session = runtime.InferenceSession(export_onnx(model()), providers=["CPUExecutionProvider"])
    (delta,) = session.run(["correction"], {"q": q})
    assert_close(delta, model().hybrid.correction(torch.from_numpy(q)).detach(), atol=1e-12)


def test_stated_torques_replace_the_modelled_ones():
    rows = measured(5, 4)
    for k in range(rows.rows):
        ik = CorrectedIK(under_stated_torques(model(), rows.torque[k].tolist()))
        expected = calibrated().predicted_poses(rows.select(torch.tensor([k])))[0, :3, 3]
        assert_close(ik.forward(rows.q[k].numpy())[:3, 3], expected, atol=1e-9)
        assert ik.warnings == ()


def test_a_folder_keeps_the_feature(tmp_path):
    save_model(model(), tmp_path)
    loaded = load_model(tmp_path)
    rows = measured(20, 3)
    assert_close(sigma_of_rows(loaded, rows), sigma_of_rows(model(), rows), atol=1e-12)


def test_a_file_keeps_the_torques_and_names_other_units(tmp_path):
    rows = measured(20, 3)
    rows.write_csv(tmp_path / "rows.csv", ROBOT)
    read = Measurements.read_csv(tmp_path / "rows.csv", ROBOT)
    assert_close(read.torque, rows.torque, rtol=1e-9)
    assert row_warnings(ROBOT, read) == ()
    assert len(row_warnings(ROBOT, dataclasses.replace(read, torque=1e3 * read.torque))) == 1


def test_invalid_torques_are_refused(tmp_path):
    with refused(ModelError, option="torques_nm"):
        under_stated_torques(model(), [1.0, 2.0])
    with refused(ModelError, option="torques_nm", value=-61200.0):
        under_stated_torques(model(), [0.0, -61.2e3, -28.4e3, 0.3, 0.1, 0.0])
    geometric = dataclasses.replace(model(), hybrid=None)
    with refused(ModelError, option="torques_nm"):
        under_stated_torques(geometric, [0.0] * 6)
    file = tmp_path / "rows.csv"
    file.write_text("q1_deg,q2_deg,x_mm,y_mm,z_mm,tau_3\n0,0,1,2,3,4\n", encoding="utf-8")
    with refused(MeasurementError, value=3):
        Measurements.read_csv(file)


def test_the_differences_from_modelled_torques_are_those_of_other_rows_and_correlated():
    rows, other = measured(40, 1), measured(300, 2)
    options = FeatureOptions((), (0.0, 0.0, -1.0), 40)
    (feature,) = JointTorques.candidates(ROBOT, options, JointState.from_measurements(rows))
    covariance = torch.tensor(feature.covariance).double()
    missed = other.torque - feature.modelled_torques(JointState(other.q))
    ratio = covariance.diagonal()[1:4].sqrt() / missed[:, 1:4].square().mean(0).sqrt()
    assert bool(((ratio > 0.6) & (ratio < 1.7)).all())
    assert_close(
        torch.corrcoef(missed[:, 1:3].T)[0, 1],
        covariance[1, 2] / covariance[1:3, 1:3].diag().prod().sqrt(),
        atol=0.3,
    )
    assert JointTorques.candidates(ROBOT, options, JointState.from_measurements(measured(20, 3))) == ()


def test_rows_with_torques_of_another_sign_or_unit_are_named():
    test = measured(100, 2, 0.0)
    assert condition_warnings(model(), test) == ()
    for factor in (-1.0, 1e3, 1e-3):
        assert len(condition_warnings(model(), dataclasses.replace(test, torque=factor * test.torque))) == 1


@pytest.mark.parametrize(
    ("joints", "cause"), [((1,), "mixed_signs"), (range(6), "opposite_sign"), ((), None)]
)
def test_negative_compliances_are_named(joints, cause):
    signs = torch.ones(6, dtype=torch.float64)
    signs[list(joints)] = -1
    rows = dataclasses.replace(measured(60, 1), torque=measured(60, 1).torque * signs)
    calibrator = HybridCalibrator(ROBOT, features=("torques",), products=False)
    result = calibrator.fit(rows)
    found = [*check_torques(CheckedCalibration(calibrator.geometric_calibrator, rows, {"hybrid": result}))]
    assert [one.cause for one in found] == ([cause] if cause else [])
    if cause == "mixed_signs":
        assert found[0].values["joints"] == (2,)


def test_compliances_of_prismatic_joints_have_their_own_unit():
    (found,) = _negative({0: -1e-6, 2: -2e-6}, Robot.load("kiro3"))
    assert re.findall(r"(tau_\d) \(\S+ (\S+)\)", found.sentence) == [("tau_1", "rad/Nm"), ("tau_3", "m/N")]


def test_a_folder_states_that_torques_are_modelled(tmp_path):
    save_model(model(), tmp_path)
    loaded = load(tmp_path)
    assert "model" not in vars(loaded)  # the kernels are enough
    assert loaded.warnings == condition_warnings(model())
    (warning,) = ServedModels([tmp_path]).warnings
    assert warning.endswith(loaded.warnings[0])
    onnx = pytest.importorskip("onnx")
    metadata = {one.key: one.value for one in onnx.load_from_string(export_onnx(model())).metadata_props}
    assert json.loads(metadata["warnings"]) == [*loaded.warnings]
    assert set(loaded.warnings) <= set(onnx_remarks(model()))


def test_rows_with_another_load_are_not_repeats_of_a_pose_and_noise_of_torques_is_not_a_load():
    poses = measured(20, 3)
    rows = join([poses, poses, poses])
    noise = (
        0.005 * poses.torque.std(0).max() * torch.from_numpy(np.random.default_rng(0).normal(size=(20, 6)))
    )
    loaded = poses.torque + torch.tensor([0.0, 30.0, 10.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    rows = dataclasses.replace(rows, torque=torch.cat([poses.torque, poses.torque + noise, loaded]))
    key = repeat_indices(repeat_key(rows)).view(3, 20)
    assert bool((key[0] == key[1]).all())
    assert not bool((key[0] == key[2]).any())


def test_modelled_torques_are_judged_at_poses_that_their_fit_has_not_seen():
    def candidates(poses: int, repeats: int) -> tuple[JointTorques, ...]:
        rows = measured(poses, 1)
        state = JointState(rows.q.repeat(repeats, 1), {"torque": rows.torque.repeat(repeats, 1)})
        return JointTorques.candidates(ROBOT, FeatureOptions((), (0.0, 0.0, -1.0), poses), state)

    assert candidates(20, 5) == ()
    (once,), (often,) = candidates(40, 1), candidates(40, 5)
    assert_close(np.array(often.covariance), np.array(once.covariance), rtol=1e-6)


def test_without_torques_nothing_is_tried():
    rows = dataclasses.replace(measured(60, 1), torque=torch.full((60, 6), torch.nan).double())
    result = HybridCalibrator(ROBOT, features=("torques",), products=False).fit(rows)
    assert result.learned is None
