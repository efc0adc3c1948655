"""Whether what a recalibration came to may be trusted."""

import math
from collections.abc import Sequence

import torch

from pisigma.lifetime.recalibration.candidates import Gate
from pisigma.lifetime.recalibration.moved import Moved
from pisigma.lifetime.recalibration.wear import beyond_wear
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.model_posterior import FLEET_PRIOR
from pisigma.validation.checks.rows.mixed_rows import MOST_WRONG, many_wrong
from pisigma.validation.gate import check_rows
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.predicted_spread import image_deviation
from pisigma.validation.setup_faults.explanations import PLAUSIBLE_SHARE

SUSPICIOUS = 5.0
"""Left-out rows are missed by so many times what single positions scattered by when the model was made."""


def recalibration_diagnostics(
    parent: CalibratedModel,
    judged: Gate,
    rows: Measurements,
    wrong: Sequence[int],
    moved: Sequence[Moved],
) -> tuple[Diagnostic, ...]:
    """Say why the result is not to be trusted, although the checks of the rows found nothing.

    Args:
        parent: the model that the rows were added to.
        judged: errors of left-out rows.
        rows: all rows.
        wrong: numbers of those that were left out.
        moved: what is said to have moved.
    """
    if len(wrong) > MOST_WRONG * rows.rows:
        chosen = torch.zeros(rows.rows, dtype=torch.bool)
        chosen[list(wrong)] = True
        return (many_wrong(rows, chosen),)
    if judged.kept == "scratch" and (
        implausible := check_rows(rows, parent.drawn or parent.robot).implausible
    ):
        return implausible
    return (*_left_out(parent, judged, rows), *beyond_wear(parent.robot, moved))


def _left_out(parent: CalibratedModel, judged: Gate, rows: Measurements) -> tuple[Diagnostic, ...]:
    """Left-out rows that no candidate predicts."""
    error, limit = judged.rms[judged.kept], PLAUSIBLE_SHARE * parent.robot.reach
    if error is None:
        return ()
    noise = {} if parent.uncertainty is None else parent.uncertainty.noise
    usual = max(math.sqrt(3) * noise.get("position", 0.0), image_deviation(rows))
    missed = f"{rows.source}: left-out rows are missed by {error * 1e3:.3g} mm"
    if error > limit:
        sentence = (
            f"{missed}, more than {PLAUSIBLE_SHARE:.0%} of the reach of robot '{parent.robot.name}': they are not of "
            "this robot, or their columns or units are wrong; run `pisigma verify` on them."
        )
    elif error > SUSPICIOUS * usual > 0 and parent.kind != FLEET_PRIOR:
        sentence = (
            f"{missed}, while single positions scattered by {usual * 1e3:.2g} mm when the model was made: rows may be "
            "wrong or of another specimen, or more has changed than so few rows can say. Check the rows with `pisigma "
            "verify`, or measure more of them."
        )
    else:
        return ()
    return (Diagnostic(kind="residual", severity="implausible", sentence=sentence),)
