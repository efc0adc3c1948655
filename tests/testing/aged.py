"""Models of simulated arms, and rows that were measured on the same arms later."""

import functools

import numpy as np
import torch
from testing.hybrid import NOISE, hybrid_of, joints_in
from testing.models import no_type_checker

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.robot.se3 import transform_from_xyz_zyx

NAME = "rb5"


@functools.cache
def original_model() -> CalibratedModel:
    """Return the hybrid calibration of the arm."""
    under_test = hybrid_of(NAME)
    with no_type_checker():
        return model_of_hybrid(NAME, under_test.true.nominal, under_test.result, under_test.measurements)


def rows_after_change(
    rows: int,
    seed: int,
    moved: tuple[float, ...] = (0.0,) * 6,
    base: tuple[float, ...] = (0.0,) * 6,
    noise: float = NOISE,
) -> Measurements:
    """Measure positions of the arm at other joint values.

    Args:
        rows: number of rows.
        seed: random seed of joint values and noise.
        moved: change of the joint zeros [rad].
        base: motion of the instrument, x, y, z [m], roll, pitch, yaw [rad].
        noise: standard deviation of a coordinate [m].
    """
    true = hybrid_of(NAME).true
    q = joints_in(true.nominal, rows, seed)
    T = transform_from_xyz_zyx(torch.tensor(base).double()) @ true.forward(q + torch.tensor(moved).double())
    drawn = np.random.default_rng(seed).normal(size=(rows, 3))
    return Measurements(q=q, position=T[:, :3, 3] + noise * torch.from_numpy(drawn))
