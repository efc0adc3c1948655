"""Whether a mistake in the setup or in the file explains errors that no robot of this drawing has."""

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float64

from pisigma.calibration.geometric.initial_guess.base_and_tool import fit_base_and_tool
from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.robot_class import HOBBY
from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic, Severity
from pisigma.validation.setup_faults.cause import length_text
from pisigma.validation.setup_faults.faults_as_drawn import are_unrelated, find_faults_as_drawn
from pisigma.validation.setup_faults.setup_fault import either

UNRELATED = (
    "The measured positions have nothing to do with the joint values of their rows, so that rows of one side belong to "
    "other rows of the other; look for a side that was sorted, or that is of another program."
)
FEWEST_ROWS = 12
"""Of a setup: 36 values for the 9 numbers of base and tool of positions."""
FITS_SHARE = 5e-3
"""Share of the reach that errors of a robot as drawn may have: geometric errors make less."""
FAR = 5.0
"""Rows are of another setup that are off by so many times the errors of those of one setup."""
MOST_WRONG = 0.1
"""Share of the rows of a setup that may be off all the same."""


class SetupFaultCheck(AbstractCheck):
    """Looks for setup faults under which the errors of the robot as drawn collapse; see `find_faults_as_drawn`.

    A fault makes the calibration implausible, as it may be absorbed by parameters that then are wrong elsewhere. The
    zero of a joint is a parameter: where it has moved, a calibration is right, so up to the size that is possible in
    any class of robots it is a warning.
    """

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        yield from setup_diagnostics(checked.robot, checked.rows)


@lru_cache(maxsize=1)  # the same rows are looked at before a calibration and after it
def setup_diagnostics(robot: Robot, rows: Measurements) -> tuple[Diagnostic, ...]:
    """Say which setup faults explain the errors of the robot as drawn; see `SetupFaultCheck`."""
    if faults := find_faults_as_drawn(robot, rows):
        fault = either(faults)
        severity: Severity = "implausible" if fault.moved > HOBBY.largest.joint_offset else "warning"
        return (Diagnostic(kind="setup_fault", severity=severity, sentence=fault.sentence),)
    if are_unrelated(robot, rows):
        return (Diagnostic(kind="setup_fault", severity="implausible", sentence=UNRELATED),)
    return ()


def explained(refusal: IdentificationError, robot: Robot, rows: Measurements) -> IdentificationError:
    """Name the cause of a refusal where setup faults explain the errors; else return the refusal as it is."""
    if moved := new_setup(robot, rows):
        return IdentificationError(moved)
    causes = setup_diagnostics(robot, rows)
    return IdentificationError(f"{rows.source}: {causes[0].sentence}") if causes else refusal


def new_setup(robot: Robot, measurements: Measurements) -> str | None:
    """Say from which row on the instrument stands elsewhere, for moves that no fit of all rows survives.

    Base and tool are fitted to the first third of the rows, and to the last one; the row is sought up to which, or from
    which on, the others agree with that. The rows on both sides have to fit the robot as drawn by themselves.

    Args:
        robot: as drawn.
        measurements: rows; only those of one frame and one target with positions are looked at.

    Returns:
        A sentence; None where there is no such row.
    """
    one = len(set(measurements.frame)) == len(set(measurements.target)) == 1
    if not one or measurements.position is None or not bool(torch.isfinite(measurements.position).all()):
        return None
    order = np.argsort(np.array(measurements.line), kind="stable")
    third = max(len(order) // 3, FEWEST_ROWS)
    if len(order) < 2 * FEWEST_ROWS + 1:
        return None
    for backwards in (False, True):
        along = order[::-1] if backwards else order
        errors = _errors(robot, measurements, along[:third])[along]
        of_setup = errors < FAR * max(float(np.median(errors[:third])), 1e-4)
        agreeing = np.cumsum(np.where(of_setup, 1, -1))
        count = int(agreeing.argmax()) + 1
        first = len(order) - count if backwards else count
        parts = order[:first], order[first:]
        if min(map(len, parts)) < FEWEST_ROWS:
            continue
        if of_setup[:count].mean() < 1 - MOST_WRONG or of_setup[count:].mean() > MOST_WRONG:
            continue
        fits = [float(np.median(_errors(robot, measurements, part)[part])) for part in parts]
        if max(fits) < FITS_SHARE * robot.reach:
            row = int(order[first])
            return (
                f"{measurements.place(row)}: from this row on the instrument or the tool is elsewhere: the rows before "
                f"it fit robot '{robot.name}' as drawn to {length_text(fits[0])} and the others to "
                f"{length_text(fits[1])}, but not together. Give the rows from there on a frame of their own "
                f"(--new-frame-at {measurements.line[row] or 'LINE'}) and, if the tool was changed, another target."
            )
    return None


def _errors(robot: Robot, measurements: Measurements, rows: np.ndarray) -> Float64[np.ndarray, " rows"]:
    """Lengths of all position errors [m] with base and tool of some rows; infinite where these determine none."""
    try:
        fitted = fit_base_and_tool(robot, measurements.select(torch.from_numpy(rows.copy()))).robot
    except IdentificationError:
        return np.full(measurements.rows, np.inf)
    assert measurements.position is not None
    errors = measurements.position - forward_kinematics(fitted, measurements.q)[:, :3, 3]
    lengths: np.ndarray = errors.norm(dim=1).cpu().numpy()
    return lengths
