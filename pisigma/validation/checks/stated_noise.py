"""Check whether the standard deviations stated in the rows agree with the residuals."""

import math
from collections.abc import Iterator
from dataclasses import replace

from pisigma.calibration.geometric.problem.noise import contributions_and_noise_of
from pisigma.files.errors import IdentificationError
from pisigma.validation.checks.check import CheckedCalibration
from pisigma.validation.held_out.calibration_validation import pose_errors_of
from pisigma.validation.held_out.diagnostic import Diagnostic

_DISAGREEING = 3.0
"""Ratio of residuals and stated standard deviations above which (or below whose inverse) a warning is given. A stated
standard deviation is a manufacturer's bound or an estimate, and rarely correct to better than a factor of 2."""
_CHI_MEDIAN = {1: 0.6745, 3: 1.5382}
"""Median length of a standard normal vector by its number of components."""
_HELD_BACK = 0.5
"""Ratio of the residuals without and with the stated noise below which the stated noise impaired the calibration."""


def check_stated_noise(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Compare the median residual with the standard deviations stated in the rows.

    The median of n values has a relative standard deviation of about `1 / sqrt(n)`; the tolerance is three times
    this value.
    """
    solved = checked.geometric.solved
    learned = None if checked.hybrid is None else checked.hybrid.learned
    for sensor, part in zip(
        solved.problem.sensors,
        contributions_and_noise_of(solved.refined_linearisation).contributions,
        strict=True,
    ):
        if sensor.sigma is None or sensor.are_values_given or sensor.components not in _CHI_MEDIAN:
            continue
        distance = part.residual_length[sensor.present]
        ratio = float(distance.median()) / _CHI_MEDIAN[sensor.components]
        margin = math.exp(3 / math.sqrt(len(distance)))
        larger = ratio if learned is None else learned.noise[sensor.name]
        if larger > _DISAGREEING * margin:
            yield Diagnostic(
                kind="stated_noise",
                severity="warning",
                sentence=f"The residuals of {sensor.name} are {larger:.3g} times as large as the standard "
                "deviations stated in the rows, which were multiplied by this factor; check their unit, and whether "
                "the model lacks an effect.",
                cause=sensor.name,
                values={"residual_over_stated": larger},
            )
        elif ratio * margin < 1 / _DISAGREEING:
            yield _too_large(checked, sensor.name, 1 / max(ratio, 1e-9))


def _too_large(checked: CheckedCalibration, sensor: str, factor: float) -> Diagnostic:
    held_back = _share_without(checked) < _HELD_BACK
    consequence = (
        "and the arm is fitted far better without them, so they impaired the calibration;"
        if held_back
        else "so all predicted intervals are too wide;"
    )
    return Diagnostic(
        kind="stated_noise",
        severity="implausible" if held_back else "warning",
        sentence=f"The standard deviations stated in the rows for {sensor} are {factor:.3g} times as large as the "
        f"residuals, {consequence} check the unit of the column, or omit it.",
        cause=sensor,
        values={"residual_over_stated": 1 / factor},
    )


def _share_without(checked: CheckedCalibration) -> float:
    """Compute the ratio of the RMS residuals of geometric calibrations without and with the stated noise."""
    rows = replace(checked.rows, sigma_position=None, sigma_rotation=None)
    try:
        without = pose_errors_of(checked.calibrator.fit(rows), rows).position
    except IdentificationError:
        return 1.0
    return float(
        (
            without.square().nanmean() / pose_errors_of(checked.geometric, rows).position.square().nanmean()
        ).sqrt()
    )
