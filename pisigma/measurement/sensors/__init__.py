"""Sensors, one file each, with their columns of measurement files, residuals, derivatives and held-out errors."""

from pisigma.measurement.readings import ReadingColumn, Readings, RowFault, SensorReadings
from pisigma.measurement.sensors.registry import SENSORS, register_sensor
from pisigma.measurement.sensors.sensor import (
    AbstractSensor,
    InitialUnknowns,
    SensorRows,
    UnknownDerivative,
    UnknownGroup,
    Unknowns,
)

__all__ = [
    "SENSORS",
    "AbstractSensor",
    "InitialUnknowns",
    "ReadingColumn",
    "Readings",
    "RowFault",
    "SensorReadings",
    "SensorRows",
    "UnknownDerivative",
    "UnknownGroup",
    "Unknowns",
    "register_sensor",
]
