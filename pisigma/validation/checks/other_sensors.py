"""Checks of rows without positions, such as balls in sockets, and of stated distances between sockets."""

import math
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.initial_guess.initial_guess import MIN_TURN
from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.robot.robot_class import plausible_error_per_reach
from pisigma.robot.se3 import transform
from pisigma.validation.checks.check import LARGE_SHARE, MIN_POSITION_ROWS, Move, kinds_to_fit
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.frames.fitted_frames import FrameKind, with_known_names
from pisigma.validation.held_out.frames.row_errors import errors_of_rows
from pisigma.validation.held_out.model_comparison import ModelComparison, ModelFigures
from pisigma.validation.setup_faults.cause import Cause, length_text
from pisigma.validation.setup_faults.hypothesis import COLLAPSED
from pisigma.validation.setup_faults.joint_faults import joint_causes, signs_and_swaps
from pisigma.validation.setup_faults.setup_fault import SetupFault, fault_of_cause
from pisigma.validation.setup_faults.setup_faults import unexplained_diagnostic

FAR, _STRETCHED = 3.0, 0.01
"""Limits for a stated distance, which is wrong if it is off by more than the first times the RMS error of the rows plus
the second times the distance."""

MAX_ITERATIONS, _MIN_GAIN, _STEP, MAX_STEP = 8, 0.9, 1e-6, 0.3
"""Settings of the fit of motions: number of iterations, ratio of successive errors at which it ends,
finite-difference step and largest step [rad or m]."""


def distance_diagnostics(comparison: ModelComparison, figures: ModelFigures) -> Iterator[Diagnostic]:
    """Report stated distances between sockets that a model contradicts by more than the scatter of its rows.

    Args:
        comparison: comparison of models on the rows of the sockets.
        figures: figures of one of the compared models.
    """
    distances = () if comparison.socket_distance is None else comparison.socket_distance.each
    rms = figures.position.statistics["rms"]
    for one in distances:
        error = one.errors_mm[figures.name]
        if abs(error) > FAR * rms + _STRETCHED * one.stated_mm:
            yield Diagnostic(
                kind="socket_distance",
                severity="implausible",
                sentence=f"{figures.name}: the sockets {' and '.join(one.sockets)} are {one.stated_mm + error:.6g} mm "
                f"apart according to their rows, not {one.stated_mm:.6g} mm as stated, while the rows of every socket "
                f"agree to {rms:.3g} mm RMS; check the distance, the names of the sockets and the scale of the robot.",
                cause=figures.name,
                values={"stated_mm": one.stated_mm, "measured_mm": one.stated_mm + error},
            )


def diagnose_lengths(
    model: CalibratedModel,
    rows: Measurements,
    fitted_kinds: Collection[FrameKind],
    allowed_moves: Collection[Move],
) -> tuple[tuple[Diagnostic, ...], tuple[SetupFault, ...]]:
    """Report the causes of errors that are too large for wear, in rows without positions.

    The hypotheses, tried one at a time, are a reversed sign of each joint, a swap of two neighbouring joints, a moved
    zero of each joint, and another tool.

    Args:
        model: the model.
        rows: rows without positions. Rows of an anchor with too few rows are not checked; touches and wires to
            stated points are not checked if the base may have moved, because they depend on the base.
        fitted_kinds: frames and tools that are known to have moved.
        allowed_moves: what else may have moved without this being a fault.

    Returns:
        The findings that make the rows implausible, and the setup fault that explains them, which may be a motion.
    """
    kinds = kinds_to_fit(model, rows, fitted_kinds)
    free = {"tool"} & {*kinds}
    moves = free | ({*allowed_moves} - {"frame"})
    if ("base" in kinds or "frame" in allowed_moves) and (
        rows.touch is not None or rows.anchor_place is not None
    ):
        return (), ()
    known, reach = with_known_names(model, rows, kinds), model.robot.reach
    limit = plausible_error_per_reach(model.robot) * reach
    with suppress(IdentificationError):
        errors = _errors(model, known)
        if (
            int(torch.isfinite(errors).all(-1).sum()) < MIN_POSITION_ROWS
            or not _rms(errors) > LARGE_SHARE * reach
        ):
            return (), ()
        fault = _fault(model, known, free)
        faults = () if fault is None else (fault,)
        left = _fitted(model, known, _numbers(rows.dof, moves))[0]
        if left <= min(COLLAPSED * _rms(errors), limit):
            return (), faults
        if fault is not None and not moves.issuperset(fault.kinds):
            return (fault.diagnostic(),), faults
        if left > limit:
            return (unexplained_diagnostic(model),), faults
        return (), faults
    return (), ()


def _fault(model: CalibratedModel, rows: Measurements, free: Collection[str]) -> SetupFault | None:
    """Return the fault that explains the errors best; None if no fault explains them."""
    before, dof = _rms(_errors(model, rows)), rows.dof
    maps = signs_and_swaps(dof)
    found = [
        (_rms(_errors(model, replace(rows, q=q))), joint_causes(maps, number, model.robot)[0])
        for number, q in enumerate(maps.apply(rows.q))
    ]
    found.append(_moved_most(model, rows, free))
    after, cause = min(found, key=lambda one: one[0])
    if not after <= COLLAPSED * before:
        return None
    return fault_of_cause(cause, before, after)


def _moved_most(model: CalibratedModel, rows: Measurements, free: Collection[str]) -> tuple[float, Cause]:
    """Return the smallest errors [m] that remain after moving one joint zero or the tool, and the cause.

    The joint is chosen with errors linearised at the model; then joint and tool are fitted by iteration.
    """
    dof, fitted = rows.dof, _numbers(rows.dof, free)
    error = _errors(model, rows)
    columns = _columns(model, rows, torch.zeros(dof + 3, dtype=torch.float64), range(dof + 3), error)
    b = torch.nan_to_num(error).flatten()

    def left(numbers: list[int]) -> float:
        J = columns[:, [*fitted, *numbers]]
        return float((b - J @ _least_squares(J, b)).norm())

    tried = [min(([joint] for joint in range(dof)), key=left)]
    tried += [] if "tool" in free else [_numbers(dof, {"tool"})]
    results = [(*_fitted(model, rows, [*fitted, *numbers]), numbers) for numbers in tried]
    after, x, best = min(results, key=lambda one: one[0])
    if len(best) > 1:
        clause = f"the tool has moved by {length_text(float(x[best].norm()))}"
        return after, Cause("tool", clause, "check which tool is mounted, or recalibrate the model", 3.0)
    (joint,) = best
    moved = float(x[joint])
    amount = f"{math.degrees(moved):.3g} deg" if model.robot.revolute[joint] else length_text(moved)
    clause = f"the zero of joint {joint + 1} is {amount} off"
    return after, Cause("joint_zero", clause, "recalibrate the model, or check the zero", 1.0, (joint,))


def _numbers(dof: int, moves: Collection[str]) -> list[int]:
    """Return the indices of the unknowns that may have moved: joint zeros, and 3 coordinates of the tool."""
    kinds = (("joint_zero", range(dof)), ("tool", range(dof, dof + 3)))
    return [number for kind, numbers in kinds if kind in moves for number in numbers]


def _fitted(
    model: CalibratedModel, rows: Measurements, free: Sequence[int]
) -> tuple[float, Float64[Tensor, " numbers"]]:
    """Fit the free unknowns; return the RMS residual [m], corrected for the degrees of freedom, and the unknowns."""
    x = torch.zeros(rows.dof + 3, dtype=torch.float64)
    least, best = float("inf"), x
    for _ in range(MAX_ITERATIONS if free else 1):
        error = _errors(model, rows, x)
        here = _rms(error)
        if not here < _MIN_GAIN * least:
            break
        least, best = here, x
        if free:
            J = _columns(model, rows, x, free, error)
            step = _least_squares(J, -torch.nan_to_num(error).flatten())
            x = x.index_add(0, torch.tensor(free), step.clamp(-MAX_STEP, MAX_STEP))
    values = int((torch.nan_to_num(error) != 0).sum())
    return least * (values / max(values - len(free), 1)) ** 0.5, best


def _least_squares(
    J: Float64[Tensor, "values free"], b: Float64[Tensor, " values"]
) -> Float64[Tensor, " free"]:
    """Solve `J x = b` in least squares; directions that the orientations of the rows hardly determine stay at 0.

    The noise of the rows looks like information on such directions, and would move a tool along them by hundreds of mm.
    """
    rows = int((J.view(-1, 3, J.shape[1]) != 0).any(-1).any(-1).sum())
    solution: Tensor = torch.linalg.pinv(J, atol=MIN_TURN * rows**0.5, rtol=0.0) @ b
    return solution


def _columns(
    model: CalibratedModel,
    rows: Measurements,
    x: Float64[Tensor, " numbers"],
    free: Sequence[int],
    error: Float64[Tensor, "rows 3"],
) -> Float64[Tensor, "values free"]:
    """Return the derivatives of all errors with respect to the free unknowns, by finite differences."""
    eye = _STEP * torch.eye(len(x), dtype=torch.float64)
    columns = [((_errors(model, rows, x + eye[number]) - error) / _STEP).flatten() for number in free]
    return torch.nan_to_num(torch.stack(columns, -1))


def _errors(
    model: CalibratedModel, rows: Measurements, x: Float64[Tensor, " numbers"] | None = None
) -> Float64[Tensor, "rows 3"]:
    """Compute the errors [m], with joint zeros [rad or m] and tool [m] moved by `x` if given."""
    if x is None:
        return errors_of_rows(poses_of_rows(model, rows), rows).position
    zeros, tool = torch.split(x, [rows.dof, 3])
    T = poses_of_rows(model, replace(rows, q=rows.q + zeros))
    T = T @ transform(torch.eye(3, dtype=T.dtype), tool)
    return errors_of_rows(T, rows).position


def _rms(errors: Float64[Tensor, "rows 3"]) -> float:
    """Compute the RMS length [m] of the rows that have an error."""
    there = torch.isfinite(errors).all(-1)
    return float(errors[there].square().sum(-1).mean().sqrt())
