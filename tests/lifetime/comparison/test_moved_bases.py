"""A base or a frame that was bumped: named with its motion, and no false alarm."""

from dataclasses import replace
from functools import lru_cache

import pytest
import torch
from testing.closeness import assert_close
from testing.models import no_type_checker
from testing.refusals import refused
from testing.two_arms import BASES, FRAMES, UR5, own_fit, pose_of, posterior, rows_now

from pisigma.calibration.frames.arm_bases import fit_arm_bases
from pisigma.calibration.frames.shared_objects import uncertainty_of
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.files.errors import IdentificationError
from pisigma.lifetime.comparison.moved_bases import MovedBases, RemeasuredArm, find_moved_bases
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.frame_model import frames_of_model
from pisigma.model.geometric_model import model_of_calibration
from pisigma.robot.se3 import rotation_from_vector, transform

NAMES = ("left", "right")
STILL = torch.eye(4, dtype=torch.float64)


@lru_cache(maxsize=64)
def model(number: int, seed: int) -> CalibratedModel:
    """Return a calibrated arm with the posterior of its parameters."""
    fit = own_fit(number, seed, "hall")
    made = model_of_calibration(NAMES[number], UR5, fit, fit.solved.measurements)
    return replace(made, uncertainty=uncertainty_of(fit))


def moved(seed: int, bump: torch.Tensor, *bodies: str) -> MovedBases:
    """Return what is found after a motion of one body, or of another one for every arm."""
    with no_type_checker():
        before = [posterior(name, own_fit(number, seed, "hall")) for number, name in enumerate(NAMES)]
        T = fit_arm_bases(before).T_first_base
        now = [
            frames_of_model(model(k, seed), rows_now(k, seed, bump, bodies[k % len(bodies)]), "base")
            for k in range(2)
        ]
        return find_moved_bases([RemeasuredArm(*one) for one in zip(before, T, now, strict=True)])


def bump(millimetres: float, milliradians: float) -> torch.Tensor:
    """Return a motion in the base of the first arm."""
    direction = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64)
    return transform(
        rotation_from_vector(milliradians * 1e-3 * direction.flip(0)), millimetres * 1e-3 * direction
    )


def test_nothing_is_named_if_nothing_moved():
    found = [moved(seed, STILL, "") for seed in range(12)]
    assert not any(one.likely_bodies for one in found)
    assert all(one.is_one_body for one in found)
    # without faults, probabilities are uniform between 0 and 1
    assert 0.2 < sum(one.p_value for one in found) / len(found) < 0.8


@pytest.mark.parametrize("body", ["left", "right", "hall"])
def test_bumped_body_is_named_with_its_motion(body):
    found = moved(0, bump(0.5, 0.5), body)
    (one,) = found.likely_bodies
    origin = pose_of({"left": BASES[0], "right": BASES[1], "hall": FRAMES["hall"]}[body])[:3, 3]
    M = bump(0.5, 0.5)
    true = torch.cat(
        [M[:3, :3] @ origin + M[:3, 3] - origin, 0.5e-3 * torch.tensor([-0.8, 0.0, 0.6]).double()]
    )
    error = torch.cat([one.shift, one.rotation]) - true
    assert (one.kind, one.name) == ("frame" if body == "hall" else "arm", body)
    assert float(error @ torch.linalg.solve(one.covariance, error)) < 30  # few degrees of freedom
    assert_close(error[:3].norm(), 0.0, atol=2e-4)


@pytest.mark.parametrize("body", ["right", "hall"])
def test_shift_of_a_large_motion_is_not_linearised(body):
    M = bump(30.0, 80.0)
    origin = pose_of({"right": BASES[1], "hall": FRAMES["hall"]}[body])[:3, 3]
    (one,) = moved(0, M, body).likely_bodies
    assert_close(one.shift, M[:3, :3] @ origin + M[:3, 3] - origin, atol=3e-4)


def test_larger_motion_is_that_of_one_body_only():
    found = moved(1, bump(30.0, 20.0), "right")
    (one,) = found.likely_bodies
    assert one.name == "right"
    assert found.bodies[1].log_likelihood < one.log_likelihood - 100


def test_two_bodies_that_moved_are_not_explained_by_one():
    assert not moved(0, bump(0.5, 0.5), "left", "hall").is_one_body
    assert moved(0, bump(0.5, 0.5), "left").is_one_body


def test_frame_whose_base_was_not_determined_is_not_compared():
    with no_type_checker():
        known = posterior("left", own_fit(0, 0, "hall"))
        found = frames_of_model(model(0, 0), rows_now(0, 0, STILL, ""), "base")
    assert RemeasuredArm(known, STILL, found).frames == ("hall",)
    root = known.covariance_root.clone()
    root[known.base_indices("hall")[0]] = 0.0
    held = replace(known.uncertainty, covariance_root=CovarianceRoot(root))
    arm = RemeasuredArm(replace(known, uncertainty=held), STILL, found)
    assert arm.frames == ()
    with refused(IdentificationError, value="hall"):
        find_moved_bases([arm])
