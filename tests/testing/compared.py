"""Models of one simulated arm that were made from different rows, for tests."""

import math

import torch
from testing.aged import NAME, rows_after_change
from testing.hybrid import hybrid_of
from testing.models import no_type_checker
from testing.stored import stored

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.geometric_model import model_of_hybrid

COLLISION = (0.0, 0.0, math.radians(0.1), 0.0, 0.0, 0.0)
"""Change of the joint zeros [rad]: joint 3 by 0.1 deg."""
CARRIED = (0.3, -0.2, 0.1, 0.4, 0.02, -0.03)
"""Motion of the relocated instrument."""


@stored
def model_of(
    seed: int, moved: tuple[float, ...] = (0.0,) * 6, base: tuple[float, ...] = (0.0,) * 6
) -> CalibratedModel:
    """Return a hybrid calibration with 80 rows; for the arguments see `testing.aged.rows_after_change`."""
    nominal = hybrid_of(NAME).true.nominal
    rows = rows_after_change(80, seed, moved, base)
    calibrator = HybridCalibrator(
        GeometricCalibrator(nominal), features=("gravity", "series"), harmonics=(4, 8), products=False
    )
    with no_type_checker():
        return model_of_hybrid(f"rows_{seed}", nominal, calibrator.fit(rows), rows)


def after_collision() -> CalibratedModel:
    """Return the model of the arm with joint 3 moved by 0.1 deg, measured by a relocated instrument."""
    return model_of(60, COLLISION, CARRIED)


def joints_of(model: CalibratedModel, count: int) -> torch.Tensor:
    """Return some joint values [rad or m] that a model stores."""
    return model.starts[:count]
