"""Noise of the sensors of a calibration, and what it means for rows that state their standard deviations or do not."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from pisigma.files.errors import MeasurementError
from pisigma.measurement.sensors.sensor import AbstractSensor

MAX_ABSOLUTE = 0.01
"""[m or rad] No instrument scatters more: a larger value is no standard deviation by itself."""
MIN_FACTOR = 0.5
"""Stated standard deviations are never that far too large: a smaller value is no factor on them."""


@dataclass(frozen=True)
class CalibrationNoise:
    """Noise of the sensors of a calibration, in the form that its rows have.

    Attributes:
        value: by sensor, the standard deviation of its readings [m or rad]; a factor on the stated ones where the rows
            state them.
        stated: by sensor whose rows state them, the median of the stated standard deviations [m or rad]. Folders of
            earlier versions have none.
    """

    value: Mapping[str, float] = field(default_factory=dict)
    stated: Mapping[str, float] = field(default_factory=dict)

    def is_factor(self, name: str) -> bool:
        """Return whether the value of a sensor is a factor on stated standard deviations."""
        return name in self.stated or self.value[name] >= MIN_FACTOR

    def absolute(self, name: str) -> float:
        """Return the standard deviation of a sensor [m or rad]; NaN where it is not known."""
        value = self.value.get(name, math.nan)
        if name in self.stated:
            return value * self.stated[name]
        return value if value <= MAX_ABSOLUTE else math.nan

    def updated(self, other: "CalibrationNoise") -> "CalibrationNoise":
        """Return the noise with that of the sensors of other rows replaced."""
        kept = {name: sigma for name, sigma in self.stated.items() if name not in other.value}
        return CalibrationNoise({**self.value, **other.value}, kept | dict(other.stated))

    def usual(self, sensor: AbstractSensor) -> float | None:
        """Return the noise of earlier rows of a sensor, in the form of its new rows; None for a new sensor.

        Args:
            sensor: sensor with the rows.

        Raises:
            MeasurementError: the calibration knows the noise only as a factor on stated standard deviations, and these
                rows state none.
        """
        name = sensor.name
        if name not in self.value:
            return None
        if sensor.sigma is None and self.is_factor(name):
            if math.isnan(usual := self.absolute(name)):
                raise MeasurementError(
                    expected=f"rows that state the standard deviation of {name}, as those of the calibration do",
                    value="none",
                    remedy="add the column (such as sigma_mm), or calibrate again with this version",
                )
            return usual
        if sensor.sigma is not None and not self.is_factor(name) and self.value[name] <= MAX_ABSOLUTE:
            # a calibration never takes stated standard deviations for too large
            return max(self.value[name] / median_sigma(sensor), 1.0)
        return self.value[name]


def stated_sigmas(sensors: Iterable[AbstractSensor]) -> dict[str, float]:
    """Return the median of the stated standard deviations [m or rad], by sensor whose rows state them."""
    return {sensor.name: median_sigma(sensor) for sensor in sensors if sensor.sigma is not None}


def median_sigma(sensor: AbstractSensor) -> float:
    """Return the median of the stated standard deviations of a sensor [m or rad]."""
    assert sensor.sigma is not None
    return float(sensor.sigma[sensor.present].nanmedian())
