"""Tool from touches and base from points: as accurate as least squares can be, wrong rows, what is not determined."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.models import no_type_checker
from testing.touches import NOISE, POINT, TIP, noise_vectors, random_noise, touches, touching_joints

from pisigma.calibration.frames.frame_fit import FrameFit, fit_frames
from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import xyz_zyx_from_transform

BASE = np.array([1.0, 0.2, -0.3, 0.5, -0.2, 0.3])
UR5 = Robot.load("ur5")
TOUCHING = touching_joints(6)
POINTS = torch.from_numpy(np.random.default_rng(1).uniform(-2, 2, (8, 6)))


def points(missed: np.ndarray) -> Measurements:
    """Return eight measured positions of the tip with some noise [m]."""
    T = forward_kinematics(UR5.with_geometry(base=BASE, tool=TIP), POINTS)
    return Measurements(q=POINTS, position=T[:, :3, 3] + torch.from_numpy(missed))


def bound_of_tool() -> np.ndarray:
    """Return the Cramér-Rao bound of the tip: `R tip + p - point` with an unknown point."""
    R = forward_kinematics(UR5, TOUCHING)[:, :3, :3].numpy()
    X = np.concatenate([R, np.tile(-np.eye(3), (6, 1, 1))], 2).reshape(18, 6)
    return NOISE**2 * np.linalg.inv(X.T @ X)[:3, :3]


def bound_of_base() -> np.ndarray:
    """Return the Cramér-Rao bound of the base, by differences of the positions."""

    def positions(base: np.ndarray) -> np.ndarray:
        return forward_kinematics(UR5.with_geometry(base=base, tool=TIP), POINTS)[:, :3, 3].numpy().ravel()

    steps = 1e-6 * np.eye(6)
    X = np.stack([(positions(BASE + step) - positions(BASE - step)) / 2e-6 for step in steps], 1)
    return NOISE**2 * np.linalg.inv(X.T @ X)


def tool_by_touches(missed: np.ndarray) -> FrameFit:
    return fit_frames(UR5, touches(TOUCHING, missed), "tool")


def base_by_points(missed: np.ndarray) -> FrameFit:
    return fit_frames(UR5.with_geometry(tool=TIP), points(missed), "base")


CASES = pytest.mark.parametrize(
    ("fit", "count", "true", "bound"),
    [(tool_by_touches, 6, TIP[:3], bound_of_tool()), (base_by_points, 8, BASE, bound_of_base())],
)


@CASES
def test_accuracy_reaches_the_bound_and_standard_errors_state_it(fit, count, true, bound):
    with no_type_checker():
        fits = [fit(vector.reshape(count, 3)) for vector in noise_vectors(3 * count)]
    assert not any(one.wrong_rows for one in fits)
    errors = np.array([one.estimates - true for one in fits])
    assert_close(np.sqrt((errors**2).mean(0) / np.diag(bound)), 1.0, atol=0.02)
    assert_close(
        np.sqrt(np.mean([np.diag(one.covariance) for one in fits], 0) / np.diag(bound)), 1.0, atol=0.02
    )


@CASES
def test_wrong_row_is_named_and_left_out(fit, count, true, bound):
    for wrong in range(1, 4):
        result = fit(random_noise(count, wrong, wrong))
        assert result.wrong_rows == (wrong,)
        assert (np.abs(result.estimates - true) < 8 * np.sqrt(np.diag(bound))).all()


TURNED = UR5.with_geometry(tool=np.array([-0.07, 0.01, 0.1, 0.2, 0.0, 0.0]))


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("count", [4, 5, 12])
def test_coordinate_that_no_touch_determines_keeps_its_value(count, noise):
    q = touching_joints(count, axis=0)
    for seed in range(3):
        fit = fit_frames(TURNED, touches(q, noise * random_noise(count, seed)), "tool")
        (weak,) = fit.weak_directions
        assert (weak.combination, weak.is_held) == ("tool_x", True)
        assert (40 < weak.sigma < np.inf) == bool(noise)  # noise turns the tip, which looks like information
        assert fit.undetermined_indices == {fit.solved.problem.space.index("tool_x")}
        assert_close(fit.estimates[0], TURNED.tool[0], atol=1e-4)
        assert_close(fit.estimates[1:], TIP[1:3], atol=1e-9 + 6 * NOISE * noise)
        assert fit.covariance[0, 0] > 0.05**2
        assert not fit.wrong_rows


def test_only_the_last_joint_turned():
    q = TOUCHING[:1].repeat(6, 1)
    q[:, 5] += torch.linspace(-2, 2, 6)
    rows = Measurements(q=q + torch.from_numpy(random_noise(6, 0).repeat(2, 1)), socket=("point",) * 6)
    fit = fit_frames(TURNED, rows, "tool")
    assert fit.undetermined_indices == {fit.solved.problem.space.index("tool_z")}
    assert_close(fit.estimates[2], TURNED.tool[2], atol=1e-4)
    assert_close(fit.estimates[:2], np.zeros(2), atol=5e-4)


def test_base_keeps_its_turn_about_a_line_of_points():
    """Points on a line leave one turn of the base, which is nonlinear, at the value before."""
    tipped = UR5.with_geometry(base=BASE, tool=TIP)
    line = torch.tensor([0.4, 0.1, 0.3]) + torch.linspace(0, 1, 6)[:, None] * torch.tensor([0.2, 0.1, 0.0])
    q = touching_joints(6, places=line)
    place = forward_kinematics(tipped, q)[:, :3, 3]
    fit = fit_frames(tipped, Measurements(q=q, position=place), "base")
    assert_close(fit.estimates, BASE, atol=1e-8)
    elsewhere = tipped.with_geometry(base=BASE + np.array([0.1, -0.1, 0.1, 0.2, 0.1, -0.2]))
    fit = fit_frames(elsewhere, Measurements(q=q, position=place), "base")
    assert [one.is_held for one in fit.weak_directions] == [True]
    assert_close(fit.solved.result().predicted_poses(fit.rows)[:, :3, 3], place, atol=1e-8)


def test_value_before_that_the_rows_contradict_is_not_held():
    """Few coarse points determine a turn to 40 mrad; the value before, which is off by 2 rad, is not kept."""
    near = touching_joints(
        6, places=POINT + 0.01 * torch.from_numpy(np.random.default_rng(2).normal(size=(6, 3)))
    )
    tipped = UR5.with_geometry(base=BASE, tool=TIP)
    place = forward_kinematics(tipped, near)[:, :3, 3] + torch.from_numpy(12 * random_noise(6, 0))
    fit = fit_frames(
        tipped.with_geometry(base=np.array([0, 0, 0, 2.5, 0, 0])),
        Measurements(q=near, position=place),
        "base",
    )
    assert fit.weak_directions[0].sigma > 25
    assert not any(one.is_held for one in fit.weak_directions)
    assert_close(fit.solved.geometry.robot.base[3:], BASE[3:], atol=0.2)


@pytest.mark.parametrize(("count", "held"), [(1600, False), (400, True)])
def test_many_rows_of_similar_orientations_state_the_error_of_the_tool(count, held):
    """Coarse positions hardly turn the tool, whose value before is off by 60 mm."""
    rng = np.random.default_rng(1)
    true = UR5.with_geometry(tool=np.array([0.06, 0.0, 0.1, 0.0, 0.0, 0.0]))
    a = rng.uniform(-0.5, 0.5, (count, 3))
    q = np.array([0, -1.5, 1.5, -1.5, -1.5, 0]) + np.c_[a, -a[:, 1] - a[:, 2], np.zeros(count), a[:, 0]]
    q[:, 3:] += rng.normal(0, 0.05, (count, 3))
    joints = torch.from_numpy(q)
    place = forward_kinematics(true, joints)[:, :3, 3] + torch.from_numpy(rng.normal(0, 3e-3, (count, 3)))
    known = UR5.with_geometry(tool=np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0]))
    fit = fit_frames(known, Measurements(q=joints, position=place), "hand-eye")
    assert any(one.is_held for one in fit.weak_directions) == held
    error = fit.estimates[-3:] - true.tool[:3]
    assert (np.abs(error) < 3 * np.sqrt(fit.covariance.diagonal()[-3:])).all()


def test_hand_eye_of_poses_gives_back_base_and_tool():
    true = UR5.with_geometry(base=BASE, tool=np.array([0.02, 0.03, 0.1, 0.3, -0.1, 0.2]))
    T = forward_kinematics(true, POINTS)
    rows = Measurements(q=POINTS, position=T[:, :3, 3], rotation=T[:, :3, :3])
    fit = fit_frames(UR5, rows, "hand-eye")
    assert_close(fit.estimates, np.concatenate([true.base, true.tool]), atol=1e-9)
    assert not fit.weak_directions
    predicted = fit.solved.result().predicted_poses(rows)
    assert_close(xyz_zyx_from_transform(predicted), xyz_zyx_from_transform(T), atol=1e-9)


def test_too_few_rows_are_refused():
    with pytest.raises(IdentificationError) as refusal:
        fit_frames(UR5, touches(touching_joints(2), random_noise(2, 0)), "tool")
    assert refusal.value.value == 6


@pytest.mark.parametrize(("only", "column"), [("tool", "frame"), ("base", "target")])
def test_frames_of_unknown_place_are_not_fitted_as_one(only, column):
    names = {column: ("a",) * 4 + ("b",) * 4}
    with pytest.raises(IdentificationError) as refusal:
        fit_frames(UR5.with_geometry(tool=TIP), replace(points(np.zeros((8, 3))), **names), only)
    assert refusal.value.value == ["a", "b"]
    known = {"a": BASE, "b": BASE}
    if only == "tool":
        fit = fit_frames(UR5, replace(points(np.zeros((8, 3))), **names), only, known)
        assert_close(fit.estimates, TIP[:3], atol=1e-9)


def test_base_without_stated_positions_is_refused():
    with pytest.raises(IdentificationError) as refusal:
        fit_frames(UR5, touches(TOUCHING, random_noise(6, 0)), "hand-eye")
    assert refusal.value.option == "only"
