"""Outliers of a calibration: rows with small robust weights."""

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.setup import CalibrationSetup
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.sensor import AbstractSensor


@dataclass(frozen=True)
class Outlier:
    """A row with less than half of the full robust weight.

    Attributes:
        row: index of the row in the measurements, from 0.
        place: file and line, or source and row, as in error messages.
        sensor: kind of sensor of the value.
        residual: length of the residual [m or rad].
        residual_in_sigmas: length of the residual in standard deviations of one value.
        unit: "m" or "rad".
    """

    row: int
    place: str
    sensor: str
    residual: float
    residual_in_sigmas: float
    unit: Literal["m", "rad"]


def outliers_of(
    setup: CalibrationSetup,
    measurements: Measurements,
    sensor: AbstractSensor,
    rows: Int64[Tensor, " values"],
    residual_length: Float64[Tensor, " values"],
    residual_in_sigmas: Float64[Tensor, " values"],
    weight: Float64[Tensor, " values"],
) -> list[Outlier]:
    """Return the rows of a sensor with less than half of the full weight.

    Args:
        setup: setup of the problem that contains the rows.
        measurements: measurements from which the setup was made.
        sensor: the sensor.
        rows: indices of the rows in the problem.
        residual_length: lengths of the residuals of these rows [m or rad].
        residual_in_sigmas: length of the residual in standard deviations of one value.
        weight: weights of the rows.
    """
    outliers = []
    for k in (weight < 0.5).nonzero()[:, 0].tolist():
        row = int(setup.row_indices[rows[k]])
        where = measurements.place(row)
        outliers.append(
            Outlier(
                row, where, sensor.name, float(residual_length[k]), float(residual_in_sigmas[k]), sensor.unit
            )
        )
    return outliers
