"""Check whether the measuring frame or the tool moved while the rows were measured, before and after a calibration."""

import math
from collections.abc import Callable, Iterator

import numpy as np
import torch
from jaxtyping import Float64

from pisigma.calibration.geometric.initial_guess.base_and_tool import fit_base_and_tool, guess_base_and_tool
from pisigma.calibration.hybrid.search import CLEAR_EVIDENCE
from pisigma.files.errors import IdentificationError, Place
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.validation.checks.check import CheckedCalibration
from pisigma.validation.checks.setup_fault import setup_diagnostics
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.cause import length_text
from pisigma.validation.setup_faults.row_order import Motion, find_motion

_LIKELY = CLEAR_EVIDENCE + math.log(100.0)
"""Log Bayes factor above which a motion is reported, assuming that something moves in 1 of 100 measurements."""
_CERTAIN = CLEAR_EVIDENCE + math.log(1e6)
"""Log Bayes factor above which a motion can make a calibration implausible; at most one in a million valid
calibrations is affected."""
_LARGE = 1.5
"""Ratio of the errors with and without the motion above which noise and robot cannot be their only cause."""
_MIN_ROWS = 12
"""Smallest number of rows of a setup: 36 values for the 9 parameters of base and tool of positions."""
_FITS_SHARE = 5e-3
"""Errors of the nominal robot, as a share of its reach, that are larger than geometric errors can cause."""
FAR = 5.0
"""Ratio of an error to the errors of the rows of a setup above which a row belongs to another setup."""
_MAX_WRONG_SHARE = 0.1
"""Share of the rows of a setup that may be far off without contradicting the setup."""


def check_row_order(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Test the residuals for a motion of a frame or the tool at any row, or for a slow motion over all rows.

    A motion is reported if it is `_LIKELY`. It makes the calibration implausible if it is `_CERTAIN` and changes the
    residuals by a `_LARGE` factor. A hybrid has smaller residuals, so smaller motions are visible, but it absorbs part
    of large motions, so both calibrations are tested. A tool that seems to have moved exactly where the rows of another
    frame start is an effect of errors that the frames do not explain, unless the factor is `_LARGE`.
    """
    motions = [find_motion(checked.geometric)]
    if checked.hybrid is not None and checked.hybrid.learned is not None:
        motions.append(find_motion(checked.hybrid))
    likely = [
        motion
        for motion in motions
        if motion
        and motion.log_bayes_factor > _LIKELY
        and not (motion.is_at_frame_start and motion.error_increase_factor <= _LARGE)
    ]
    if likely:
        motion = max(likely, key=lambda motion: motion.error_increase_factor)
        certain = motion.log_bayes_factor > _CERTAIN and motion.error_increase_factor > _LARGE
        what, remedy = _texts(motion, checked.rows)
        yield Diagnostic(
            kind="row_order",
            severity="implausible" if certain else "warning",
            sentence=f"{what}; this makes the errors of the rows {motion.error_increase_factor:.3g} times as large. "
            f"{remedy}",
            row_places=()
            if motion.first_moved_index is None
            else (checked.rows.place(int(motion.row_indices[motion.first_moved_index])),),
            cause=motion.kind,
            values=_values(motion, checked.rows),
            remedy=remedy,
        )


def _values(motion: Motion, rows: Measurements) -> dict[str, float | int | str]:
    values: dict[str, float | int | str] = {
        "name": motion.name,
        "shift_mm": math.hypot(*motion.shift) * 1e3,
        "turn_deg": math.degrees(motion.turn),
        "factor": motion.error_increase_factor,
        "log_odds": motion.log_bayes_factor,
    }
    if motion.first_moved_index is not None:
        row = int(motion.row_indices[motion.first_moved_index])
        values |= {"first_row": row, "first_line": rows.line[row]}
    return values


def _texts(motion: Motion, rows: Measurements) -> tuple[str, str]:
    """Return a text that states what moved, at which row and how far, and a text that states what to do."""
    what = {"frame": "measuring frame", "target": "target on the tool", "tool": "tool"}[motion.kind]
    what += f" '{motion.name}'" if motion.name and motion.kind != "tool" else ""
    x, y, z = motion.shift * 1e3
    amount = f"{length_text(math.hypot(*motion.shift))} (x {x:.3g}, y {y:.3g}, z {z:.3g} mm "
    amount += "in its axes)" if motion.kind == "frame" else "in the flange's axes)"
    amount += f" and {math.degrees(motion.turn):.2g} deg" if motion.turn > 0 else ""
    if motion.first_moved_index is None:
        return (
            f"{rows.source}: the {what} moved slowly while the rows were measured, by up to {amount}",
            "Let the instrument warm up, fasten its stand and the tool, and measure again, or start new frames at "
            "several lines (--set new_frame_at=LINE).",
        )
    row = int(motion.row_indices[motion.first_moved_index])
    naming = "name another target in them (column 'target')"
    if motion.kind == "frame":
        naming = f"give them another frame (--set new_frame_at={rows.line[row] or 'LINE'})"
    return (
        f"{rows.place(row)}: the {what} moved before this row by {amount}",
        f"Leave out this row and the later ones, or {naming}.",
    )


def explain_refusal(refusal: IdentificationError, robot: Robot, rows: Measurements) -> IdentificationError:
    """Return a refusal that names the setup fault that explains the errors; otherwise the unchanged refusal."""
    if moved := instrument_moved_error(robot, rows):
        return moved
    causes = setup_diagnostics(robot, rows)
    if not causes:
        return refusal
    return IdentificationError(causes[0].sentence.removesuffix("."), at=Place(rows.source))


def instrument_moved_error(robot: Robot, measurements: Measurements) -> IdentificationError | None:
    """Find the row before which the instrument was moved so far that no calibration of all rows is possible.

    Base and tool are fitted to the first and to the last third of the rows. The row found is the one up to which (or
    after which) the other rows agree with that fit. The rows on each side must separately fit the nominal robot.

    Args:
        robot: the nominal robot.
        measurements: rows with positions of one frame and one target; other rows are not tested.

    Returns:
        The error to raise, with file and line of the row; None if there is no such row.
    """
    one = len(set(measurements.frame)) == len(set(measurements.target)) == 1
    if not one or measurements.position is None or not bool(torch.isfinite(measurements.position).all()):
        return None
    order = np.argsort(np.array(measurements.line), kind="stable")
    third = max(len(order) // 3, _MIN_ROWS)
    if len(order) < 2 * _MIN_ROWS + 1:
        return None
    if any(
        float(np.median(_errors(robot, measurements, order, fit))) < _FITS_SHARE * robot.reach
        for fit in (_guessed, _fitted)
    ):
        return None  # one setup explains all rows
    for backwards in (False, True):
        along = order[::-1] if backwards else order
        errors = _errors(robot, measurements, along[:third])[along]
        of_setup = errors < FAR * max(float(np.median(errors[:third])), 1e-4)
        # The sum of +1 (agrees) and -1 (does not agree) peaks at the last row of the setup, despite single wrong rows.
        agreeing = np.cumsum(np.where(of_setup, 1, -1))
        count = int(agreeing.argmax()) + 1
        first = len(order) - count if backwards else count
        parts = order[:first], order[first:]
        if min(map(len, parts)) < _MIN_ROWS:
            continue
        if of_setup[:count].mean() < 1 - _MAX_WRONG_SHARE or of_setup[count:].mean() > _MAX_WRONG_SHARE:
            continue
        fits = [float(np.median(_errors(robot, measurements, part)[part])) for part in parts]
        if max(fits) < _FITS_SHARE * robot.reach:
            row = int(order[first])
            return IdentificationError(
                "the instrument or the tool was moved before this row: the rows before it fit the nominal robot "
                f"'{robot.name}' to {length_text(fits[0])} and the others to {length_text(fits[1])}, but not together",
                at=measurements.place_of(row),
                remedy=f"give this row and the later ones another frame (--set new_frame_at="
                f"{measurements.line[row] or 'LINE'}) and, if the tool was changed, another target",
            )
    return None


def _guessed(robot: Robot, rows: Measurements) -> Robot:
    """Return the robot with base and tool guessed in closed form."""
    base, tools = guess_base_and_tool(robot, rows, free_base=True, free_tool=True)
    return robot.with_geometry(base=base, tool=tools[rows.target[0]])


def _fitted(robot: Robot, rows: Measurements) -> Robot:
    """Return the robot with base and tool fitted."""
    return fit_base_and_tool(robot, rows).robot


def _errors(
    robot: Robot,
    measurements: Measurements,
    rows: np.ndarray,
    fit: Callable[[Robot, Measurements], Robot] = _fitted,
) -> Float64[np.ndarray, " rows"]:
    """Compute all position errors [m] with base and tool fitted to the given rows; infinite if undetermined."""
    try:
        fitted = fit(robot, measurements.select(torch.from_numpy(rows.copy())))
    except IdentificationError:
        return np.full(measurements.rows, np.inf)
    assert measurements.position is not None
    errors = measurements.position - forward_kinematics(fitted, measurements.q)[:, :3, 3]
    lengths: np.ndarray = errors.norm(dim=1).cpu().numpy()
    return lengths
