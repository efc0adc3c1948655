"""Rows that a calibration takes for wrong."""

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.setup import CalibrationSetup
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.sensor import AbstractSensor


@dataclass(frozen=True)
class Outlier:
    """A row that counted for less than half.

    Attributes:
        row: its number in the measurements, from 0.
        place: file and line, or source and row, as complaints name the row.
        sensor: which value of the row.
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
    """Name the rows of a sensor that count for less than half.

    Args:
        setup: whose problem the rows are of.
        measurements: that it was made from.
        sensor: that saw them.
        rows: their numbers in the problem.
        length: of their residuals [m or rad].
        deviations: the same in standard deviations of one value.
        weight: how much they count.
    """
    outliers = []
    for k in (weight < 0.5).nonzero()[:, 0].tolist():
        row = int(setup.rows[rows[k]])
        where = measurements.place(row)
        outliers.append(Outlier(row, where, sensor.name, float(length[k]), float(deviations[k]), sensor.unit))
    return outliers
