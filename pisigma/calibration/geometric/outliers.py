"""Outliers of a calibration."""

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.setup import CalibrationSetup
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.sensor import AbstractSensor


@dataclass(frozen=True)
class Outlier:
    """A row with less than half of the full weight.

    Attributes:
        row: number in the measurements, from 0.
        place: file and line, or source and row, as in error messages.
        sensor: kind of sensor of the value.
        residual: length of the residual [m or rad].
        deviations: the same in standard deviations of one value.
        unit: "m" or "rad".
    """

    row: int
    place: str
    sensor: str
    residual: float
    deviations: float
    unit: Literal["m", "rad"]


def outliers_of(
    setup: CalibrationSetup,
    measurements: Measurements,
    sensor: AbstractSensor,
    rows: Int64[Tensor, " values"],
    length: Float64[Tensor, " values"],
    deviations: Float64[Tensor, " values"],
    weight: Float64[Tensor, " values"],
) -> list[Outlier]:
    """List the rows of a sensor with less than half of the full weight.

    Args:
        setup: setup with the problem of the rows.
        measurements: measurements that the setup was made from.
        sensor: the sensor.
        rows: numbers of the rows in the problem.
        length: lengths of their residuals [m or rad].
        deviations: the same in standard deviations of one value.
        weight: weights of the rows.
    """
    outliers = []
    for k in (weight < 0.5).nonzero()[:, 0].tolist():
        row = int(setup.rows[rows[k]])
        where = measurements.place(row)
        outliers.append(Outlier(row, where, sensor.name, float(length[k]), float(deviations[k]), sensor.unit))
    return outliers
