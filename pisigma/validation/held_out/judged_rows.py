"""Rows with their positions in the workspace and their errors before and after the calibration."""

import math
from collections.abc import Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.files.errors import MeasurementError, ModelError, Place
from pisigma.measurement.conditions import CONDITIONS
from pisigma.measurement.copies import copy_warnings
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_of_equal_joints, numbers_of_names
from pisigma.model.accuracy import sigma_of_rows
from pisigma.model.calibrated_model import CalibratedModel, nominal_poses_of_rows, poses_of_rows
from pisigma.model.stated_conditions import mean_conditions
from pisigma.model.training_rows import training_row_mask, training_row_warnings
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import invert, transform_from_xyz_zyx
from pisigma.validation.held_out.held_out_rows import HeldOutRows
from pisigma.validation.held_out.pose_statistics import PoseErrors
from pisigma.validation.held_out.reference_models import nominal_model

_MIN_REPEATS = 10
"""Degrees of freedom that repeated rows must have for an estimate of the scatter."""
MAX_PREDICTED = 4_000
"""Number of evenly spaced rows at which the accuracy is predicted; each takes a millisecond."""


@dataclass(frozen=True, eq=False)
class JudgedRows:
    """Rows and their errors, in SI units.

    Attributes:
        row_role: "held_out": errors under calibrations without the row; "training": errors of training rows of the
            model; "other": errors of other rows.
        measurements: the rows; only joint values and names for held-out rows that a model stores.
        position: position of the tool in the robot's base frame [m].
        errors_by_model: errors of every row by model, "nominal" first and the model last.
        residual: measured minus predicted position in the row's frame under the model [m]; NaN if there is none.
        residual_row_role: role of the rows of the residuals, in the form of `row_role`.
        predicted_sigma: standard deviation of the predicted position [m]; NaN if there is none.
        is_inside_range: whether every joint value is in the range measured for the model.
        left_out: number of rows of the file that are marked as training rows and are not included.
        repeated_row_warnings: warnings about duplicate rows and training rows of the model.
        nominal_frame_source: origin of base and tool of "nominal": "fitted" to the model's poses, "given" for a model
            that was not calibrated, or those of the "model" if it stores too few poses; None for held-out rows.
        rows_without_position_error: number of rows without a position error.
        repeats: number of repeats of the cross-validation; the errors are those of the first one.
    """

    row_role: str
    measurements: Measurements
    position: Float64[Tensor, "rows 3"]
    errors_by_model: Mapping[str, PoseErrors]
    residual: Float64[Tensor, "rows 3"]
    residual_row_role: str
    predicted_sigma: Float64[Tensor, " rows"]
    is_inside_range: Bool[Tensor, " rows"]
    left_out: int = 0
    repeated_row_warnings: tuple[str, ...] = ()
    nominal_frame_source: Literal["fitted", "given", "model"] | None = None
    rows_without_position_error: int = 0
    repeats: int = 1

    @property
    def nominal_errors(self) -> PoseErrors:
        """Errors of the nominal robot."""
        return self.errors_by_model["nominal"]

    @property
    def model_errors(self) -> PoseErrors:
        """Errors of the model."""
        return list(self.errors_by_model.values())[-1]

    @property
    def scatter_mm(self) -> float | None:
        """Pooled scatter of positions at equal joint values, as RMS length [mm]; None if there are too few repeats."""
        finite = torch.isfinite(self.residual).all(-1)
        if int(finite.sum()) <= _MIN_REPEATS:
            return None
        measurements = self.measurements.select(finite)
        group = groups_of_equal_joints(measurements.q).tolist()
        names = list(zip(group, measurements.frame, measurements.target, strict=True))
        freedom = len(names) - len(set(names))
        if freedom < _MIN_REPEATS:
            return None
        values = self.residual[finite]
        mean, _ = _means_by_name(values, names)
        return math.sqrt(float((values - mean).square().sum()) / freedom) * 1e3


def judged_rows_of_file(
    model: CalibratedModel, measurements: Measurements, held_out: HeldOutRows | None
) -> JudgedRows:
    """Evaluate the rows of a file without training rows of the model; only rows marked as test if there are any.

    Args:
        model: the model.
        measurements: the rows of the file.
        held_out: held-out rows that the model folder stores, or None.

    Raises:
        MeasurementError: no row can be evaluated.
    """
    rows = _test_rows(measurements)
    left_out = measurements.rows - rows.rows
    digest = rows.content_hash()
    if held_out is not None and digest == held_out.data_sha256:
        residual, origin = held_out.residual, "held_out"
        if not bool(torch.isfinite(residual).any()):
            residual, origin = _errors(poses_of_rows(model, rows), rows)[1], "training"
        judged = _judged(model, rows, held_out.errors_by_model, residual, ("held_out", origin))
        return replace(judged, left_out=left_out, repeats=_repeats(model))
    known, again = training_row_mask(model, rows), tuple[str, ...]()
    origin = "training" if digest == model.provenance.data_sha256 or bool(known.all()) else "other"
    if origin == "other":
        again = training_row_warnings(model, rows)
        rows = rows.select(~known)
    errors, residual = _errors(poses_of_rows(model, rows), rows)
    if not (torch.isfinite(errors.position).any() or errors.rotation is not None):
        raise MeasurementError(
            "no row has a position, an orientation or a socket that was measured twice, so the model cannot be "
            "evaluated with this file",
            at=Place(rows.source),
            remedy="give poses or positions, or omit the file",
        )
    T_nominal, own_frames = _nominal_poses(model, rows)
    models = {"nominal": _errors(T_nominal, rows)[0]}
    if model.hybrid is not None:
        models["geometric"] = _errors(poses_of_rows(replace(model, hybrid=None), rows), rows)[0]
    identified = "corrected" if model.calibrated is None else "geometric"
    models["hybrid" if model.hybrid is not None else identified] = errors
    return replace(
        _judged(model, rows, models, residual, (origin, origin)),
        left_out=left_out,
        repeated_row_warnings=(*copy_warnings(rows.left_out), *again),
        nominal_frame_source="model" if not own_frames else "given" if model.calibrated is None else "fitted",
        rows_without_position_error=int((~torch.isfinite(errors.position)).sum()),
    )


def judged_rows_of_folder(model: CalibratedModel, held_out: HeldOutRows) -> JudgedRows:
    """Return the held-out rows of a model folder as `JudgedRows`, at the mean conditions of the calibration."""
    payload, temperature = (
        torch.full((len(held_out.q),), usual, dtype=torch.float64) if usual is not None else None
        for usual in map(mean_conditions(model).get, CONDITIONS)
    )
    rows = Measurements(
        q=held_out.q,
        frame=held_out.frame,
        target=held_out.target,
        line=held_out.line,
        source=model.provenance.data_source,
        origin=held_out.file_name,
        payload=payload,
        temperature=temperature,
    )
    origins = ("held_out", "held_out")
    judged = _judged(model, rows, held_out.errors_by_model, held_out.residual, origins)
    return replace(judged, repeats=_repeats(model))


def tool_positions(model: CalibratedModel, q: Float64[Tensor, "rows dof"]) -> Float64[Tensor, "rows 3"]:
    """Compute the position of the tool in the robot's base frame [m]."""
    T = model.forward(q)
    T = torch.where(torch.isfinite(T), T, forward_kinematics(model.robot, q))
    base = transform_from_xyz_zyx(torch.from_numpy(model.robot.base.copy()))
    return (invert(base) @ T)[:, :3, 3]


def predicted_position_sigma(model: CalibratedModel, rows: Measurements) -> Float64[Tensor, " rows"]:
    """Compute standard deviations of predicted positions [m]; NaN if unknown, and beyond `MAX_PREDICTED` rows."""
    predicted = torch.full((rows.rows,), torch.nan, dtype=torch.float64)
    chosen = torch.linspace(0, rows.rows - 1, min(rows.rows, MAX_PREDICTED)).round().long()
    if model.uncertainty is not None and len(chosen):
        with suppress(MeasurementError):  # a frame or target that the model does not have
            predicted[chosen] = sigma_of_rows(model, rows.select(chosen)).norm(dim=-1)
    return predicted


def is_inside_range(model: CalibratedModel, q: Float64[Tensor, "rows dof"]) -> Bool[Tensor, " rows"]:
    """Return whether every joint value is in the measured range; always true if the model does not store it."""
    if model.hybrid is None:
        return torch.ones(len(q), dtype=torch.bool)
    return model.hybrid.coverage.contains(q)


def _judged(
    model: CalibratedModel,
    rows: Measurements,
    models: Mapping[str, PoseErrors],
    residual: Float64[Tensor, "rows 3"],
    origins: tuple[str, str],
) -> JudgedRows:
    return JudgedRows(
        row_role=origins[0],
        measurements=replace(
            rows, source=rows.file_names, origin=tuple(Path(name).name for name in rows.origin)
        ),
        position=tool_positions(model, rows.q),
        errors_by_model=models,
        residual=residual,
        residual_row_role=origins[1],
        predicted_sigma=predicted_position_sigma(model, rows),
        is_inside_range=is_inside_range(model, rows.q),
    )


def _test_rows(measurements: Measurements) -> Measurements:
    """Select the rows marked as test, or all if none is."""
    test = torch.tensor([name == "test" for name in measurements.split or ()], dtype=torch.bool)
    return measurements if not test.any() or bool(test.all()) else measurements.select(test)


def _repeats(model: CalibratedModel) -> int:
    """Return the number of repeats of the cross-validation; the stored errors are those of the first one."""
    repeats: int = model.metrics.get("cross_validation", {}).get("repeats", 1)
    return repeats


def _nominal_poses(model: CalibratedModel, rows: Measurements) -> tuple[Float64[Tensor, "rows 4 4"], bool]:
    """Predict poses of the nominal robot with base and tool fitted, and return whether they could be fitted."""
    try:
        nominal = nominal_model(model, rows.rotation is not None)
    except ModelError:
        return nominal_poses_of_rows(model, rows), False
    return poses_of_rows(nominal, rows), True


def _errors(
    T: Float64[Tensor, "rows 4 4"], rows: Measurements
) -> tuple[PoseErrors, Float64[Tensor, "rows 3"]]:
    """Compute the errors of rows, and signed errors of positions; balls in sockets are relative to their mean."""
    position = torch.full_like(T[:, :3, 3], torch.nan) if rows.position is None else rows.position
    residual = position - T[:, :3, 3]
    if rows.socket is not None:
        of_sockets = rows.is_measured("socket")[:, None]
        residual = torch.where(of_sockets, _from_socket(rows, T[:, :3, 3]), residual)
    rotation = None
    if rows.rotation is not None:
        turned = Measurements(q=rows.q, position=T[:, :3, 3].nan_to_num(), rotation=rows.rotation)
        rotation = PoseErrors.from_prediction(turned, T).rotation
    return PoseErrors(residual.norm(dim=-1), rotation), residual


def _from_socket(rows: Measurements, ball: Float64[Tensor, "rows 3"]) -> Float64[Tensor, "rows 3"]:
    """Compute the mean position of every row's socket minus the row's ball; NaN in sockets of a single row."""
    mean, count = _means_by_name(ball, list(zip(rows.frame, rows.socket or (), strict=True)))
    return torch.where((count > 1)[:, None], mean - ball, torch.nan)


def _means_by_name(
    values: Float64[Tensor, "rows 3"], names: Sequence[Hashable]
) -> tuple[Float64[Tensor, "rows 3"], Float64[Tensor, " rows"]]:
    """Compute for every row the mean of the values of all rows with the same name, and the number of these rows."""
    number = numbers_of_names(names)
    counts = torch.bincount(number).double()
    sums = torch.zeros(len(counts), 3, dtype=torch.float64).index_add_(0, number, values)
    return (sums / counts[:, None])[number], counts[number]
