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
"""Log Bayes factor above which a motion is reported, assuming that something moves in 1 of 100 measurements."""
CERTAIN = CLEARLY + math.log(1e6)
"""Log Bayes factor above which a motion can make a calibration implausible: at most 1 healthy one in a million is."""
LARGE = 1.5
"""Errors over those without the motion above which noise and robot cannot be their only cause."""


class RowOrderCheck(AbstractCheck):
    """Tests the residuals for a motion of a frame or the tool at some row, or a slow one over all rows.

    A motion is reported if it is `LIKELY`. It makes the calibration implausible if it is `CERTAIN` and its factor on
    the residuals is `LARGE`. A hybrid has smaller residuals, so smaller motions show; but it absorbs a part of large
    ones, so both calibrations are tested. A tool that seems to have moved exactly where the rows of another frame start
    is an effect of what the frames do not explain, unless the factor is `LARGE`.
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
                cause=motion.moved,
                values=_values(motion, checked.rows),
            )


def _values(motion: Motion, rows: Measurements) -> dict[str, float | int | str]:
    values: dict[str, float | int | str] = {
        "name": motion.name,
        "shift_mm": math.hypot(*motion.shift) * 1e3,
        "turn_deg": math.degrees(motion.turn),
        "factor": motion.factor,
    }
    if motion.first is not None:
        row = int(motion.rows[motion.first])
        values |= {"first_row": row, "first_line": rows.line[row]}
    return values


def _sentence(motion: Motion, rows: Measurements) -> str:
    """Say what moved, at which row and how far, and what to do."""
    what = {"frame": "measuring frame", "target": "target on the tool", "tool": "tool"}[motion.moved]
    what += f" '{motion.name}'" if motion.name and motion.moved != "tool" else ""
    x, y, z = motion.shift * 1e3
    amount = f"{length_text(math.hypot(*motion.shift))} (x {x:.3g}, y {y:.3g}, z {z:.3g} mm "
    amount += "in its axes)" if motion.moved == "frame" else "in the flange's axes)"
    amount += f" and {math.degrees(motion.turn):.2g} deg" if motion.turn > 0 else ""
    errors = f"this makes the errors of the rows {motion.factor:.3g} times as large"
    if motion.first is None:
        return (
            f"{rows.source}: the {what} moved slowly while the rows were measured, by up to {amount}; {errors}. Let "
            "the instrument warm up, fasten its stand and the tool, and measure again, or start new frames at several "
            "lines (--set new_frame_at=LINE)."
        )
    row = int(motion.rows[motion.first])
    remedy = "name another target in them (column 'target')"
    if motion.moved == "frame":
        remedy = f"give them another frame (--set new_frame_at={rows.line[row] or 'LINE'})"
    return (
        f"{rows.place(row)}: the {what} moved before this row by {amount}; {errors}. Leave out this row and the later "
        f"ones, or {remedy}."
    )
