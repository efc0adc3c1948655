"""Registry of sensors, and functions that combine all kinds of sensors."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.files.errors import MeasurementError
from pisigma.measurement.csv.columns import find_column
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.readings import READINGS
from pisigma.measurement.sensors.corner import CornerSensor, as_poses
from pisigma.measurement.sensors.distance import AnchorSensor, PairSensor
from pisigma.measurement.sensors.intrinsics import BoardScalePrior, IntrinsicsSensor
from pisigma.measurement.sensors.pose import PositionSensor, RotationSensor, TouchSensor
from pisigma.measurement.sensors.sensor import (
    AbstractSensor,
    SensorRows,
    UnknownGroup,
    distinct_names,
    indices_of_names,
)
from pisigma.measurement.sensors.socket import SocketSensor
from pisigma.robot.kinematics.parameter_jacobian import ToolMotion
from pisigma.robot.se3 import transform

SENSORS: dict[str, type[AbstractSensor]] = {}
"""Classes of sensors by name, in the order of their residuals."""

_OUTLIER_FACTOR, MAX_ITERATIONS = 4.0, 3
"""Residual relative to the owner's median above which a row is an outlier for the owner's unknowns, and number of
iterations of the search for outliers."""

IdentifiedUnknowns = Mapping[str, Mapping[str, Float64[np.ndarray, " columns"]]]
"""Estimated unknowns of sensors by group and owner, in the frame of the owner [m or rad]."""


def register_sensor(sensor: type[AbstractSensor]) -> type[AbstractSensor]:
    """Register a kind of sensor for measurement files, calibration and validation; usable as a class decorator.

    Args:
        sensor: a final subclass of `AbstractSensor`. Its `readings` are the columns that it adds to measurement files;
            only the sensors that come with pisigma may have none.

    Returns:
        The registered class, unchanged.

    Raises:
        MeasurementError: a sensor of that name or one of its columns already exists.
    """
    if sensor.name in SENSORS:
        raise MeasurementError(
            f"a sensor '{sensor.name}' is already registered", value=sensor.name, remedy="choose another name"
        )
    if sensor.readings is not None:
        for column in sensor.readings.columns:
            for name in (f"{column.name}_{unit}" if unit else column.name for unit in column.units):
                if find_column(name) is not None:
                    raise MeasurementError(
                        f"column '{name}' of sensor '{sensor.name}' already exists in measurement files",
                        value=name,
                        remedy="choose another name",
                    )
        READINGS[sensor.name] = sensor.readings
    SENSORS[sensor.name] = sensor
    return sensor


for _sensor in (
    PositionSensor,
    RotationSensor,
    TouchSensor,
    SocketSensor,
    AnchorSensor,
    PairSensor,
    CornerSensor,
    IntrinsicsSensor,
    BoardScalePrior,
):
    register_sensor(_sensor)


def build_sensors(rows: SensorRows) -> list[AbstractSensor]:
    """Return a sensor for every kind of measured values in the rows.

    Raises:
        IdentificationError: only some rows of a kind state a standard deviation.
    """
    built = (sensor.build(rows) for sensor in SENSORS.values())
    return [sensor for sensor in built if sensor is not None]


def unknown_groups(measurements: Measurements) -> tuple[UnknownGroup, ...]:
    """Return the groups of unknowns of all sensors in the rows."""
    groups = (sensor.unknowns(measurements) for sensor in SENSORS.values())
    return tuple(group for group in groups if group is not None)


def sort_pairs_first(measurements: Measurements, rows: Int64[Tensor, " rows"]) -> Int64[Tensor, " rows"]:
    """Sort rows so that pairs come first, with their rows next to each other; other rows keep their order."""
    if measurements.pair is None:
        return rows
    order = distinct_names(measurements.pair)
    number = indices_of_names(measurements.pair, order, measurements.rows).to(rows.device)[rows]
    number = torch.where(number < 0, len(order), number)
    return rows[torch.sort(number, stable=True).indices]


def measured_errors(
    T: Float64[Tensor, "rows 4 4"], measurements: Measurements, unknowns: IdentifiedUnknowns | None
) -> dict[str, Float64[Tensor, "rows components"]]:
    """Return measured minus predicted values for the tool poses that a model predicts.

    Args:
        T: poses of the target according to the model, in the frame of every row.
        measurements: the measurements.
        unknowns: estimated unknowns of the sensors; for other owners see `AbstractSensor.uncalibrated_unknowns`. None
            to fit the unknowns to the rows; the errors of n values with p fitted unknowns of an owner are then
            multiplied by `sqrt(n / (n - p))`, and are NaN without degrees of freedom.

    Returns:
        Errors by sensor [m or rad], NaN in rows without a value; the error of a pair is in both of its rows, and the
        error of an image is the error of its pose. Sensors without rows are left out.

    Raises:
        IdentificationError: the rows of a socket, anchor or other owner of unknowns that was not calibrated do not
            determine them.
    """
    rows = sort_pairs_first(measurements, torch.arange(measurements.rows, device=T.device))
    data = replace(as_poses(measurements, unknowns or {}), sigma_position=None, sigma_rotation=None).select(
        rows
    )
    T = T[rows]
    still = torch.zeros(0, 6, len(T), dtype=T.dtype, device=T.device)
    motion = ToolMotion(T[:, :3, 3].t(), T[:, :3, :3].permute(1, 2, 0), still)
    eye = torch.eye(4, dtype=T.dtype, device=T.device).expand(len(T), 4, 4)
    errors = {}
    for sensor in build_sensors(SensorRows(data, eye, eye[:, :3, :3])):
        group, columns, factor = type(sensor).unknowns(data), {}, T.new_ones(len(T))
        if group is not None and unknowns is None:
            columns[group.name], factor = _fitting_best(sensor, group, data, motion)
        elif group is not None and unknowns is not None:
            identified = unknowns.get(group.name, {})
            values = [
                torch.from_numpy(identified[owner].copy()).to(T)
                if owner in identified
                else type(sensor).uncalibrated_unknowns(data, owner, T, tuple(identified))
                for owner in group.owners
            ]
            columns[group.name] = torch.stack(values, 1)
        residual = sensor.residual(motion, columns, slice(None)).t() * factor[:, None]
        error = torch.full_like(residual, torch.nan)
        error[rows[sensor.present]] = residual[sensor.present]
        if sensor.is_paired:
            error[rows[sensor.present.roll(1)]] = residual[sensor.present]
        errors[sensor.name] = error
    return errors


def _fitting_best(
    sensor: AbstractSensor, group: UnknownGroup, data: Measurements, motion: ToolMotion
) -> tuple[Float64[Tensor, "columns owners"], Float64[Tensor, " rows"]]:
    """Return the unknowns of all owners fitted to their rows without outliers, and the factor on the errors."""
    T = transform(motion.rotation.permute(2, 0, 1), motion.position.t())
    kept, count = torch.ones(len(T), dtype=torch.bool), len(group.owners)
    for _ in range(MAX_ITERATIONS):
        some = kept.nonzero()[:, 0]
        guess = type(sensor).initial_guess(data.select(some), T[some], math.inf)
        there = type(sensor).unknowns(data.select(some))
        assert guess is not None
        assert there is not None
        order = [there.owners.index(owner) for owner in group.owners]
        columns, free = guess.values[order].t().to(T), guess.free[order].sum(1)
        owner = sensor.unknown_derivatives(motion, {group.name: columns}, slice(None))[0].owner
        size = sensor.residual(motion, {group.name: columns}, slice(None)).norm(dim=0)
        counted, kept = kept, kept.clone()
        for number in range(count):
            own = sensor.present & (owner == number)
            kept[own] = size[own] <= _OUTLIER_FACTOR * size[own].quantile(0.5)
        if torch.equal(kept, counted):
            break
    values = torch.bincount(owner[sensor.present & counted], minlength=count) * sensor.components
    factor = torch.where(values > free, (values / (values - free).clamp(min=1)).sqrt(), torch.nan)
    return columns, torch.where(sensor.present, factor[owner], 1.0).to(T)
