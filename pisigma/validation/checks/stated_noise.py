"""Whether the standard deviations that rows state agree with their residuals."""

import math
from collections.abc import Iterator
from dataclasses import replace

from pisigma.calibration.geometric.problem.noise import view_of
from pisigma.files.errors import IdentificationError
from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.held_out.calibration_validation import errors_under
from pisigma.validation.held_out.diagnostic import Diagnostic

DISAGREEING = 3.0
"""Residuals so many times as large as stated, or as small, are worth a warning. A stated standard deviation is a
manufacturer's bound or an estimate, and rarely better than to a factor of 2."""
CHI_MEDIAN = {1: 0.6745, 3: 1.5382}
"""Median length of a standard normal vector by its number of components."""
HELD_BACK = 0.5
"""Share of the residuals that is left without the stated noise, at most, where it has held the calibration back."""


class StatedNoiseCheck(AbstractCheck):
    """Compares the median residual with what the rows state.

    The median of n values has a relative standard deviation of about `1 / sqrt(n)`; three of these are granted.
    """

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        solved = checked.geometric.solved
        learned = None if checked.hybrid is None else checked.hybrid.learned
        for sensor, sums in zip(solved.problem.sensors, view_of(solved.refined).sums, strict=True):
            if sensor.sigma is None or sensor.certain or sensor.components not in CHI_MEDIAN:
                continue
            distance = sums.distance[sensor.present]
            ratio = float(distance.median()) / CHI_MEDIAN[sensor.components]
            margin = math.exp(3 / math.sqrt(len(distance)))
            larger = ratio if learned is None else learned.noise[sensor.name]
            if larger > DISAGREEING * margin:
                yield Diagnostic(
                    kind="stated_noise",
                    severity="warning",
                    sentence=f"The residuals of {sensor.name} are {larger:.3g} times as large as the standard "
                    "deviations that the rows state, so these were multiplied by that; check their unit, or measure "
                    "what the model does not explain.",
                )
            elif ratio * margin < 1 / DISAGREEING:
                yield self._too_large(checked, sensor.name, 1 / max(ratio, 1e-9))

    def _too_large(self, checked: CheckedCalibration, sensor: str, factor: float) -> Diagnostic:
        held_back = _share_without(checked) < HELD_BACK
        consequence = (
            "and without them the arm is fitted far better, so they have held the calibration back;"
            if held_back
            else "so that all predicted intervals are too wide;"
        )
        return Diagnostic(
            kind="stated_noise",
            severity="implausible" if held_back else "warning",
            sentence=f"The standard deviations that the rows state for {sensor} are {factor:.3g} times as large as the "
            f"residuals, {consequence} check the unit of the column, or leave it out.",
        )


def _share_without(checked: CheckedCalibration) -> float:
    """RMS residual of a geometric calibration without the stated noise, over that with it."""
    rows = replace(checked.rows, sigma_position=None, sigma_rotation=None)
    try:
        without = errors_under(checked.calibrator.fit(rows), rows).position
    except IdentificationError:
        return 1.0
    return float(
        (
            without.square().nanmean() / errors_under(checked.geometric, rows).position.square().nanmean()
        ).sqrt()
    )
