"""The rotation residual of sensors against the general rotation vector."""

import math

import pytest
import torch
from testing.closeness import assert_close

from pisigma.measurement.sensors.pose import rotation_difference
from pisigma.robot.se3 import rotation_from_vector, rotation_vector


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.3, 2.9, math.pi - 1e-7, math.pi])
def test_difference_is_the_rotation_vector_of_the_product(angle: float) -> None:
    """For small and large turns, and for turns near pi that need the symmetric part."""
    generator = torch.Generator().manual_seed(0)
    axes = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator, dtype=torch.float64), dim=1)
    predicted = rotation_from_vector(torch.randn(50, 3, generator=generator, dtype=torch.float64))
    measured = rotation_from_vector(angle * axes) @ predicted
    found = rotation_difference(measured.permute(1, 2, 0), predicted.permute(1, 2, 0)).t()
    assert_close(found, rotation_vector(measured @ predicted.mT), atol=1e-12)


def test_one_row_near_pi_leaves_the_others_as_they_are() -> None:
    """All rows of a batch are right when one of them is nearly half a turn off."""
    vectors = torch.tensor([[1e-5, 0.0, 2e-5], [3.1415, 0.0, 0.0], [0.2, -0.1, 0.4]], dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64).expand(3, 3, 3).permute(1, 2, 0)
    found = rotation_difference(rotation_from_vector(vectors).permute(1, 2, 0), eye)
    assert_close(found.t(), vectors, atol=1e-12)
