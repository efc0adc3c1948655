"""Noise of the sensors of a calibration, for rows with and without stated standard deviations."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from pisigma.files.errors import MeasurementError, Phrase
from pisigma.measurement.sensors.sensor import AbstractSensor

JOINT = "joint"
"""Name of the standard deviation of the values of revolute joints from image to image [rad]."""
_MAX_ABSOLUTE = 0.01
"""Largest noise [m or rad]; in folders of earlier versions, a larger noise is a factor on stated standard
deviations."""


@dataclass(frozen=True)
class CalibrationNoise:
    """Noise of the sensors of a calibration: standard deviations, or factors on stated standard deviations.

    Attributes:
        value: standard deviation of the readings by sensor [m or rad]; a factor on the stated standard deviations if
            the rows state them. Also that of `JOINT`, if images show that joints scatter.
        median_stated_sigma: median of the stated standard deviations [m or rad], by sensor whose rows state them; None
            for folders of earlier versions, which do not store it.
    """

    value: Mapping[str, float] = field(default_factory=dict)
    median_stated_sigma: Mapping[str, float] | None = field(default_factory=dict)

    def is_factor(self, name: str) -> bool:
        """Return whether the value of a sensor is a factor on stated standard deviations."""
        return (
            self.value[name] > _MAX_ABSOLUTE
            if self.median_stated_sigma is None
            else name in self.median_stated_sigma
        )

    def standard_deviation(self, name: str) -> float:
        """Return the standard deviation of a sensor [m or rad]; NaN if it is unknown."""
        if name not in self.value or not self.is_factor(name):
            return self.value.get(name, math.nan)
        return (
            math.nan
            if self.median_stated_sigma is None
            else self.value[name] * self.median_stated_sigma[name]
        )

    def updated(self, other: "CalibrationNoise") -> "CalibrationNoise":
        """Return the noise, with the noise of the sensors in `other` replaced."""
        value = {**self.value, **other.value}
        if (
            self.median_stated_sigma is None and value.keys() != other.value.keys()
        ):  # unknown for the sensors that are kept
            return CalibrationNoise(value, None)
        kept = {
            name: sigma for name, sigma in (self.median_stated_sigma or {}).items() if name not in other.value
        }
        return CalibrationNoise(value, kept | dict(other.median_stated_sigma or {}))

    def noise_of_earlier_rows(self, sensor: AbstractSensor) -> float | None:
        """Return the noise of earlier rows of a sensor, in the form required by its new rows; None for a new sensor.

        Args:
            sensor: sensor with the rows.

        Raises:
            MeasurementError: the noise of the calibration is a factor on stated standard deviations, and the new
                rows state none.
        """
        name = sensor.name
        if name not in self.value:
            return None
        if sensor.sigma is None and self.is_factor(name):
            if math.isnan(usual := self.standard_deviation(name)):
                raise MeasurementError(
                    expected=f"rows that state the standard deviation of {name}, as those of the calibration do",
                    value=Phrase("none"),
                    remedy="add the column (such as sigma_mm), or calibrate again with this version",
                )
            return usual
        if sensor.sigma is not None and not self.is_factor(name):
            # a calibration never reduces stated standard deviations
            return max(self.value[name] / median_sigma(sensor), 1.0)
        return self.value[name]


def median_stated_sigmas(sensors: Iterable[AbstractSensor]) -> dict[str, float]:
    """Return the median of the stated standard deviations [m or rad], by sensor whose rows state them."""
    return {sensor.name: median_sigma(sensor) for sensor in sensors if sensor.sigma is not None}


def median_sigma(sensor: AbstractSensor) -> float:
    """Return the median of the stated standard deviations of a sensor [m or rad]."""
    assert sensor.sigma is not None
    return float(sensor.sigma[sensor.present].nanmedian())
