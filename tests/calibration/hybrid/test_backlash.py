"""Backlash: learned where rows say from which side joints came, and left alone where there is none."""

import dataclasses
import functools

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.models import no_type_checker

from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.deployment.export.onnx_model import export_onnx
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot import Robot
from pisigma.simulation.errors.backlash import Backlash
from pisigma.simulation.errors.geometric import RandomGeometricDeviation
from pisigma.simulation.measure import simulate
from pisigma.simulation.true_robot import TrueRobot

ROBOT = Robot.load("rb5")
ARC_MINUTE = 1 / 60
NOISE = 2e-5


def true_robot(play_deg: float) -> TrueRobot:
    geometry = RandomGeometricDeviation(
        kind="geometric_random", distribution="normal", seed=3, length_mm=0.3, angle_deg=0.03
    )
    play = Backlash(kind="backlash", play_deg={joint.name: play_deg for joint in ROBOT.joints}, seed=1)
    return TrueRobot(ROBOT, [geometry, play])


@functools.cache
def measured(play_deg: float, rows: int, seed: int, noise: float) -> Measurements:
    """Positions, with the side that every joint came from; drawn at random where it does not matter."""
    rng = np.random.default_rng(seed)
    with no_type_checker():
        data = simulate(true_robot(play_deg), torch.from_numpy(rng.uniform(-2, 2, (rows, 6))), "position")
    approach = (
        torch.from_numpy(rng.choice([-1.0, 1.0], (rows, 6))) if data.approach is None else data.approach
    )
    position = data.position + noise * torch.from_numpy(rng.normal(size=(rows, 3)))
    return dataclasses.replace(data, position=position, approach=approach)


@functools.cache
def fitted(play_deg: float, stated: bool) -> HybridResult:
    data = measured(play_deg, 60, 0, NOISE)
    with no_type_checker():
        return HybridCalibrator(ROBOT, harmonics=(8,), products=False).fit(
            data if stated else dataclasses.replace(data, approach=None)
        )


def rms(result: HybridResult, rows: Measurements) -> float:
    with no_type_checker():
        return float(result.errors_of(rows)["position"].square().sum(1).mean().sqrt())


def from_the_other_side(play_deg: float) -> Measurements:
    """Held-out joint values, every joint approached from the side that was not drawn."""
    data = measured(play_deg, 200, 9, 0.0)
    approach = -data.approach
    with no_type_checker():
        T = true_robot(play_deg).forward(data.q, approach)
    return dataclasses.replace(data, approach=approach, position=T[:, :3, 3])


def test_an_arc_minute_is_learned_and_held_out_approaches_are_predicted():
    rows = from_the_other_side(ARC_MINUTE)
    with_columns = rms(fitted(ARC_MINUTE, True), rows)
    assert with_columns < 0.5 * rms(fitted(ARC_MINUTE, False), dataclasses.replace(rows, approach=None))
    assert with_columns < 3e-5


def test_the_weights_are_half_the_play():
    learned = fitted(ARC_MINUTE, True).learned
    assert learned is not None
    assert [feature.name for feature in learned.correction.features] == ["backlash"]
    half = -np.deg2rad(ARC_MINUTE) / 2
    (weight,) = learned.correction.linear
    # The last joint turns the tool about itself; its position says little.
    assert_close(weight[:4, 0], torch.full((4,), half), atol=2e-5)


def test_without_backlash_the_columns_change_nothing():
    rows = measured(0.0, 200, 9, 0.0)
    assert rms(fitted(0.0, True), rows) <= 1.01 * rms(fitted(0.0, False), rows)


def test_rows_of_one_side_alone_do_not_show_it():
    data = measured(ARC_MINUTE, 60, 0, NOISE)
    one = dataclasses.replace(data, approach=torch.ones_like(data.q))
    with no_type_checker():
        result = HybridCalibrator(ROBOT, features=("backlash",), products=False).fit(one)
    assert result.learned is None


def test_equal_joint_values_from_both_sides_are_no_repeats():
    """Taken as repeats of one pose, their mean would hide the play."""
    data = measured(ARC_MINUTE, 30, 0, NOISE)
    true, q, approach = (
        true_robot(ARC_MINUTE),
        data.q.repeat(2, 1),
        torch.cat([data.approach, -data.approach]),
    )
    with no_type_checker():
        position = true.forward(q, approach)[:, :3, 3]
    rng = np.random.default_rng(1)
    twice = Measurements(
        q=q, position=position + NOISE * torch.from_numpy(rng.normal(size=position.shape)), approach=approach
    )
    with no_type_checker():
        result = HybridCalibrator(ROBOT, features=("backlash",), products=False).fit(twice)
    assert result.learned is not None
    assert rms(result, from_the_other_side(ARC_MINUTE)) < 6e-5


@pytest.mark.parametrize("missing", [torch.nan, 0.0])
def test_where_no_side_is_stated_a_joint_is_in_the_middle_of_its_play(missing):
    learned = fitted(ARC_MINUTE, True).learned
    assert learned is not None
    q = measured(ARC_MINUTE, 200, 9, 0.0).q
    with no_type_checker():
        assert_close(learned.correction(q, torch.full_like(q, missing)), learned.correction(q), atol=0)


@functools.cache
def model() -> CalibratedModel:
    with no_type_checker():
        return model_of_hybrid("play", ROBOT, fitted(ARC_MINUTE, True), measured(ARC_MINUTE, 60, 0, NOISE))


def test_inverse_kinematics_uses_the_stated_side():
    true, q = true_robot(ARC_MINUTE), 0.7 + 0.3 * measured(ARC_MINUTE, 200, 9, 0.0).q[:20]
    approach = torch.from_numpy(np.random.default_rng(3).choice([-1.0, 1.0], (20, 6)))
    with no_type_checker():
        T = true.forward(q, approach)
        ik = CorrectedIK(model())
        solution = ik(T, near=q, approach=approach)
        missed = (true.forward(solution.q, approach) - T)[:, :3, 3].norm(dim=1)
        without = (true.forward(ik(T, near=q).q, approach) - T)[:, :3, 3].norm(dim=1)
        by_torch = ik.numeric.solve_batch(T, near=q, approach=approach)
    assert ik.compiled is not None
    assert_close(solution.q, by_torch.q, atol=1e-9)
    assert float(missed.square().mean().sqrt()) < 0.5 * float(without.square().mean().sqrt())


def test_the_onnx_graph_has_an_input_for_the_side():
    pytest.importorskip("onnx")
    runtime = pytest.importorskip("onnxruntime")
    q = measured(ARC_MINUTE, 200, 9, 0.0).q[:4]
    approach = torch.tensor([1.0, -1.0, 0.0, 1.0, -1.0, 1.0], dtype=torch.float64).repeat(4, 1)
    session = runtime.InferenceSession(export_onnx(model()), providers=["CPUExecutionProvider"])
    (delta,) = session.run(["correction"], {"q": q.numpy(), "approach": approach.numpy()})
    arm = model().hybrid
    assert arm is not None
    assert_close(torch.from_numpy(delta), arm.correction(q, approach), atol=1e-15)
