"""Errors of measured rows of any sensor."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.registry import SENSORS, measured_errors, unknown_groups
from pisigma.validation.held_out.pose_statistics import ErrorVectors


def errors_of_rows(T: Float64[Tensor, "rows 4 4"], measurements: Measurements) -> ErrorVectors:
    """Compute the errors of rows against predicted poses of the targets.

    The positions of sockets, and of anchors at unknown points, are fitted to their rows, and the errors are corrected
    for the degrees of freedom; see `measured_errors`.

    Args:
        T: predicted poses, in the frame of every row.
        measurements: the rows.

    Returns:
        `position` contains the errors of positions, and in rows without a position the errors of the measured length:
        along the axes of the frame for a ball in a socket; the difference, as the first component, for a wire, a touch
        or a pair. NaN where nothing was measured or predicted.

    Raises:
        IdentificationError: an anchor has too few rows to determine its position.
    """
    if measurements.position is not None:
        errors = ErrorVectors.from_prediction(measurements, T)
    else:
        nowhere = torch.full((measurements.rows, 3), torch.nan, dtype=torch.float64)
        poses = replace(measurements, position=nowhere)
        errors = ErrorVectors.from_prediction(poses, T)
    rows = (
        _whole_pairs(measurements, torch.isfinite(T).flatten(1).all(-1)) & rows_with_only_length(measurements)
    ).nonzero()[:, 0]
    if not len(rows):
        return errors
    some = replace(
        measurements, position=None, sigma_position=None, rotation=None, sigma_rotation=None
    ).select(rows)
    position = errors.position.clone()
    for name, error in measured_errors(T[rows], some, None).items():
        if SENSORS[name].unit == "m":
            there = torch.isfinite(error).all(-1)
            position[rows[there]] = torch.nn.functional.pad(error, (0, 3 - error.shape[1]))[there]
    return replace(errors, position=position)


def rows_with_only_length(measurements: Measurements) -> Bool[Tensor, " rows"]:
    """Return the mask of rows that have a length from another sensor but no position."""
    kinds = [kind for kind in measurements.kinds if kind in SENSORS and SENSORS[kind].unit == "m"]
    there = torch.zeros(measurements.rows, dtype=torch.bool)
    for kind in kinds:
        there |= measurements.is_measured(kind)
    return there & ~has_position(measurements)


def has_position(measurements: Measurements) -> Bool[Tensor, " rows"]:
    """Return the mask of rows that have a position."""
    if measurements.position is None:
        return torch.zeros(measurements.rows, dtype=torch.bool)
    return torch.isfinite(measurements.position).all(-1)


def fitted_points_remark(measurements: Measurements) -> tuple[str, ...]:
    """Write a remark on errors of rows to which positions of sockets or anchors are fitted; empty if there are none."""
    rows = rows_with_only_length(measurements).nonzero()[:, 0]
    groups = unknown_groups(measurements.select(rows))
    if not groups:
        return ()
    what = " and ".join(f"{len(group.owners)} {group.name}s" for group in groups)
    return (
        f"For every model, these rows are used to fit the positions of {what}: an error is the deviation of a row from "
        "the position fitted to all rows of its socket or anchor, corrected for the fitted parameters. It does not "
        "depend on the pose of the robot's base.",
    )


def _whole_pairs(measurements: Measurements, rows: Bool[Tensor, " rows"]) -> Bool[Tensor, " rows"]:
    """Leave out both rows of a pair if one of them is left out."""
    broken = {
        name
        for name, there in zip(measurements.pair or (), rows.tolist(), strict=False)
        if name and not there
    }
    if not broken:
        return rows
    return rows & torch.tensor([name not in broken for name in measurements.pair or ()])
