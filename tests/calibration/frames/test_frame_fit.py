"""Tool from touches and base from points: as accurate as least squares can be, wrong rows, what is not determined."""

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.models import no_type_checker
from testing.touches import NOISE, TIP, noise_vectors, random_noise, touches, touching_joints

from pisigma.calibration.frames.frame_fit import FrameFit, fit_frames
from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import xyzrpy_from_transform

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
    return fit_frames(UR5, touches(TOUCHING, missed), "tool", {})


def base_by_points(missed: np.ndarray) -> FrameFit:
    return fit_frames(UR5.with_geometry(tool=TIP), points(missed), "base", {})


CASES = pytest.mark.parametrize(
    ("fit", "count", "true", "bound"),
    [(tool_by_touches, 6, TIP[:3], bound_of_tool()), (base_by_points, 8, BASE, bound_of_base())],
)


@CASES
def test_accuracy_reaches_the_bound_and_standard_errors_state_it(fit, count, true, bound):
    with no_type_checker():
        fits = [fit(vector.reshape(count, 3)) for vector in noise_vectors(3 * count)]
    assert not any(one.wrong for one in fits)
    errors = np.array([one.estimates - true for one in fits])
    assert_close(np.sqrt((errors**2).mean(0) / np.diag(bound)), 1.0, atol=0.02)
    assert_close(
        np.sqrt(np.mean([np.diag(one.covariance) for one in fits], 0) / np.diag(bound)), 1.0, atol=0.02
    )


@CASES
def test_wrong_row_is_named_and_left_out(fit, count, true, bound):
    for wrong in range(1, 4):
        result = fit(random_noise(count, wrong, wrong))
        (found,) = result.wrong
        assert (found.row, found.place) == (wrong, result.rows.place(wrong))
        assert_close(found.distance, 5e-3, atol=4e-4)
        assert found.probability < 1e-6
        assert (np.abs(result.estimates - true) < 8 * np.sqrt(np.diag(bound))).all()


def test_undetermined_directions_are_named():
    q = touching_joints(5, axis=0)
    (weak,) = fit_frames(UR5, touches(q, random_noise(5, 1)), "tool", {}).weak_directions
    assert weak.words == "tool_x"
    assert 100 < weak.deviation < np.inf  # the noise turns the tip by 0.3 mrad
    exact = fit_frames(UR5, touches(q, np.zeros((5, 3))), "tool", {})
    assert exact.undetermined == {exact.solved.problem.space.index("tool_x")}
    assert_close(exact.estimates[1:], TIP[1:3], atol=1e-9)


def test_hand_eye_of_poses_gives_back_base_and_tool():
    true = UR5.with_geometry(base=BASE, tool=np.array([0.02, 0.03, 0.1, 0.3, -0.1, 0.2]))
    T = forward_kinematics(true, POINTS)
    rows = Measurements(q=POINTS, position=T[:, :3, 3], rotation=T[:, :3, :3])
    fit = fit_frames(UR5, rows, "hand-eye", {})
    assert_close(fit.estimates, np.concatenate([true.base, true.tool]), atol=1e-9)
    assert not fit.weak_directions
    predicted = fit.solved.result().predicted_poses(rows)
    assert_close(xyzrpy_from_transform(predicted), xyzrpy_from_transform(T), atol=1e-9)


def test_too_few_rows_are_refused():
    with pytest.raises(IdentificationError) as refusal:
        fit_frames(UR5, touches(touching_joints(2), random_noise(2, 0)), "tool", {})
    assert refusal.value.value == 6
