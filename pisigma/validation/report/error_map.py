"""Points of the three-dimensional error map, the worst row, and the worst region."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.validation.held_out.judged_rows import (
    JudgedRows,
    is_inside_range,
    predicted_position_sigma,
    tool_positions,
)
from pisigma.validation.held_out.rank_tests import SIGNIFICANT, kruskal_wallis
from pisigma.validation.report.dependence import MIN_ROWS, error_lengths, root_mean_square

MAX_POINTS = 20_000
"""Largest number of points of a map; if there are more rows, the largest errors and an even selection of the others are
shown."""
_WORST_SHARE = 0.05
"""Share of `MAX_POINTS` that is reserved for the largest errors."""
_SAMPLES = 3_000
"""Number of samples of the workspace if no rows were measured."""

Quantity = Literal[
    "before", "after", "predicted", "before_deg", "after_deg", "correction", "distance", "turn"
]
"""Quantity that a map shows. "before" and "after": position error of the nominal robot and of the model; with "_deg":
their orientation errors. "predicted": standard deviation of the predicted position. "correction": distance by which the
calibration moves the tool. "distance" and "turn": distance and angle between the poses of two models.
"""


@dataclass(frozen=True, eq=False)
class Layer:
    """A quantity at every point of a map.

    Attributes:
        key: the quantity.
        unit: "mm" or "deg".
        values: value at every point; NaN where it is unknown.
    """

    key: Quantity
    unit: str
    values: Float64[np.ndarray, " points"]


@dataclass(frozen=True, eq=False)
class ErrorMap:
    """Points in the robot's base frame, with quantities at every point.

    Attributes:
        position_mm: position of the tool in the robot's base frame [mm].
        layers: quantities that can be shown, at least one.
        row: line of every point's row in the file, or else the number of the row from 1; 0 for samples.
        row_numbering: what `row` counts at every point: "line", "b.csv, line" for rows of several files, or "row".
        controller_values: the controller's values of the axes [deg or mm].
        frame: frame of every point.
        target: target of every point.
        is_inside_range: whether every joint value was measured for the calibration.
        rows: number of evaluated rows; 0 for samples of the workspace.
        source: file of the rows, or name of the model.
        row_role: `JudgedRows.row_role` of the rows; "" for samples of the workspace.
        random_points: number of points that were drawn at random.
    """

    position_mm: Float64[np.ndarray, "points 3"]
    layers: tuple[Layer, ...]
    row: Int64[np.ndarray, " points"]
    row_numbering: tuple[str, ...]
    controller_values: Float64[np.ndarray, "points axes"]
    frame: tuple[str, ...]
    target: tuple[str, ...]
    is_inside_range: Bool[np.ndarray, " points"]
    rows: int
    source: str
    row_role: str
    random_points: int


def map_of_rows(model: CalibratedModel, rows: JudgedRows) -> ErrorMap:
    """Return the map of evaluated rows; for very many rows, the largest errors and an even selection of the others."""
    before, after = rows.nominal_errors, rows.model_errors
    layers = _finite(
        _layer("before", before.position),
        _layer("after", after.position),
        _layer("predicted", rows.predicted_sigma),
        _layer("before_deg", before.rotation, "deg"),
        _layer("after_deg", after.rotation, "deg"),
    )
    count = rows.measurements.rows
    chosen = _chosen(layers, count)
    number = torch.tensor([line or k + 1 for k, line in enumerate(rows.measurements.line)])
    points = rows.measurements.select(chosen)
    shown = [replace(layer, values=layer.values[chosen.numpy()]) for layer in layers]
    return _map(model, points, shown, number[chosen], (count, rows.measurements.source, rows.row_role, 0))


def map_of_workspace(model: CalibratedModel) -> ErrorMap:
    """Return a map of the workspace without measurements, at stored joint values and random ones in their ranges."""
    q, more = samples_of_workspace(model)
    frame, target = (next(iter(names), "") for names in (model.bases, model.tools))
    samples = Measurements(q=q, frame=(frame,) * len(q), target=(target,) * len(q), source=model.name)
    moved = model.forward(q)[:, :3, 3] - forward_kinematics(model.robot, q)[:, :3, 3]
    layers = _finite(
        _layer("correction", moved.norm(dim=-1)),
        _layer("predicted", predicted_position_sigma(model, samples)),
    )
    number = torch.zeros(len(q), dtype=torch.int64)
    return _map(model, samples, layers, number, (0, model.name, "", more))


def samples_of_workspace(model: CalibratedModel) -> tuple[Float64[Tensor, "samples dof"], int]:
    """Return stored joint values and random ones within their ranges [rad or m], and the number of random ones."""
    q = model.starts
    more = max(_SAMPLES - len(q), 0) if len(q) else 0
    if more:
        low, high = q.amin(0), q.amax(0)
        generator = torch.Generator().manual_seed(0)
        uniform = torch.rand(more, q.shape[1], generator=generator, dtype=torch.float64)
        q = torch.cat([q, low + uniform * (high - low)])
    return q, more


def _layer(key: Quantity, values: Float64[Tensor, " points"] | None, unit: str = "mm") -> Layer | None:
    """Return a layer of values given in [m or rad]; None without values."""
    factor = 1e3 if unit == "mm" else math.degrees(1.0)
    return None if values is None else Layer(key, unit, values.numpy() * factor)


def _finite(*layers: Layer | None) -> list[Layer]:
    """Return the layers with at least one known value."""
    return [layer for layer in layers if layer is not None and np.isfinite(layer.values).any()]


def _chosen(layers: list[Layer], rows: int) -> Int64[Tensor, " chosen"]:
    """Return the indices of the rows that are shown, in order."""
    if rows <= MAX_POINTS:
        return torch.arange(rows)
    worst = np.argsort(-np.nan_to_num(layers[min(1, len(layers) - 1)].values), kind="stable")
    worst = worst[: int(MAX_POINTS * _WORST_SHARE)]
    others = np.linspace(0, rows - 1, MAX_POINTS - len(worst)).round().astype(int)
    return torch.from_numpy(np.unique(np.concatenate([worst, others])))


def _map(
    model: CalibratedModel,
    points: Measurements,
    layers: list[Layer],
    number: Int64[Tensor, " points"],
    about: tuple[int, str, str, int],
) -> ErrorMap:
    return ErrorMap(
        tool_positions(model, points.q).numpy() * 1e3,
        tuple(layers),
        number.numpy(),
        tuple(
            f"{name}, line" if line and name else "line" if line else "row"
            for line, name in zip(points.line, points.origin or ("",) * points.rows, strict=True)
        ),
        model.robot.in_file_units(points.q),
        points.frame,
        points.target,
        is_inside_range(model, points.q).numpy(),
        *about,
    )


CELLS = 4
"""Number of cells of the measured space along every axis."""


@dataclass(frozen=True)
class WorstRegion:
    """Cell of the measured space with the largest errors, in the robot's base frame.

    Attributes:
        low: lower corner [m].
        high: upper corner [m].
        rows: number of rows in the cell.
        rms: RMS error of these rows, in the unit of the errors.
        ratio: ratio of `rms` to the RMS error of all rows.
        significant: whether errors in the cell are significantly larger than elsewhere.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    rows: int
    rms: float
    ratio: float
    significant: bool


@dataclass(frozen=True)
class LargestErrors:
    """The worst row and the worst region of evaluated rows.

    Attributes:
        row: index of the row with the largest error.
        error: largest error [`unit`].
        unit: "mm" for positions, "deg" for orientations.
        position: position of the tool at that row in the robot's base frame [m].
        region: the worst region; None if there are too few rows to compare regions.
    """

    row: int
    error: float
    unit: str
    position: tuple[float, ...]
    region: WorstRegion | None


def largest_errors(rows: JudgedRows) -> LargestErrors | None:
    """Find the worst row and the worst region; None if no error is known."""
    _, after, unit = error_lengths(rows)
    finite = np.isfinite(after)
    if not finite.any():
        return None
    place, errors = rows.position.numpy()[finite], after[finite]
    worst = int(errors.argmax())
    row = int(np.flatnonzero(finite)[worst])
    return LargestErrors(
        row, float(errors[worst]), unit, tuple(place[worst].tolist()), worst_region(place, errors)
    )


def worst_region(
    position: Float64[np.ndarray, "rows 3"], errors: Float64[np.ndarray, " rows"]
) -> WorstRegion | None:
    """Find the cell of a grid over the measured space with the largest errors.

    Args:
        position: position of every row [m].
        errors: lengths of the errors, all finite.

    Returns:
        The cell; None if there are too few rows, or all are in one cell.
    """
    low, high = (position.min(0), position.max(0)) if len(position) else (np.zeros(3), np.zeros(3))
    width = np.where(high > low, (high - low) / CELLS, 1.0)
    cell = np.clip(((position - low) / width).astype(int), 0, CELLS - 1)
    number = (cell * [CELLS * CELLS, CELLS, 1]).sum(1)
    least = max(MIN_ROWS, len(errors) // 100)
    cells = [(int(k), errors[number == k]) for k in np.unique(number)]
    cells = [(k, inside) for k, inside in cells if len(inside) >= least]
    if len(cells) < 2:
        return None
    # compare values lowered by one standard error, so that a cell of few rows is not the worst by chance
    worst, _ = max(cells, key=lambda one: root_mean_square(one[1]) * (1 - 1 / math.sqrt(len(one[1]))))
    inside = number == worst
    _, chance = kruskal_wallis(inside.astype(int), errors)
    corner = low + width * cell[inside][0]
    rms = root_mean_square(errors[inside])
    return WorstRegion(
        low=tuple(corner.tolist()),
        high=tuple((corner + width).tolist()),
        rows=int(inside.sum()),
        rms=rms,
        ratio=rms / root_mean_square(errors),
        significant=chance < SIGNIFICANT / len(cells),  # Bonferroni's correction for the worst of many cells
    )
