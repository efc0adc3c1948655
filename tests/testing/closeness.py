"""The only comparison of numbers in tests: it asserts, and NaN never passes."""

import numpy as np
import torch
from torch import Tensor

from pisigma.robot import Robot
from pisigma.robot.se3 import wrap_to_pi


def _to_numpy(value: object) -> np.ndarray:
    return value.detach().cpu().numpy() if isinstance(value, Tensor) else np.asarray(value)


def assert_close(actual: object, expected: object, *, atol: float = 0.0, rtol: float = 0.0) -> None:
    """Assert equal shapes (or a scalar expectation), no NaN, and |actual - expected| <= atol + rtol |expected|."""
    a, e = _to_numpy(actual), _to_numpy(expected)
    assert e.ndim == 0 or a.shape == e.shape, f"shapes differ: {a.shape} and {e.shape}"
    assert not np.isnan(a).any(), f"{int(np.isnan(a).sum())} actual values are NaN"
    assert not np.isnan(e).any(), "an expected value is NaN"
    np.testing.assert_allclose(a, np.broadcast_to(e, a.shape), atol=atol, rtol=rtol)


def joint_distance(robot: Robot, a: Tensor, b: Tensor) -> Tensor:
    """Compute the largest difference of two sets of joint values [rad or m], up to full turns of revolute joints."""
    difference = torch.where(torch.tensor(robot.revolute), wrap_to_pi(a - b), a - b)
    return difference.abs().amax(-1)
