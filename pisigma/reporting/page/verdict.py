"""The verdict on a calibration: one sentence, what it rests on, and where the calibration is worst."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.judging.rank_tests import SIGNIFICANT, groups_differ
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.page.accuracy import Accuracy, JudgedJoint, Limit
from pisigma.reporting.page.dependence import LEAST_ROWS, error_lengths, root_mean_square
from pisigma.reporting.page.judged_rows import JudgedRows
from pisigma.reporting.tables import figure_text

CELLS = 4
"""Cells of the measured space along every axis."""

_AMONG = {
    "held_out": "Of the held-out rows",
    "training": "Of the rows that the model was made of",
    "other": "Of the rows of the file",
}


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
    clauses = [_how_accurate(model, best), *([clause] if clause else [])]
    clauses += [f"what limits it is {limit.clause}"] if best.unit == "mm" else []
    return Verdict(f"{'; '.join(clauses)}.", worst, limit.sentence, best.held_out)


def _how_accurate(model: CalibratedModel, best: Accuracy) -> str:
    rms, p95, largest = (figure_text(best.figure(name)) for name in ("rms", "p95", "max"))
    whose = "that it never saw" if best.held_out else "that it was made of"
    within = f"{rms} {best.unit} RMS (95 % within {p95}, all within {largest})"
    if best.reference:
        return f"On {best.rows} poses {whose}, {model.name} keeps the tool to {within} at {best.reference}"
    quantity = "position" if best.unit == "mm" else "orientation"
    text = f"On {best.rows} rows {whose}, {model.name} predicts the {quantity} to {within}"
    if best.factor is None:
        return text
    nominal = f"the nominal robot ({figure_text(best.figure('rms', 'nominal'))} {best.unit})"
    if best.factor >= 1:
        return f"{text}, {best.factor:.1f} times better than {nominal}"
    return (
        f"{text}, {1 / best.factor:.1f} times worse than {nominal}: check that the rows are in the frame and of the "
        "target that the model was fitted to"
    )


def _without_poses(model: CalibratedModel, joints: tuple[JudgedJoint, ...]) -> Verdict:
    """Say what joint errors say where no pose was judged."""
    if not joints:
        sentence = (
            f"{model.name} holds no figures of its accuracy, and no measurements were given: nothing can be said of "
            "how accurate it is."
        )
        advice = "Give a file with measurements that the model was not made of."
        return Verdict(sentence, "", advice, held_out=False)
    held_out = joints[0].held_out
    worst = max(
        (one for one in joints if one.held_out == held_out), key=lambda one: one.errors.after.values[0]
    )
    averages = worst.errors.before.values[0], worst.errors.after.values[0]
    before, after = (f"{figure_text(average)} {worst.unit}" for average in averages)
    times = (
        f", {averages[0] / averages[1]:.0f} times better than nominal ({before})" if averages[1] > 0 else ""
    )
    sentence = (
        f"{'On rows that it never saw' if held_out else 'On the very rows that it was made of'}, {model.name} "
        f"gives the joint values of poses to {after} on average at its worst joint, {worst.name}"
        f"{times}; no pose errors were judged, so nothing is known of a measured robot."
    )
    advice = "Give a file with measured positions or poses to judge them."
    return Verdict(sentence, "", advice, held_out, worst)


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
    line = rows.measurements.line[number]
    at = ", ".join(str(round(value * 1e3)) for value in place[worst].tolist())
    joints = ", ".join(
        f"{np.degrees(value):.1f} deg" if turns else f"{value * 1e3:.1f} mm"
        for value, turns in zip(rows.measurements.q.numpy()[number], model.robot.revolute, strict=True)
    )
    row = (
        f"{_AMONG[rows.origin]} the worst is {f'line {line}' if line else f'row {number + 1}'} of "
        f"{rows.measurements.source}: {figure_text(float(errors[worst]))} {unit} at x, y, z = {at} mm of the robot's "
        f"base, joints {joints}."
    )
    return _region_text(region, unit, row, rows.origin)


def _region_text(region: Region | None, unit: str, row: str, origin: str) -> tuple[str, str]:
    if region is None:
        return "", row
    as_far = " (as far as the rows that it was made of tell)" if origin == "training" else ""
    if not region.significant:
        return (
            f"nowhere in the measured space is it worse than elsewhere by more than chance{as_far}",
            f"No part of the measured space is worse than the others by more than chance. {row}",
        )
    ranges = ", ".join(
        f"{axis} {round(low * 1e3)} to {round(high * 1e3)}"
        for axis, low, high in zip("xyz", region.low, region.high, strict=True)
    )
    rms = f"{figure_text(region.rms)} {unit} RMS"
    return (
        f"it is worst around {ranges} mm of the robot's base, {rms}{as_far}",
        f"Largest errors in {ranges} mm of the robot's base: {rms} over {region.rows} rows, {region.ratio:.1f} times "
        f"that of all rows, more than by chance. {row}",
    )


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
