"""Measurement noise: standard deviation, independence and seed."""

import math

import pytest
import torch
from pydantic import ValidationError
from testing.closeness import assert_close

from pisigma.robot.se3 import check_transforms, pose_error, transform_from_xyz_zyx
from pisigma.simulation.noise import MeasurementNoise


def poses(count: int, generator: torch.Generator) -> torch.Tensor:
    return transform_from_xyz_zyx(torch.randn(count, 6, generator=generator, dtype=torch.float64))


def test_noise_has_its_standard_deviation_on_every_axis(generator):
    T = poses(20_000, generator)
    measured = MeasurementNoise(position_mm=0.05, orientation_deg=0.2, seed=1).apply(T)
    check_transforms(measured, "measured", tolerance=1e-13)
    error = pose_error(measured, T)
    assert_close(error.mean(0)[:3], 0.0, atol=5 * 5e-5 / math.sqrt(20_000))
    assert_close(error.mean(0)[3:], 0.0, atol=5 * math.radians(0.2) / math.sqrt(20_000))
    assert_close(error.std(0)[:3], 5e-5, rtol=0.03)
    assert_close(error.std(0)[3:], math.radians(0.2), rtol=0.03)
    correlation = torch.corrcoef(error.T) - torch.eye(6)
    assert float(correlation.abs().max()) < 0.03


def test_seeds_repeat_and_differ(generator):
    T = poses(10, generator)
    first, again, other = (
        MeasurementNoise(position_mm=1, orientation_deg=1, seed=s).apply(T) for s in (1, 1, 2)
    )
    assert_close(first, again)
    assert float((first - other).abs().amax((1, 2)).min()) > 1e-4


def test_without_noise_poses_are_unchanged(generator):
    T = poses(10, generator)
    assert_close(MeasurementNoise(seed=1).apply(T), T)


def test_orientation_noise_does_not_change_the_noise_of_positions(generator):
    T = poses(10, generator)
    alone = MeasurementNoise(position_mm=1, seed=3).apply(T)
    both = MeasurementNoise(position_mm=1, orientation_deg=1, seed=3).apply(T)
    assert_close(alone[:, :3, 3], both[:, :3, 3])


@pytest.mark.parametrize("fields", [{"position_mm": 1}, {"position_mm": -1, "seed": 0}])
def test_noise_needs_a_seed_and_no_negative_size(fields):
    with pytest.raises(ValidationError):
        MeasurementNoise(**fields)
