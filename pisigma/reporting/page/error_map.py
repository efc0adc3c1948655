"""Points of the three-dimensional map: rows of measurements, or samples of the workspace."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.validation.held_out.judged_rows import JudgedRows, inside, place_of, predicted_at

MOST_POINTS = 20_000
"""Of more rows so many are shown, the largest errors among them."""
WORST_SHARE = 0.05
"""Share of the shown rows that are the largest errors."""
SAMPLES = 3_000
"""Of the workspace, where there are no rows."""


@dataclass(frozen=True, eq=False)
class Layer:
    """One quantity that the map can show.

    Attributes:
        key: short name.
        label: for people.
        unit: "mm" or "deg".
        values: of every point; NaN where there is none.
        says: what it is, in a sentence.
    """

    key: str
    label: str
    unit: str
    values: Float64[np.ndarray, " points"]
    says: str


@dataclass(frozen=True, eq=False)
class ErrorMap:
    """Points in space, and figures at each.

    Attributes:
        place: position of the tool in the robot's base [mm].
        layers: what can be shown, at least one.
        row: number of every point's row, from 1; its line in the file where there is one; 0 for samples.
        q: joint values [deg or mm].
        frame: per point.
        target: per point.
        inside: whether every joint value was measured when the model was made.
        says: what the points are, in a sentence.
    """

    place: Float64[np.ndarray, "points 3"]
    layers: tuple[Layer, ...]
    row: Int64[np.ndarray, " points"]
    q: Float64[np.ndarray, "points dof"]
    frame: tuple[str, ...]
    target: tuple[str, ...]
    inside: Bool[np.ndarray, " points"]
    says: str


def map_of_rows(model: CalibratedModel, rows: JudgedRows) -> ErrorMap:
    """Map judged rows; of very many, those of the largest errors and others evenly spread."""
    whose = {
        "held_out": "each judged by a calibration without it",
        "training": "which the model was made of, so errors after it are not those of a prediction",
        "other": "which the model was not made of",
    }[rows.origin]
    before, after = rows.before, rows.after
    layers = _finite(
        _layer("before", "before (nominal)", before.position, "Error of the robot as drawn."),
        _layer("after", "after calibration", after.position, f"Error of the model; rows, {whose}."),
        _layer("predicted", "predicted accuracy", rows.predicted, _PREDICTED),
        _layer("before_deg", "orientation, before", before.rotation, "Orientation error before.", "deg"),
        _layer("after_deg", "orientation, after", after.rotation, "Orientation error after.", "deg"),
    )
    count = rows.measurements.rows
    chosen = _chosen(layers, count)
    says = f"{count} rows of {rows.measurements.source}, {whose}"
    if len(chosen) < count:
        says += f"; shown are {len(chosen)} of them, the largest errors among these"
    number = torch.tensor([line or k + 1 for k, line in enumerate(rows.measurements.line)])
    return _map(model, rows.measurements.select(chosen), layers, number, f"{says}.", chosen)


def map_of_workspace(model: CalibratedModel) -> ErrorMap:
    """Map the workspace without measurements: joint values that the model keeps, and others within their ranges."""
    q = model.starts
    more = max(SAMPLES - len(q), 0) if len(q) else 0
    if more:
        low, high = q.amin(0), q.amax(0)
        generator = torch.Generator().manual_seed(0)
        drawn = torch.rand(more, q.shape[1], generator=generator, dtype=torch.float64)
        q = torch.cat([q, low + drawn * (high - low)])
    frame, target = (next(iter(names), "") for names in (model.bases, model.tools))
    samples = Measurements(q=q, frame=(frame,) * len(q), target=(target,) * len(q), source=model.name)
    moved = model.forward(q)[:, :3, 3] - forward_kinematics(model.robot, q)[:, :3, 3]
    layers = _finite(
        _layer("correction", "correction", moved.norm(dim=-1), "How far the calibration moves the tool."),
        _layer("predicted", "predicted accuracy", predicted_at(model, samples), _PREDICTED),
    )
    says = (
        f"No measured rows are at hand: {len(model.starts)} joint values that the model keeps of its training rows, "
        f"and {more} drawn at random within their ranges."
    )
    number = torch.zeros(len(q), dtype=torch.int64)
    return _map(model, samples, layers, number, says, torch.arange(len(q)))


_PREDICTED = "Standard deviation of the predicted position, without the scatter of a measurement."


def _layer(
    key: str, label: str, values: Float64[Tensor, " points"] | None, says: str, unit: str = "mm"
) -> Layer | None:
    """Make a layer of values [m or rad]; None without values."""
    factor = 1e3 if unit == "mm" else math.degrees(1.0)
    return None if values is None else Layer(key, label, unit, values.numpy() * factor, says)


def _finite(*layers: Layer | None) -> list[Layer]:
    """Keep the layers that show something."""
    return [layer for layer in layers if layer is not None and np.isfinite(layer.values).any()]


def _chosen(layers: list[Layer], rows: int) -> Int64[Tensor, " chosen"]:
    """Choose the rows that are shown, in their order."""
    if rows <= MOST_POINTS:
        return torch.arange(rows)
    worst = np.argsort(-np.nan_to_num(layers[min(1, len(layers) - 1)].values), kind="stable")
    worst = worst[: int(MOST_POINTS * WORST_SHARE)]
    others = np.linspace(0, rows - 1, MOST_POINTS - len(worst)).round().astype(int)
    return torch.from_numpy(np.unique(np.concatenate([worst, others])))


def _map(
    model: CalibratedModel,
    points: Measurements,
    layers: list[Layer],
    number: Int64[Tensor, " rows"],
    says: str,
    chosen: Int64[Tensor, " points"],
) -> ErrorMap:
    factor = [math.degrees(1.0) if turns else 1e3 for turns in model.robot.revolute]
    return ErrorMap(
        place=place_of(model, points.q).numpy() * 1e3,
        layers=tuple(replace(layer, values=layer.values[chosen.numpy()]) for layer in layers),
        row=number[chosen].numpy(),
        q=points.q.numpy() * factor,
        frame=points.frame,
        target=points.target,
        inside=inside(model, points.q).numpy(),
        says=says,
    )
