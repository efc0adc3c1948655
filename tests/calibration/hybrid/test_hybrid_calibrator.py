"""The hybrid calibrator on simulated and measured robots: better where it can be, the geometric one elsewhere."""

import functools
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.fleet_robots import NOMINAL as FLEET_ROBOT
from testing.fleet_robots import common_errors, rows_of
from testing.linearised import random_joints, tracker_data
from testing.models import no_type_checker
from testing.rb5_with_all_errors import NOISE, SimulatedTracker, simulated_tracker
from testing.refusals import refused
from testing.sensors import pair_data, socket_data, touch_data, true_robot

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.files.errors import IdentificationError
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.groups import held_out_groups
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics


@pytest.fixture(scope="module", autouse=True)
def _without_type_checker():
    """Shapes are checked where the parts of the calibrator are tested."""
    with no_type_checker():
        yield


QUICK = {"harmonics": (8, 24), "products": False}


def rms(result: HybridResult | CalibrationResult, measurements: Measurements) -> float:
    """Of the errors' lengths [m]."""
    return float(result.errors_of(measurements)["position"].square().sum(1).mean().sqrt())


def calibrator(robot: Robot, **options: object) -> HybridCalibrator:
    return HybridCalibrator(GeometricCalibrator(robot), **{**QUICK, **options})  # type: ignore[arg-type]


@functools.cache
def fitted(
    seed: int = 0, rows: int = 150, geometry_only: bool = False
) -> tuple[SimulatedTracker, HybridResult]:
    simulated = simulated_tracker(seed, rows, geometry_only)
    return simulated, calibrator(simulated.robot).fit(simulated.train)


def test_all_errors_of_a_simulated_robot_are_learned_from_150_positions() -> None:
    simulated, result = fitted()
    assert rms(result.geometric, simulated.test) > 0.2e-3
    assert rms(result, simulated.test) < 0.07e-3
    assert result.learned is not None
    assert 0.5 * NOISE < result.learned.noise["position"] < 1.5 * NOISE
    assert 0 < result.learned.effective_unknowns < result.learned.unknowns
    assert result.learned.rounds >= 1
    assert any(trial.is_best_so_far for trial in result.trials[1:])
    assert "gravity" in [feature.name for feature in result.learned.correction.features]


def test_95_percent_intervals_cover_about_as_many_new_poses() -> None:
    simulated, result = fitted()
    errors = result.errors_of(simulated.test)["position"]
    inside = errors.abs() < 1.96 * result.sigma(simulated.test)
    assert 0.90 < float(inside.double().mean()) < 0.99
    geometric_only, plain = fitted(geometry_only=True)
    errors = plain.errors_of(geometric_only.test)["position"]
    inside = errors.abs() < 1.96 * plain.sigma(geometric_only.test)
    assert 0.90 < float(inside.double().mean()) < 0.995


def test_errors_of_geometry_alone_leave_the_geometric_calibration_as_it_is() -> None:
    simulated, result = fitted(geometry_only=True)
    assert result.learned is None
    assert result.arm() is None

    alone = GeometricCalibrator(simulated.robot).fit(simulated.train)
    assert_close(result.geometric.robot.dh, alone.robot.dh, atol=1e-12)
    assert_close(
        result.errors_of(simulated.test)["position"], alone.errors_of(simulated.test)["position"], atol=1e-12
    )
    assert next(trial.is_best_so_far for trial in result.trials)
    assert not any(trial.is_best_so_far for trial in result.trials[1:])


def test_a_kept_correction_is_in_the_table_of_what_was_tried() -> None:
    _, result = fitted()
    assert [trial.name for trial in result.trials[:2]] == ["geometry", "gravity"]
    kept = [trial for trial in result.trials if trial.is_best_so_far]
    assert kept[0].held_out_ratio == 1.0
    assert kept[-1].held_out_ratio < 0.5
    assert all(b.log_evidence > a.log_evidence for a, b in itertools.pairwise(kept))
    assert all(b.unknowns > kept[0].unknowns for b in result.trials[1:])


def test_the_arm_and_the_predicted_poses_are_those_of_the_fit() -> None:
    simulated, result = fitted()
    arm, learned = result.arm(), result.learned
    assert arm is not None
    assert learned is not None
    T = result.predicted_poses(simulated.test)
    assert_close(arm.forward(simulated.test.q), T, atol=1e-12)
    q = simulated.train.q
    assert bool(learned.coverage.contains(q).all())
    expected = forward_kinematics(learned.geometry.robot, q + learned.correction(q))
    assert_close(result.predicted_poses(simulated.train), expected, atol=1e-12)


@pytest.mark.parametrize("seed", [0, 4])
def test_thirty_positions_do_not_increase_the_error(seed: int) -> None:
    simulated, result = fitted(seed, rows=30)
    assert rms(result, simulated.test) < 1.02 * rms(result.geometric, simulated.test)


def test_two_fits_are_equal_and_progress_is_reported() -> None:
    simulated, first = fitted(rows=30)
    said: list[str] = []
    second = calibrator(simulated.robot).fit(simulated.train, said.append)
    assert bool((first.predicted_poses(simulated.test) == second.predicted_poses(simulated.test)).all())
    assert bool((first.sigma(simulated.test) == second.sigma(simulated.test)).all())
    assert said[0] == "gravity"
    assert any(what.startswith("gravity + series 8") for what in said)
    assert "solving for all parameters" in said


def test_product_units_are_kept_where_joints_act_on_each_other() -> None:
    """Errors of one joint that depend on the product of what two others do."""
    robot = Robot.load("rb5")
    simulated = simulated_tracker(3, 300, geometry_only=True)
    q = torch.cat([simulated.train.q, simulated.test.q])
    delta = torch.zeros_like(q)
    delta[:, 1] = 4e-4 * q[:, 2].sin() * q[:, 3].cos()
    delta[:, 2] = 3e-4 * (q[:, 1] + 0.5).cos() * q[:, 4].sin()
    p = simulated.pose(q + delta)[:, :3, 3]
    noise = NOISE * torch.randn(300, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    train, test = (
        Measurements(q=q[:300], position=p[:300] + noise),
        Measurements(q=q[300:], position=p[300:].contiguous()),
    )
    result = calibrator(robot, harmonics=(4,), products=True).fit(train)
    assert result.learned is not None
    assert set(result.learned.correction.orders) == {2}
    assert "+ products)" in result.verdict or "(products)" in result.verdict
    assert rms(result, test) < 0.3 * rms(result.geometric, test)
    errors, deviation = result.errors_of(test)["position"], result.sigma(test)
    assert 0.85 < float((errors.abs() < 1.96 * deviation).double().mean()) < 0.995
    names = [trial.name for trial in result.trials]
    assert any(name.endswith("products") for name in names)


def test_product_units_without_an_effect_are_dropped() -> None:
    simulated = simulated_tracker(0)
    result = calibrator(simulated.robot, harmonics=(8,), products=True).fit(simulated.train)
    assert result.learned is not None
    assert result.learned.correction.orders == ()
    tried = [trial for trial in result.trials if "products" in trial.name]
    assert not any(trial.is_best_so_far for trial in tried)


def test_repeats_of_a_few_poses_do_not_fool_it() -> None:
    """24 poses measured 30 times: what is wrong at a pose is wrong in all of its repeats."""
    simulated = simulated_tracker(2, 24, geometry_only=True)
    generator = torch.Generator().manual_seed(4)
    assert simulated.train.position is not None
    systematic = simulated.train.position + 2e-4 * torch.randn(
        24, 3, generator=generator, dtype=torch.float64
    )
    q, position = simulated.train.q.repeat(30, 1), systematic.repeat(30, 1)
    position = position + 1e-5 * torch.randn(720, 3, generator=generator, dtype=torch.float64)
    result = calibrator(simulated.robot).fit(Measurements(q=q, position=position))
    assert rms(result, simulated.test) <= 1.02 * rms(result.geometric, simulated.test)


def test_wrong_rows_do_not_affect_the_fit() -> None:
    simulated, good = fitted()
    generator = torch.Generator().manual_seed(0)
    assert simulated.train.position is not None
    position = simulated.train.position.clone()
    bad = torch.randperm(150, generator=generator)[:8]
    way = torch.randn(8, 3, generator=generator, dtype=torch.float64)
    position[bad] += 3e-3 * way / way.norm(dim=1, keepdim=True)
    result = calibrator(simulated.robot).fit(replace(simulated.train, position=position))
    assert rms(result, simulated.test) < 0.07e-3
    assert rms(result, simulated.test) < 1.5 * rms(good, simulated.test)
    assert result.learned is not None
    assert result.learned.noise["position"] < 2 * NOISE


def test_choosing_on_a_part_of_the_rows_fits_to_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pisigma.calibration.hybrid.calibrator.SEARCHED_ROWS", 90)
    simulated, whole = fitted()
    result = calibrator(simulated.robot).fit(simulated.train)
    assert rms(result, simulated.test) < 1.1 * rms(whole, simulated.test)


def test_choosing_on_a_part_of_the_rows_takes_pairs_with_both_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every row of the searched ones has the group that it has among all."""
    monkeypatch.setattr("pisigma.calibration.hybrid.calibrator.SEARCHED_ROWS", 60)
    made = calibrator(true_robot().nominal, features=("joints",))
    solved = made.geometric_calibrator.solve(join([touch_data(), pair_data(40)]))
    group = held_out_groups(solved.setup.measurements)
    choice = made._chosen(solved, group, lambda what: None)
    q = choice.rows.problem.q
    assert 60 < len(q) < solved.problem.q.shape[0]
    assert len(choice.rows.group) == len(q)
    place = torch.cdist(q, solved.problem.q).argmin(1)
    together = group[place][:, None] == group[place]
    assert torch.equal(choice.rows.group[:, None] == choice.rows.group, together)


@pytest.mark.parametrize("features", [("sin_cos",), ("joints", "series"), ("pose",), ()])
def test_other_features_can_be_chosen(features: tuple[str, ...]) -> None:
    simulated, _ = fitted()
    result = calibrator(simulated.robot, features=features, harmonics=(4,)).fit(simulated.train)
    assert rms(result, simulated.test) < 1.02 * rms(result.geometric, simulated.test)
    assert (result.learned is None) == (features in ((), ("pose",)))
    tried = [trial.name for trial in result.trials[1:]]
    wanted = {"sin_cos": "sin_cos", "joints": "joints", "pose": "pose"}
    assert all(any(name.startswith(wanted[f]) for name in tried) for f in features if f in wanted)


def test_series_have_not_many_more_harmonics_than_there_are_joint_values() -> None:
    """Unless none would be left."""
    simulated, _ = fitted(rows=30)
    said: list[str] = []
    calibrator(simulated.robot, features=("series",), harmonics=(2, 61)).fit(simulated.train, said.append)
    assert [what for what in said if what.startswith("series")] == ["series 2"]


def test_gravity_may_point_elsewhere() -> None:
    simulated, _ = fitted()
    made = calibrator(simulated.robot, gravity=(0.0, 3.0, 0.0), features=("gravity",)).fit(simulated.train)
    assert made.learned is not None
    (gravity,) = made.learned.correction.features
    assert isinstance(gravity, GravityTorques)
    assert gravity.gravity == (0.0, 1.0, 0.0)
    right = calibrator(simulated.robot, features=("gravity",)).fit(simulated.train)
    assert rms(right, simulated.test) < 0.8 * rms(made, simulated.test)


@pytest.mark.parametrize(
    ("option", "given", "value"),
    [("features", ("serie",), "serie"), ("harmonics", (), ()), ("harmonics", (0, 8), (0, 8))],
)
def test_invalid_settings_are_refused(option: str, given: tuple[object, ...], value: object) -> None:
    with refused(IdentificationError, option=option, value=value):
        calibrator(Robot.load("rb5"), **{option: given})


def test_harmonics_do_not_matter_without_a_series() -> None:
    assert calibrator(Robot.load("rb5"), features=("gravity",), harmonics=()).harmonics == ()


def test_touches_are_sufficient_without_other_sensors() -> None:
    """Along all three axes at every pose, in one jig frame."""
    simulated = simulated_tracker(0)
    q = simulated.train.q
    generator = torch.Generator().manual_seed(0)
    noise = NOISE * torch.randn(len(q), 3, generator=generator, dtype=torch.float64)
    p = simulated.true.forward(q)[:, :3, 3]
    data = Measurements(
        q=q.repeat_interleave(3, 0),
        touch=(p + noise).flatten(),
        touch_axis=("x", "y", "z") * len(q),
        frame=("jig",) * 3 * len(q),
    )
    geometric = GeometricCalibrator(simulated.robot, tool="position", base_guesses={"jig": (0.0,) * 6})
    result = HybridCalibrator(geometric, harmonics=(8,), products=False).fit(data)
    test = simulated.test.q
    where = Measurements(q=test, frame=("jig",) * len(test))
    true = simulated.true.forward(test)[:, :3, 3]
    geometric_only = replace(result, learned=None)
    before, after = (
        (one.predicted_poses(where)[:, :3, 3] - true).square().sum(1).mean().sqrt()
        for one in (geometric_only, result)
    )
    assert float(before) > 0.15e-3
    assert float(after) < 0.05e-3
    assert result.learned is not None
    assert set(result.learned.noise) == {"touch"}


def test_sockets_with_geometry_only_are_the_geometric_calibration() -> None:
    known = {("plate/0", "plate/1"): 0.05}
    nominal, data = true_robot().nominal, socket_data()
    noise = torch.randn(data.q.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    data = replace(data, q=data.q + 3e-5 * noise)
    geometric = GeometricCalibrator(nominal, socket_distances=known)
    result = HybridCalibrator(geometric, harmonics=(8,), products=False).fit(data)
    assert result.learned is None
    assert bool(torch.isfinite(result.sigma(data)).all())


@pytest.mark.parametrize("rows", [60, 400])
def test_without_noise_errors_and_their_deviations_vanish(rows: int) -> None:
    """With few rows as with many; the noise is then far too small for the covariance of the values."""
    robot = Robot.load("kiro3")
    q, test = (random_joints(robot, count, seed, widest=2.0) for seed, count in enumerate((rows, 100)))
    delta = 3e-4 * torch.sin(2 * q), 3e-4 * torch.sin(2 * test)
    with no_type_checker():
        result = HybridCalibrator(robot, harmonics=(8, 24)).fit(tracker_data(robot, q, delta[0]))
        held_out = tracker_data(robot, test, delta[1])
        assert rms(result.geometric, held_out) > 3e-5
        assert rms(result, held_out) < 3e-7
        assert float(result.sigma(held_out).max()) < 3e-6


@pytest.mark.parametrize("rows", [60, 400])
def test_a_single_joint_is_calibrated_without_products(rows: int, tmp_path: Path) -> None:
    """A turntable: there are no two joints for products."""
    urdf = (
        '<robot name="table"><link name="a"/><link name="b"/><joint name="turn" type="revolute"><parent link="a"/>'
        '<child link="b"/><origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>'
        '<limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>'
    )
    (tmp_path / "table.urdf").write_text(urdf)
    robot = Robot.load(tmp_path / "table.urdf")
    held = robot.with_geometry(tool=np.array([0.5, 0.1, 0.2, 0.0, 0.0, 0.0]))
    q, test = (random_joints(robot, count, seed, widest=1.8) for seed, count in enumerate((rows, 100)))
    with no_type_checker():
        result = HybridCalibrator(robot, harmonics=(8,)).fit(
            tracker_data(held, q, 2e-4 * torch.sin(3 * q), 3e-5)
        )
        held_out = tracker_data(held, test, 2e-4 * torch.sin(3 * test))
        assert rms(result, held_out) < 0.3 * rms(result.geometric, held_out)


def test_standard_errors_include_the_bias_from_gears():
    def ratio(result: HybridResult | CalibrationResult) -> float:
        of_arm = zip(result.parameters, common_errors().flatten().tolist(), strict=False)
        z = [
            (one.change - true) / one.standard_error
            for one, true in of_arm
            if one.short_remark == "identified"
        ]
        return float(np.sqrt(np.mean(np.square(z))))

    results = [HybridCalibrator(FLEET_ROBOT).fit(rows_of(k, 60, k, individual=0.0)) for k in (1, 3)]
    assert min(ratio(result.geometric) for result in results) > 1.9
    assert max(ratio(result) for result in results) < 1.2
