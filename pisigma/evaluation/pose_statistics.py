"""Position and orientation errors of measured rows under a model, and their statistics."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.correction.calibrated_model import CalibratedModel
from pisigma.errors import MeasurementError, nearest_choice
from pisigma.kinematics.forward import forward_kinematics
from pisigma.measurement.dataset import Measurements
from pisigma.se3 import invert, rotation_vector, transform_from_xyzrpy


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """How far measured rows are from where a model expects them.

    Attributes:
        position: length of the position error of every row [m]; NaN where no position was measured or
            predicted.
        rotation: angle of the rotation error of every row [rad]; NaN likewise; None where no row has an
            orientation.
    """

    position: Float64[Tensor, " rows"]
    rotation: Float64[Tensor, " rows"] | None

    @staticmethod
    def between(measurements: Measurements, expected: Float64[Tensor, "rows 4 4"]) -> "PoseErrors":
        """Errors of measurements against expected poses T_base_tool.

        Raises:
            MeasurementError: no position was measured.
        """
        if measurements.position is None:
            raise MeasurementError(f"{measurements.source}: no positions were measured; give x, y and z.")
        position = (measurements.position - expected[:, :3, 3]).norm(dim=-1)
        if measurements.rotation is None:
            return PoseErrors(position, None)
        there = torch.isfinite(measurements.rotation).all(-1).all(-1) & torch.isfinite(expected).all(-1).all(
            -1
        )
        eye = torch.eye(3, dtype=position.dtype)
        R = torch.where(there[:, None, None], measurements.rotation @ expected[:, :3, :3].mT, eye)
        return PoseErrors(position, torch.where(there, rotation_vector(R).norm(dim=-1), torch.nan))

    def only(self, rows: Bool[Tensor, " rows"]) -> "PoseErrors":
        """The errors of some rows; NaN in all others."""
        position = torch.where(rows, self.position, torch.nan)
        return PoseErrors(
            position, None if self.rotation is None else torch.where(rows, self.rotation, torch.nan)
        )

    def in_file_units(self) -> dict[str, float]:
        """RMS, mean, 95 % and maximum in mm and, where measured, in deg."""
        figures = {f"{name}_mm": value * 1e3 for name, value in error_statistics(self.position).items()}
        if self.rotation is not None:
            degrees = torch.rad2deg(self.rotation)
            figures |= {f"{name}_deg": value for name, value in error_statistics(degrees).items()}
        return figures


def error_statistics(errors: Float64[Tensor, " rows"]) -> dict[str, float]:
    """Root mean square, mean, 95 % quantile and maximum of error lengths; NaN rows do not count."""
    present = errors[torch.isfinite(errors)]
    if not len(present):
        raise MeasurementError(
            "there is no row with both a measured and a predicted value; nothing can be compared."
        )
    return {
        "rms": float(present.square().mean().sqrt()),
        "mean": float(present.mean()),
        "p95": float(torch.quantile(present, 0.95)),
        "max": float(present.max()),
    }


@dataclass(frozen=True, eq=False)
class Comparison:
    """A model with and without its correction, on the same rows.

    Attributes:
        nominal: errors of the model's robot without its correction (base and tool as fitted).
        corrected: errors with it; NaN in the same rows.
        not_predicted: rows that are left out of both, because the model predicts nothing there.
    """

    nominal: PoseErrors
    corrected: PoseErrors
    not_predicted: int

    @staticmethod
    def of(nominal: PoseErrors, corrected: PoseErrors) -> "Comparison":
        """Compare on the rows that both have."""
        both = ~(torch.isfinite(nominal.position) & torch.isnan(corrected.position))
        return Comparison(nominal.only(both), corrected, int((~both).sum()))

    def in_file_units(self) -> dict[str, dict[str, float]]:
        """The figures in mm and deg of "nominal" and "corrected"."""
        return {"nominal": self.nominal.in_file_units(), "corrected": self.corrected.in_file_units()}


def compare_on(model: CalibratedModel, measurements: Measurements) -> Comparison:
    """Compare a model with and without its correction on measurements.

    Raises:
        MeasurementError: no positions were measured, or in a frame or of a target that the model does not know.
    """
    nominal, corrected = (
        PoseErrors.between(measurements, seen_from_frames(model, measurements, T))
        for T in (forward_kinematics(model.robot, measurements.q), model.forward(measurements.q))
    )
    return Comparison.of(nominal, corrected)


def seen_from_frames(
    model: CalibratedModel, measurements: Measurements, T: Float64[Tensor, "rows 4 4"]
) -> Float64[Tensor, "rows 4 4"]:
    """Poses T_base_tool of a model as poses of the rows' targets in the rows' frames.

    Raises:
        MeasurementError: the model does not know a frame or target of the rows.
    """
    before = _relative(model.bases, measurements.frame, "frame", measurements)
    behind = _relative(model.tools, measurements.target, "target", measurements)
    if before is not None:
        own = transform_from_xyzrpy(torch.tensor(model.robot.base.tolist(), dtype=torch.float64))
        T = before @ invert(own) @ T
    if behind is not None:
        own = transform_from_xyzrpy(torch.tensor(model.robot.tool.tolist(), dtype=torch.float64))
        T = T @ invert(own) @ behind
    return T


def _relative(
    known: dict[str, Float64[np.ndarray, " 6"]],
    names: tuple[str, ...],
    what: str,
    measurements: Measurements,
) -> Float64[Tensor, "rows 4 4"] | None:
    """The frame or tool of every row; None where the model and the rows have one, whatever its name.

    A model that was fitted to rows without names takes rows of any one name, and one that was fitted to a
    single name takes rows without.
    """
    if not set(known) - {""}:
        other = next((row for row, name in enumerate(names) if name != names[0]), None)
        if other is not None:
            raise MeasurementError(
                f"{measurements.place(other)}: {what} '{names[other]}' stands there, but "
                f"{measurements.place(0)} has '{names[0]}', and the model knows one {what} only; give a file for each."
            )
        return None
    if len(known) == 1 and not any(names):
        return None
    for row, name in enumerate(names):
        if name not in known:
            raise MeasurementError(
                f"{measurements.place(row)}: the model was not fitted to {what} '{name}'; "
                f"{nearest_choice(name, known)}"
            )
    order = list(known)
    frames = transform_from_xyzrpy(torch.from_numpy(np.stack([known[name] for name in order])))
    return frames[torch.tensor([order.index(name) for name in names], dtype=torch.int64)]
