"""The verdict on a calibration: one sentence, what it rests on, and where the calibration is worst."""

import functools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.page.accuracy import Accuracy, JudgedJoint, Limit
from pisigma.reporting.page.dependence import LEAST_ROWS, error_lengths, root_mean_square
from pisigma.reporting.rendering import sentences
from pisigma.validation.held_out.judged_rows import JudgedRows
from pisigma.validation.held_out.rank_tests import SIGNIFICANT, groups_differ

CELLS = 4
"""Cells of the measured space along every axis."""

_say = functools.partial(sentences, "report.txt.j2")


@dataclass(frozen=True)
class Verdict:
    """What there is to say first.

    Attributes:
        sentence: how accurate, how much better than nominal, where worst, what limits it.
        worst: where it is worst, in a sentence.
        limit: what limits it, in a sentence.
        held_out: whether the sentence rests on rows that the model was made without.
        joint: the worst joint of a network, where no pose was judged.
    """

    sentence: str
    worst: str
    limit: str
    held_out: bool
    joint: JudgedJoint | None = None


@dataclass(frozen=True)
class Region:
    """The cell of the measured space with the largest errors.

    Attributes:
        low: its corner [m].
        high: the opposite corner [m].
        rows: how many are in it.
        rms: of their errors.
        ratio: RMS over that of all rows.
        significant: whether errors there are larger than elsewhere more than by chance.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    rows: int
    rms: float
    ratio: float
    significant: bool


def verdict_of(
    model: CalibratedModel,
    accuracies: tuple[Accuracy, ...],
    joints: tuple[JudgedJoint, ...],
    rows: JudgedRows | None,
    limit: Limit,
) -> Verdict:
    """Put the verdict together.

    Args:
        model: the model.
        accuracies: the first one counts.
        joints: errors of joints, which count where no pose was judged.
        rows: judged rows, or None.
        limit: what limits the accuracy.
    """
    if not accuracies:
        return _without_poses(model, joints)
    best = accuracies[0]
    clause, worst = _worst(model, rows)
    clauses = [*_say("how_accurate", model, best), *([clause] if clause else [])]
    clauses += [f"what limits it is {limit.clause}"] if best.unit == "mm" else []
    return Verdict(f"{'; '.join(clauses)}.", worst, limit.sentence, best.held_out)


def _without_poses(model: CalibratedModel, joints: tuple[JudgedJoint, ...]) -> Verdict:
    """Say what joint errors say where no pose was judged."""
    if not joints:
        advice = "Give a file with measurements that the model was not made of."
        return Verdict(_say("no_figures", model)[0], "", advice, held_out=False)
    of_kind = [one for one in joints if one.held_out == joints[0].held_out]
    worst = max(of_kind, key=lambda one: one.errors.after.values[0])
    advice = "Give a file with measured positions or poses to judge them."
    return Verdict(_say("how_accurate_joint", model, worst)[0], "", advice, worst.held_out, worst)


def _worst(model: CalibratedModel, rows: JudgedRows | None) -> tuple[str, str]:
    """Say where errors are largest: a clause for the verdict and a sentence; both empty without rows."""
    if rows is None:
        return "", ""
    _, after, unit = error_lengths(rows)
    finite = np.isfinite(after)
    if not finite.any():
        return "", ""
    place, errors = rows.place.numpy()[finite], after[finite]
    region, worst = worst_region(place, errors), int(errors.argmax())
    number = int(np.flatnonzero(finite)[worst])
    joints = [
        f"{np.degrees(value):.1f} deg" if turns else f"{value * 1e3:.1f} mm"
        for value, turns in zip(rows.measurements.q.numpy()[number], model.robot.revolute, strict=True)
    ]
    at = [round(value * 1e3) for value in place[worst].tolist()]
    (row,) = _say("worst_row", rows, number, float(errors[worst]), unit, at, joints)
    if region is None:
        return "", row
    where = ", ".join(
        f"{axis} {round(low * 1e3)} to {round(high * 1e3)}"
        for axis, low, high in zip("xyz", region.low, region.high, strict=True)
    )
    clause, sentence = _say("worst_region", region, where, unit, rows.origin)
    return clause, f"{sentence} {row}"


def worst_region(place: Float64[np.ndarray, "rows 3"], errors: Float64[np.ndarray, " rows"]) -> Region | None:
    """Find the cell of a grid over the measured space whose errors are surely the largest.

    Args:
        place: position of every row [m].
        errors: their lengths, all finite.

    Returns:
        None where there are too few rows, or all are in one cell.
    """
    low, high = (place.min(0), place.max(0)) if len(place) else (np.zeros(3), np.zeros(3))
    width = np.where(high > low, (high - low) / CELLS, 1.0)
    cell = np.clip(((place - low) / width).astype(int), 0, CELLS - 1)
    number = (cell * [CELLS * CELLS, CELLS, 1]).sum(1)
    least = max(LEAST_ROWS, len(errors) // 100)
    cells = [(int(k), errors[number == k]) for k in np.unique(number)]
    cells = [(k, inside) for k, inside in cells if len(inside) >= least]
    if len(cells) < 2:
        return None
    # one standard error less, so that a cell of few rows is not the worst by luck
    worst, _ = max(cells, key=lambda one: root_mean_square(one[1]) * (1 - 1 / math.sqrt(len(one[1]))))
    inside = number == worst
    _, chance = groups_differ(inside.astype(int), errors)
    corner = low + width * cell[inside][0]
    rms = root_mean_square(errors[inside])
    return Region(
        low=tuple(corner.tolist()),
        high=tuple((corner + width).tolist()),
        rows=int(inside.sum()),
        rms=rms,
        ratio=rms / root_mean_square(errors),
        significant=chance < SIGNIFICANT / len(cells),
    )
