"""Points of the three-dimensional map: rows of measurements, or samples of the workspace."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64

from pisigma.kinematics.forward import forward_kinematics
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.page.judged_rows import JudgedRows, inside, place_of, predicted_at

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
    """Points in space, and what is known at each.

    Attributes:
        place: position of the tool in the robot's own base [mm].
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
    inside: np.ndarray
    says: str


def map_of_rows(model: CalibratedModel, rows: JudgedRows) -> ErrorMap:
    """A map of judged rows; of very many, those of the largest errors and others evenly spread."""
    whose = {
        "held_out": "each judged by a calibration that never saw it",
        "training": "which the model was made of, so errors after it are not those of a prediction",
        "other": "which the model was not made of",
    }[rows.origin]
    layers = [
        Layer("before", "before (nominal)", "mm", _mm(rows.before.position), "Error of the robot as drawn."),
        Layer(
            "after",
            "after calibration",
            "mm",
            _mm(rows.after.position),
            f"Error of the model; rows, {whose}.",
        ),
        Layer("predicted", "predicted accuracy", "mm", _mm(rows.predicted), _PREDICTED),
    ]
    if rows.after.rotation is not None:
        turned = [("before", rows.before.rotation), ("after", rows.after.rotation)]
        for when, angle in turned:
            if angle is not None:
                values = np.degrees(angle.numpy())
                label = f"orientation, {when}"
                layers.append(Layer(f"{when}_deg", label, "deg", values, f"Orientation error {when}."))
    shown = [layer for layer in layers if np.isfinite(layer.values).any()]
    chosen = _chosen(shown, rows.measurements.rows)
    says = f"{rows.measurements.rows} rows of {rows.measurements.source}, {whose}"
    if len(chosen) < rows.measurements.rows:
        says += f"; shown are {len(chosen)} of them, the largest errors among these"
    row = np.array([line or k + 1 for k, line in enumerate(rows.measurements.line)])
    return _map(
        model, rows.measurements, rows.place.numpy(), shown, row, rows.inside.numpy(), chosen, f"{says}."
    )


def map_of_workspace(model: CalibratedModel) -> ErrorMap:
    """A map without measurements: joint values that the model keeps, and others within their ranges."""
    q = model.starts
    more = max(SAMPLES - len(q), 0) if len(q) else 0
    if more:
        low, high = q.amin(0), q.amax(0)
        generator = torch.Generator().manual_seed(0)
        drawn = torch.rand(more, q.shape[1], generator=generator, dtype=torch.float64)
        q = torch.cat([q, low + drawn * (high - low)])
    frame, target = (next(iter(known), "") for known in (model.bases, model.tools))
    rows = Measurements(q=q, frame=(frame,) * len(q), target=(target,) * len(q), source=model.name)
    moved = model.forward(q)[:, :3, 3] - forward_kinematics(model.robot, q)[:, :3, 3]
    layers = [
        Layer(
            "correction",
            "correction",
            "mm",
            _mm(moved.norm(dim=-1)),
            "How far the calibration moves the tool.",
        ),
        Layer("predicted", "predicted accuracy", "mm", _mm(predicted_at(model, rows)), _PREDICTED),
    ]
    shown = [layer for layer in layers if np.isfinite(layer.values).any()]
    says = (
        f"No measured rows are at hand: {len(model.starts)} joint values that the model keeps of its training rows, "
        f"and {more} drawn at random within their ranges."
    )
    place = place_of(model, q).numpy()
    row = np.zeros(len(q), dtype=np.int64)
    return _map(model, rows, place, shown, row, inside(model, q).numpy(), np.arange(len(q)), says)


_PREDICTED = "Standard deviation of the predicted position, without the scatter of a measurement."


def _mm(values: torch.Tensor) -> np.ndarray:
    found: np.ndarray = values.numpy() * 1e3
    return found


def _chosen(layers: list[Layer], rows: int) -> np.ndarray:
    """Numbers of the rows that are shown, in their order."""
    if rows <= MOST_POINTS:
        return np.arange(rows)
    worst = np.argsort(-np.nan_to_num(layers[min(1, len(layers) - 1)].values), kind="stable")
    worst = worst[: int(MOST_POINTS * WORST_SHARE)]
    others = np.linspace(0, rows - 1, MOST_POINTS - len(worst)).round().astype(int)
    return np.unique(np.concatenate([worst, others]))


def _map(
    model: CalibratedModel,
    rows: Measurements,
    place: np.ndarray,
    layers: list[Layer],
    row: np.ndarray,
    inside: np.ndarray,
    chosen: np.ndarray,
    says: str,
) -> ErrorMap:
    factor = [math.degrees(1.0) if turns else 1e3 for turns in model.robot.revolute]
    return ErrorMap(
        place=place[chosen] * 1e3,
        layers=tuple(replace(layer, values=layer.values[chosen]) for layer in layers),
        row=row[chosen],
        q=rows.q.numpy()[chosen] * factor,
        frame=tuple(rows.frame[k] for k in chosen.tolist()),
        target=tuple(rows.target[k] for k in chosen.tolist()),
        inside=inside[chosen],
        says=says,
    )
