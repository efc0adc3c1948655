"""Bases of two arms: what one least-squares fit of all rows gives, honest errors, and arms that disagree."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import OptimizeResult, least_squares
from testing.closeness import assert_close
from testing.models import no_type_checker
from testing.refusals import refused
from testing.two_arms import (
    BASES,
    FRAMES,
    FREE,
    NOISE,
    TIP,
    TOOL,
    UR5,
    own_fit,
    pose_of,
    posterior,
    posteriors,
    touching_rows,
    true_arm,
)

from pisigma.calibration.frames.arm_bases import fit_arm_bases
from pisigma.calibration.frames.shared_objects import ArmPosterior, Postures
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.files.errors import IdentificationError
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kernels.array_kinematics import forward_kinematics
from pisigma.robot.se3 import invert, pose_error, rotation_from_vector, rotation_vector, transform

SOCKETS = 6


def fitted_arm(fit: CalibrationResult) -> Robot:
    """Return the calibrated arm with its base at the origin."""
    return fit.robot.with_geometry(base=np.zeros(6))


def own_fits(seed: int, sensor: str) -> list[CalibrationResult]:
    """Return the fits of both arms; those that only touch one another are in a frame each."""
    frames = ("hall", "jig") if sensor == "touches" else (sensor, sensor)
    return [own_fit(number, seed, frame) for number, frame in enumerate(frames)]


def touching_arms(seed: int, tip: str = "") -> tuple[ArmPosterior, ArmPosterior]:
    """Return arms that were measured in a frame each and touched one another."""
    left, right = (
        posterior(name, fit, touching_rows(number, seed, tip))
        for number, (name, fit) in enumerate(zip(("left", "right"), own_fits(seed, "touches"), strict=True))
    )
    return left, right


def predicted(arm: np.ndarray, in_frame: np.ndarray, q: torch.Tensor) -> np.ndarray:
    """Return positions of the tool in the frames of rows; `arm` has free parameters, then the tool."""
    values = UR5.dh.copy()
    for name, value in zip(FREE, arm, strict=False):
        values[int(name[-1]) - 1, 0] = value
    robot = UR5.with_geometry(values, base=np.zeros(6), tool=np.array([*arm[len(FREE) :], 0.0, 0.0, 0.0]))
    p = forward_kinematics(robot, q.numpy())[:, :3, 3]
    return np.einsum("rij,rj->ri", in_frame[:, :3, :3], p) + in_frame[:, :3, 3]


def fitted_together(seed: int, sensor: str) -> OptimizeResult:
    """Fit both arms and the second base at once by scipy, with the noise of the arms' own fits."""
    fits = own_fits(seed, sensor)
    arms = touching_arms(seed) if sensor == "touches" else posteriors(seed, sensor)
    own = len(FREE) + 3
    guess = np.concatenate(
        [[*(fit.robot.dh[int(name[-1]) - 1, 0] for name in FREE), *TOOL[:3]] for fit in fits]
    )
    found = fit_arm_bases(arms).T_first_base[1].numpy()
    there = FRAMES if sensor in ("frames", "touches") else {}
    where = (
        [fits[0].sensor_unknowns["socket"][f"plate/{k}"] for k in range(SOCKETS)]
        if sensor == "sockets"
        else []
    )
    start = np.concatenate([guess, np.zeros(6), np.zeros(6 * len(there)), *where])

    touching = [touching_rows(number, seed).q for number in (0, 1)] if sensor == "touches" else []

    def residual(x: np.ndarray) -> np.ndarray:
        second = x[2 * own : 2 * own + 6]
        T_second = np.eye(4)
        T_second[:3, :3] = rotation_from_vector(torch.from_numpy(second[3:])).numpy() @ found[:3, :3]
        T_second[:3, 3] = found[:3, 3] + second[:3]
        rest = x[2 * own + 6 :]
        missed = []
        for q, T_arm, sign in zip(touching, (np.eye(4), T_second), (-1, 1), strict=False):
            part = x[own:] if sign > 0 else x
            missed.append(sign * predicted(part[:own], T_arm[None], q).ravel() / (NOISE * np.sqrt(2)))
        missed = [sum(missed)] if missed else []
        for number, (fit, T_arm) in enumerate(zip(fits, (np.eye(4), T_second), strict=True)):
            rows = fit.solved.measurements
            if sensor == "sockets":
                in_first = np.broadcast_to(T_arm, (rows.rows, 4, 4))
                wanted = rest.reshape(-1, 3)[[int(name.split("/")[1]) for name in rows.socket]]
            else:
                steps = dict(zip(FRAMES, rest.reshape(-1, 6), strict=True))
                moved = {
                    name: transform(
                        rotation_from_vector(torch.from_numpy(step[3:])), torch.from_numpy(step[:3])
                    ).numpy()
                    @ invert(pose_of(FRAMES[name])).numpy()
                    @ T_arm
                    for name, step in steps.items()
                }
                in_first = np.stack([moved[name] for name in rows.frame])
                wanted = rows.position.numpy()
            miss = predicted(x[number * own : (number + 1) * own], in_first, rows.q) - wanted
            missed.append(miss.ravel() / fit.noise[0].sigma)
        return np.concatenate(missed)

    return least_squares(residual, start, x_scale="jac", xtol=1e-9, ftol=1e-12)


@pytest.mark.parametrize("sensor", ["frames", "sockets", "touches"])
def test_posterior_is_that_of_one_fit_of_all_rows(sensor):
    found = fit_arm_bases(touching_arms(0) if sensor == "touches" else posteriors(0, sensor))
    with no_type_checker():
        peer = fitted_together(0, sensor)
    second = slice(2 * (len(FREE) + 3), 2 * (len(FREE) + 3) + 6)
    covariance = np.linalg.inv(peer.jac.T @ peer.jac)[second, second]
    error = np.sqrt(np.diag(covariance))
    assert_close(peer.x[second] / error, 0.0, atol=0.03)
    assert_close(found.covariance_root[1].norm(dim=1).numpy() / error, 1.0, atol=0.01)
    misfit = peer.fun @ peer.fun - sum(
        np.square(fit.residuals[fit.noise[0].sensor]).sum() / fit.noise[0].sigma ** 2
        for fit in own_fits(0, sensor)
    )
    assert_close(found.conditioned.misfit, misfit, rtol=0.02)
    assert (
        found.conditioned.degrees_of_freedom
        == {"frames": 6, "sockets": 3 * SOCKETS - 6, "touches": 54}[sensor]
    )


@pytest.mark.parametrize("sensor", ["hall", "sockets"])
def test_base_is_found_within_its_errors(sensor):
    found = fit_arm_bases(posteriors(1, sensor))
    T, covariance = found.relative(0, 1)
    error = pose_error(pose_of(BASES[1]), T)
    assert float(error @ torch.linalg.solve(covariance, error)) < 17  # 99 % of chi-squared with 6 degrees
    back, turned = found.relative(1, 0)
    assert_close(back, invert(T), atol=1e-12)
    assert float((rotation_vector(back[:3, :3])).norm()) > 2.5
    assert_close(turned[3:, 3:].trace(), covariance[3:, 3:].trace(), rtol=1e-9)
    assert found.disagreements == ()


def test_frame_that_moved_between_the_arms_is_named():
    left, right = posteriors(2, "sockets")
    geometry = right.uncertainty.geometry
    moved = {name: point.copy() for name, point in geometry.unknowns["socket"].items()}
    moved["plate/2"] += [1e-3, 0.0, 0.0]
    shifted = replace(
        right,
        uncertainty=replace(right.uncertainty, geometry=replace(geometry, unknowns={"socket": moved})),
    )
    assert fit_arm_bases((left, right)).disagreements == ()
    worst, *_ = fit_arm_bases((left, shifted)).disagreements
    assert worst.shared.name == "plate/2"


def test_vector_between_the_tools_is_known_as_stated():
    rng, errors, stated = np.random.default_rng(0), [], []
    q = [torch.from_numpy(rng.uniform(-2, 2, (100, 6))) for _ in BASES]
    postures = tuple(Postures(JointState.from_measurements(Measurements(q=one)), one) for one in q)
    for seed in range(6):
        found = fit_arm_bases(posteriors(seed, "hall"))
        tools = [
            [pose[:3, :3] @ p + pose[:3, 3] for p in forward_kinematics(robot, own.numpy())[:, :3, 3]]
            for number, own in enumerate(q)
            for pose, robot in (
                (found.T_first_base[number].numpy(), fitted_arm(own_fit(number, seed, "hall"))),
                (pose_of(BASES[number]).numpy(), true_arm(number, seed)),
            )
        ]
        between = np.array(tools[2]) - tools[0] - (np.array(tools[3]) - tools[1])
        errors.append(np.square(between).sum(1).mean())
        stated.append(found.tool_to_tool_sigma(0, 1, postures) ** 2)
    assert_close(np.sqrt(np.mean(errors) / np.mean(stated)), 1.0, atol=0.25)


def test_three_arms_are_connected_through_the_second_one():
    chain = (
        posterior("left", own_fit(0, 3, "hall")),
        posterior("middle", own_fit(1, 3, "frames")),
        posterior("right", own_fit(0, 4, "jig")),
    )
    found = fit_arm_bases(chain)
    assert [one.name for one in found.shared] == ["hall", "jig"]
    assert_close(found.T_first_base[2], np.eye(4), atol=2e-4)
    sides = [found.relative(a, b)[1][:3, :3].trace() for a, b in ((0, 1), (1, 2), (0, 2))]
    assert float(sides[2]) > max(map(float, sides[:2]))


def test_arms_without_anything_in_common_are_refused():
    hall, jig = posterior("left", own_fit(0, 3, "hall")), posterior("right", own_fit(0, 4, "jig"))
    with refused(IdentificationError, value="none"):
        fit_arm_bases((hall, jig))


def test_frame_with_an_undetermined_direction_is_not_shared():
    left, right = posteriors(1, "hall")
    rows = list(right.base_indices("hall"))
    root = right.covariance_root.clone()
    direction = torch.tensor([0.6, 0.8, 0, 0, 0, 0], dtype=torch.float64)
    root[rows] -= direction[:, None] * (direction @ root[rows])
    held = replace(right.uncertainty, covariance_root=CovarianceRoot(root))
    with refused(IdentificationError, value="none"):
        fit_arm_bases((left, replace(right, uncertainty=held)))


def test_order_of_the_arms_does_not_matter():
    left, right = posteriors(1, "frames")
    one, other = fit_arm_bases((left, right)), fit_arm_bases((right, left))
    assert_close(one.T_first_base[1], invert(other.T_first_base[1]), atol=1e-9)
    assert_close(one.relative(0, 1)[1], other.relative(1, 0)[1], rtol=1e-6, atol=1e-16)


@pytest.mark.parametrize("tip", ["", "tip"])
def test_arms_that_touch_are_connected(tip):
    scores = []
    for seed in range(4):
        found = fit_arm_bases(touching_arms(seed, tip))
        T, covariance = found.relative(0, 1)
        error = pose_error(pose_of(BASES[1]), T)
        scores.append(float(error @ torch.linalg.solve(covariance, error)))
        assert found.disagreements == ()
        assert found.conditioned.degrees_of_freedom == 20 * 3 - (12 if tip else 6)
        for position in found.tips.values():
            assert_close(position, torch.from_numpy(TIP[:3]), atol=5e-4)
    assert np.sum(scores) < 43  # 99 % of chi-squared with 24 degrees


def test_wrong_touch_is_named():
    left, right = touching_arms(1, "")
    assert right.touches is not None
    q = right.touches.postures.q_corrected.clone()
    q[7, 1] += 2e-3
    state = JointState.from_measurements(Measurements(q=q))
    wrong = replace(right, touches=replace(right.touches, postures=Postures(state, q)))
    (worst, *_) = fit_arm_bases((left, wrong)).disagreements
    assert worst.shared.key == ("touch", "touch 7")


def test_touches_of_one_arm_and_too_few_touches_are_refused():
    left, right = touching_arms(1, "tip")
    with refused(IdentificationError, value=["left"], option="touches"):
        fit_arm_bases((left, replace(right, touches=None)))
    few = [
        posterior(name, own_fit(k, 1, "hall"), touching_rows(k, 1, "tip", 3)) for k, name in enumerate("ab")
    ]
    separate = [few[0], replace(few[1], uncertainty=right.uncertainty)]
    with refused(IdentificationError):
        fit_arm_bases(separate)
