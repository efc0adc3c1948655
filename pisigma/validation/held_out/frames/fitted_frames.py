"""Errors of rows whose frames or targets are fitted to the rows themselves, corrected for the degrees of freedom."""

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.estimation.cholesky import orthonormal_columns
from pisigma.files.errors import MeasurementError, Place
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_to_keep_whole, numbers_of_names
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.robot.frame_fits import (
    CONVERGENCE_TOLERANCE,
    INITIAL_DAMPING,
    LEVER_SHARE,
    MAX_ITERATIONS,
    MeasuredPoses,
    best_base,
    best_tool,
    frame_jacobian,
    moved_frame,
)
from pisigma.validation.held_out.calibration_summary import has_orientation
from pisigma.validation.held_out.frames.row_errors import errors_of_rows
from pisigma.validation.held_out.pose_statistics import ErrorVectors

FrameKind = Literal["base", "tool"]
"""Frames that can be fitted: the base in every frame of the rows, the tool of every target."""

MIN_CONFIGURATIONS = 6
"""Number of different joint vectors that a frame or a target needs: 18 values for the 9 parameters of base and tool."""


def fitted_kinds(fit_frame: bool, fit_tool: bool) -> tuple[FrameKind, ...]:
    """List what is fitted according to two options."""
    kinds: tuple[tuple[FrameKind, bool], ...] = (("base", fit_frame), ("tool", fit_tool))
    return tuple(kind for kind, fitted in kinds if fitted)


def with_known_names(
    model: CalibratedModel, rows: Measurements, fitted_kinds: Collection[FrameKind]
) -> Measurements:
    """Replace the names of fitted frames and targets with any name of the model, because their poses do not matter."""
    if "base" in fitted_kinds:
        rows = replace(rows, frame=(next(iter(model.bases), ""),) * rows.rows)
    if "tool" in fitted_kinds:
        rows = replace(rows, target=(next(iter(model.tools), ""),) * rows.rows)
    return rows


def fitted_remark(rows: Measurements, fitted_kinds: Collection[FrameKind]) -> tuple[str, ...]:
    """Write a remark on errors in fitted frames; empty if none is fitted."""
    if not fitted_kinds:
        return ()
    turned = rows.rotation is not None
    numbers = {
        "frame": 6 * len(set(rows.frame)) * ("base" in fitted_kinds),
        "tool": (6 if turned else 3) * len(set(rows.target)) * ("tool" in fitted_kinds),
    }
    what = " and ".join(f"the {name} ({count} parameters)" for name, count in numbers.items() if count)
    values = _readings(rows) * (6 if turned else 3)
    return (
        f"For every model, these rows are used to fit {what}, so errors of the robot's {' or '.join(fitted_kinds)} are "
        f"not included. The errors are corrected for this: their squares are divided by "
        f"{values - sum(numbers.values())} "
        f"degrees of freedom ({values} values minus {sum(numbers.values())} fitted parameters).",
    )


def errors_in_fitted_frames(
    model: CalibratedModel, measurements: Measurements, fitted_kinds: Collection[FrameKind]
) -> ErrorVectors:
    """Compute errors under a model, with frames or targets fitted, as after a sensor or a reflector was moved.

    Parameters that are fitted to n values make their errors too small. Therefore the errors are multiplied by
    `sqrt(n / (n - p))`, where p is the trace of the hat matrix over these values, which is the number of parameters if
    there is only one kind of values (Draper and Smith 1998, Applied Regression Analysis, section 8.1). Rows of a frame
    and a target with equal joint values count once in n.

    Args:
        model: a model of any kind; its frames or targets are not used if they are fitted.
        measurements: rows with positions, and optionally orientations.
        fitted_kinds: what is fitted; empty for the errors in the frames of the model.

    Returns:
        Measured minus predicted values, see `errors_of_rows`; NaN where nothing was measured or predicted, and in rows
        without a position if frames or targets are fitted.

    Raises:
        MeasurementError: a frame or a target has fewer than `MIN_CONFIGURATIONS` different joint vectors, there are no
            positions to fit to, or the model lacks a frame or target that is not fitted.
        IdentificationError: an anchor has too few rows to determine its position.
    """
    T = poses_of_rows(model, with_known_names(model, measurements, fitted_kinds))
    if not fitted_kinds:
        return errors_of_rows(T, measurements)
    if measurements.position is None:
        given = " and ".join(sorted(measurements.kinds)) or "none"
        raise MeasurementError(
            f"expected measured positions, to which the {' and the '.join(fitted_kinds)} can be fitted, "
            f"got {given}",
            expected="positions",
            value=given,
            at=Place(measurements.source),
            remedy="omit the fit (balls in sockets, and distances from anchors at unknown points, do not depend on the "
            "base)",
        )
    usable = torch.isfinite(measurements.position).all(-1) & torch.isfinite(T).flatten(1).all(-1)
    rows = measurements.select(usable.nonzero()[:, 0])
    _check_configurations(model, measurements, rows, fitted_kinds)
    known = rows if has_orientation(model) or "tool" in fitted_kinds else replace(rows, rotation=None)
    measured = MeasuredPoses.from_tensors(known.position, known.rotation, LEVER_SHARE * model.robot.reach)
    fit, columns = fit_frames(T[usable], measured, rows, fitted_kinds)
    T = T.index_put((usable.nonzero()[:, 0],), fit)
    leverage = orthonormal_columns(columns.flatten(0, 1)).square().sum(-1).view(-1, 2, 3).sum((0, 2)).tolist()
    errors = ErrorVectors.from_prediction(measurements, T)
    turned = rows.select(measured.has_rotation.nonzero()[:, 0])
    return ErrorVectors(
        errors.position * _enlargement(rows, leverage[0]),
        None if errors.rotation is None else errors.rotation * _enlargement(turned, leverage[1]),
    )


def _readings(rows: Measurements) -> int:
    """Return the number of different combinations of joint values, frame and target; repeats are not independent."""
    return len(set(zip(groups_to_keep_whole(rows).tolist(), rows.frame, rows.target, strict=True)))


def _enlargement(rows: Measurements, fitted: float) -> float:
    """Compute the factor on errors that corrects for the number of fitted parameters."""
    values = 3 * _readings(rows)
    return float((values / (values - fitted)) ** 0.5) if fitted else 1.0


def _check_configurations(
    model: CalibratedModel,
    measurements: Measurements,
    rows: Measurements,
    fitted_kinds: Collection[FrameKind],
) -> None:
    """Refuse frames and targets with too few rows for a fit."""
    names = {
        "base": ("frame", measurements.frame, rows.frame),
        "tool": ("target", measurements.target, rows.target),
    }
    for kind in fitted_kinds:
        what, wanted, there = names[kind]
        for name in dict.fromkeys(wanted):
            of_name = torch.tensor(
                [index for index, other in enumerate(there) if other == name], dtype=torch.int64
            )
            count = len(set(groups_to_keep_whole(rows.select(of_name)).tolist()))
            if count < MIN_CONFIGURATIONS:
                raise MeasurementError(
                    f"expected {MIN_CONFIGURATIONS} or more different joint vectors of {what} '{name}' whose positions "
                    f"the model '{model.name}' predicts, got {count}",
                    expected=f"{MIN_CONFIGURATIONS} or more joint vectors of {what} '{name}'",
                    value=count,
                    at=Place(measurements.source),
                    remedy="measure more poses",
                )


def fit_frames(
    T: Float64[Tensor, "rows 4 4"],
    measured: MeasuredPoses,
    rows: Measurements,
    fitted_kinds: Collection[FrameKind],
) -> tuple[Float64[Tensor, "rows 4 4"], Float64[Tensor, "rows 6 numbers"]]:
    """Fit bases and tools of rows to their measured poses.

    Bases or tools alone are fitted in closed form; both together are then refined by the Levenberg-Marquardt method.

    Args:
        T: predicted poses, with any bases and tools.
        measured: measured poses of the rows.
        rows: the rows, with the names of frames and targets.
        fitted_kinds: what is fitted.

    Returns:
        The poses, and the derivatives of their values with respect to all fitted parameters, see `frame_jacobian`.
    """
    frame, target = numbers_of_names(rows.frame), numbers_of_names(rows.target)
    bases, tools = (torch.eye(4).to(T).repeat(int(number.max()) + 1, 1, 1) for number in (frame, target))
    if "base" in fitted_kinds:
        bases = _each(best_base, T, measured, frame)
    if "tool" in fitted_kinds:
        tools = _each(best_tool, bases[frame] @ T, measured, target)
    columns, error = _columns(T, measured, (bases, frame), (tools, target), fitted_kinds)
    damping = INITIAL_DAMPING
    for _ in range(MAX_ITERATIONS if len(fitted_kinds) > 1 else 0):
        A = columns.flatten(0, 1)
        normal = A.mT @ A
        damped = normal + torch.diag(damping * normal.diagonal() + 1e-12 * len(T))
        steps = torch.linalg.solve(damped, A.mT @ error.flatten()).view(-1, 6)
        moved = moved_frame(bases, steps[: len(bases)]), moved_frame(tools, steps[len(bases) :])
        tried = _columns(T, measured, (moved[0], frame), (moved[1], target), fitted_kinds)
        gain = float(error.square().sum() - tried[1].square().sum())
        if gain > 0:
            settled = gain <= CONVERGENCE_TOLERANCE * float(error.square().sum())
            (bases, tools), (columns, error), damping = moved, tried, damping / 10
            if settled:
                break
        else:
            damping *= 10
    return bases[frame] @ T @ tools[target], columns


def _each(
    fit: Callable[[Tensor, MeasuredPoses], Tensor],
    T: Tensor,
    measured: MeasuredPoses,
    number: Int64[Tensor, " rows"],
) -> Float64[Tensor, "frames 4 4"]:
    """Fit the transform of every frame or target in closed form."""
    chosen = [number == k for k in range(int(number.max()) + 1)]
    return torch.stack([fit(T[rows], measured.select(rows)) for rows in chosen])


def _columns(
    T: Float64[Tensor, "rows 4 4"],
    measured: MeasuredPoses,
    bases: tuple[Tensor, Int64[Tensor, " rows"]],
    tools: tuple[Tensor, Int64[Tensor, " rows"]],
    fitted_kinds: Collection[FrameKind],
) -> tuple[Float64[Tensor, "rows 6 numbers"], Float64[Tensor, "rows 6"]]:
    """Compute derivatives with respect to the fitted bases and tools, and the errors; see `frame_jacobian`."""
    J, error = frame_jacobian(T, measured, bases[0][bases[1]], tools[0][tools[1]])
    blocks = []
    for kind, (frames, number), part in zip(
        ("base", "tool"), (bases, tools), torch.split(J, 6, -1), strict=True
    ):
        if kind in fitted_kinds:
            of_row = torch.nn.functional.one_hot(number, len(frames)).to(part)
            blocks.append((of_row[:, None, :, None] * part[:, :, None, :]).flatten(2))
    return torch.cat(blocks, -1), error
