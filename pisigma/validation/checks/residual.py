"""Whether the measured values are related to the predictions of the robot at all."""

import math
from collections.abc import Iterator

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.identifiability.plausibility import IMPLAUSIBLE_SHARE
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.registry import SENSORS
from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic

UNEXPLAINED = 0.5
"""Residuals over the spread of the positions above which the joints explain less than three quarters of the variance.
For a healthy robot the ratio is below 0.01."""


class ResidualCheck(AbstractCheck):
    """Compares the residuals of every sensor with the reach of the robot, and those of positions with their spread.

    Half of the measured lengths must be within 1 % of the reach per axis, and half of the measured angles within
    0.01 rad, which moves a point at the distance of the reach equally far. No calibration error is this large.
    """

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        robot, by_images = checked.robot, "corner" in checked.rows.kinds
        rows = "images and joint values" if by_images else "rows and positions"
        for sensor, errors in checked.final_errors.items():
            typical = _typical(errors)
            if SENSORS[sensor].unit == "rad":
                limit, size = IMPLAUSIBLE_SHARE, f"{typical:.3g} rad"
            else:
                limit, size = IMPLAUSIBLE_SHARE * robot.reach, f"{typical * 1e3:.3g} mm"
                if sensor == "position":
                    limit = min(limit, UNEXPLAINED * _spread(checked.rows))
            if typical > limit > 0:
                before = _typical(checked.errors["nominal"][sensor]) / typical
                yield Diagnostic(
                    kind="residual",
                    severity="implausible",
                    sentence=f"With the best fit, the median residual of {sensor} is still {size} per axis "
                    f"({before:.3g} times as large for the nominal robot '{robot.name}'), which no calibration error "
                    f"explains; check units, order, signs and zeros of the joint columns, whether {rows} belong "
                    f"together, {'the lengths of the board, ' if by_images else ''}and whether this robot was "
                    "measured.",
                    cause=sensor,
                    values={f"residual_{SENSORS[sensor].unit}": typical},
                )


def _typical(errors: Float64[Tensor, "rows components"]) -> float:
    """Compute the median length of the errors per component [m or rad]."""
    length: float = errors.norm(dim=-1).nanmedian().item()
    return length / math.sqrt(errors.shape[-1])


def _spread(rows: Measurements) -> float:
    """Compute the standard deviation of the coordinates of the positions about their mean in each frame [m]."""
    assert rows.position is not None
    squares = []
    for name in dict.fromkeys(rows.frame):
        position = rows.position[torch.tensor([frame == name for frame in rows.frame])]
        squares.append((position - position.nanmean(0)).square())
    return float(torch.cat(squares).nanmean().sqrt())
