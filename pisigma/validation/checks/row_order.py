"""Whether the measuring frame or the tool moved while the rows were measured."""

import math
from collections.abc import Iterator

from pisigma.calibration.hybrid.search import CLEARLY
from pisigma.measurement.dataset import Measurements
from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.cause import length_text
from pisigma.validation.setup_faults.row_order import Motion, find_motion

LIKELY = CLEARLY + math.log(100.0)
"""Log Bayes factor from which on a motion is reported, if something moves in one of a hundred measurements."""
CERTAIN = CLEARLY + math.log(1e6)
"""Log Bayes factor from which on one may make a calibration implausible: no healthy one in a million is to be lost."""
LARGE = 1.5
"""Errors that are so many times as large as without the motion do not come from noise and robot any more."""


class RowOrderCheck(AbstractCheck):
    """Tests residuals against the order of the rows.

    A motion is reported where it is `LIKELY`. It makes the calibration implausible where it is `CERTAIN` and `LARGE`
    against all that is left without it. A hybrid leaves less, so that smaller motions show; but a large one becomes a
    part of it, so that both calibrations are looked at. A tool that seems to have moved just where the rows of another
    frame begin is what the frames leave unexplained, unless the motion is `LARGE`.
    """

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        motions = [find_motion(checked.geometric)]
        if checked.hybrid is not None and checked.hybrid.learned is not None:
            motions.append(find_motion(checked.hybrid))
        likely = [
            motion
            for motion in motions
            if motion
            and motion.log_bayes_factor > LIKELY
            and not (motion.begins_frame and motion.factor <= LARGE)
        ]
        if likely:
            motion = max(likely, key=lambda motion: motion.factor)
            certain = motion.log_bayes_factor > CERTAIN and motion.factor > LARGE
            yield Diagnostic(
                kind="row_order",
                severity="implausible" if certain else "warning",
                sentence=_sentence(motion, checked.rows),
            )


def _sentence(motion: Motion, rows: Measurements) -> str:
    """Say what moved, from where on and by how much, and what to do."""
    what = {"frame": "measuring frame", "target": "target on the tool", "tool": "tool"}[motion.moved]
    what += f" '{motion.name}'" if motion.name and motion.moved != "tool" else ""
    x, y, z = motion.shift * 1e3
    amount = f"{length_text(math.hypot(*motion.shift))} (x {x:.3g}, y {y:.3g}, z {z:.3g} mm "
    amount += "in its axes)" if motion.moved == "frame" else "in the flange's axes)"
    amount += f" and {math.degrees(motion.turn):.2g} deg" if motion.turn > 0 else ""
    errors = f"the errors of the rows are {motion.factor:.3g} times as large as they would be without that"
    if motion.first is None:
        return (
            f"{rows.source}: the {what} moves slowly while the rows are measured, by up to {amount}; {errors}. Let the "
            "instrument warm up, fasten its stand and the tool, and measure again, or begin new frames at several "
            "lines (--new-frame-at)."
        )
    row = int(motion.rows[motion.first])
    remedy = "name another target there (column 'target')"
    if motion.moved == "frame":
        remedy = f"give them a frame of their own (--new-frame-at {rows.line[row] or 'LINE'})"
    return (
        f"{rows.place(row)}: from this row on the {what} has moved by {amount}; {errors}. Leave out the rows from "
        f"there on, or {remedy}."
    )
