"""Whether a fault of the setup or the file explains errors that are too large for the nominal robot."""

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float64

from pisigma.calibration.geometric.initial_guess.base_and_tool import fit_base_and_tool
from pisigma.files.errors import IdentificationError, Place
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.robot_class import HOBBY
from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic, Severity
from pisigma.validation.setup_faults.cause import length_text
from pisigma.validation.setup_faults.nominal_robot_faults import are_unrelated, find_nominal_robot_faults
from pisigma.validation.setup_faults.setup_fault import either

UNRELATED = (
    "The measured positions are unrelated to the joint values of their rows, so the joint values and positions of "
    "different rows belong together; check whether one of them was sorted or comes from another program."
)
MIN_ROWS = 12
"""Rows of a setup: 36 values for the 9 parameters of base and tool of positions."""
FITS_SHARE = 5e-3
"""Errors of the nominal robot as a share of its reach; geometric errors make less."""
FAR = 5.0
"""Errors over those of the rows of one setup above which a row belongs to another setup."""
MAX_WRONG_SHARE = 0.1
"""Share of the rows of a setup that may be far off without contradicting it."""


class SetupFaultCheck(AbstractCheck):
    """Looks for setup faults that explain the errors of the nominal robot; see `find_nominal_robot_faults`.

    A fault makes the calibration implausible, because parameters may absorb it and are then wrong at other poses. A
    joint zero is a parameter: a calibration estimates it correctly, so it is a warning up to the size that is possible
    in any class of robots.
    """

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        yield from setup_diagnostics(checked.robot, checked.rows)


@lru_cache(maxsize=1)  # the same rows are checked before and after a calibration
def setup_diagnostics(robot: Robot, rows: Measurements) -> tuple[Diagnostic, ...]:
    """Report the setup faults that explain the errors of the nominal robot; see `SetupFaultCheck`."""
    if faults := find_nominal_robot_faults(robot, rows):
        fault = either(faults)
        severity: Severity = "implausible" if fault.moved > HOBBY.largest.joint_offset else "warning"
        found = Diagnostic(
            kind="setup_fault",
            severity=severity,
            sentence=fault.sentence,
            cause=fault.cause,
            values=fault.values,
        )
        return (found,)
    if are_unrelated(robot, rows):
        return (
            Diagnostic(kind="setup_fault", severity="implausible", sentence=UNRELATED, cause="unrelated"),
        )
    return ()


def explained(refusal: IdentificationError, robot: Robot, rows: Measurements) -> IdentificationError:
    """Replace a refusal by one that names the setup fault, if one explains the errors; else return it unchanged."""
    if moved := new_setup(robot, rows):
        return moved
    causes = setup_diagnostics(robot, rows)
    if not causes:
        return refusal
    return IdentificationError(causes[0].sentence.removesuffix("."), at=Place(rows.source))


def new_setup(robot: Robot, measurements: Measurements) -> IdentificationError | None:
    """Find the row before which the instrument was moved, for motions so large that no calibration of all rows works.

    Base and tool are fitted to the first and to the last third of the rows. The row is the one up to (or after) which
    the other rows agree with that fit. The rows on both sides must fit the nominal robot on their own.

    Args:
        robot: the nominal robot.
        measurements: rows of one frame and one target with positions; others are not tested.

    Returns:
        The error to raise, with file and line of the row; None if there is no such row.
    """
    one = len(set(measurements.frame)) == len(set(measurements.target)) == 1
    if not one or measurements.position is None or not bool(torch.isfinite(measurements.position).all()):
        return None
    order = np.argsort(np.array(measurements.line), kind="stable")
    third = max(len(order) // 3, MIN_ROWS)
    if len(order) < 2 * MIN_ROWS + 1:
        return None
    for backwards in (False, True):
        along = order[::-1] if backwards else order
        errors = _errors(robot, measurements, along[:third])[along]
        of_setup = errors < FAR * max(float(np.median(errors[:third])), 1e-4)
        # The sum of +1 (agrees) and -1 (does not) peaks at the last row of the setup, despite single wrong rows.
        agreeing = np.cumsum(np.where(of_setup, 1, -1))
        count = int(agreeing.argmax()) + 1
        first = len(order) - count if backwards else count
        parts = order[:first], order[first:]
        if min(map(len, parts)) < MIN_ROWS:
            continue
        if of_setup[:count].mean() < 1 - MAX_WRONG_SHARE or of_setup[count:].mean() > MAX_WRONG_SHARE:
            continue
        fits = [float(np.median(_errors(robot, measurements, part)[part])) for part in parts]
        if max(fits) < FITS_SHARE * robot.reach:
            row = int(order[first])
            return IdentificationError(
                "the instrument or the tool was moved before this row: the rows before it fit the nominal robot "
                f"'{robot.name}' to {length_text(fits[0])} and the others to {length_text(fits[1])}, but not together",
                at=measurements.at(row),
                remedy=f"give this row and the later ones another frame (--set new_frame_at="
                f"{measurements.line[row] or 'LINE'}) and, if the tool was changed, another target",
            )
    return None


def _errors(robot: Robot, measurements: Measurements, rows: np.ndarray) -> Float64[np.ndarray, " rows"]:
    """Compute all position errors [m] with base and tool fitted to some rows; infinite if these do not determine it."""
    try:
        fitted = fit_base_and_tool(robot, measurements.select(torch.from_numpy(rows.copy()))).robot
    except IdentificationError:
        return np.full(measurements.rows, np.inf)
    assert measurements.position is not None
    errors = measurements.position - forward_kinematics(fitted, measurements.q)[:, :3, 3]
    lengths: np.ndarray = errors.norm(dim=1).cpu().numpy()
    return lengths
