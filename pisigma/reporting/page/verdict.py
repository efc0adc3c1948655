"""The verdict on a calibration: one sentence, what it rests on, and where the calibration is worst."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.judging.rank_tests import SIGNIFICANT, groups_differ
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.page.accuracy import Accuracy
from pisigma.reporting.page.dependence import LEAST_ROWS, error_lengths, root_mean_square
from pisigma.reporting.page.judged_rows import JudgedRows
from pisigma.reporting.page.limits import Limit
from pisigma.reporting.tables import figure_text

CELLS = 4
"""Parts of the measured space along every axis."""


@dataclass(frozen=True)
class Verdict:
    """What there is to say first.

    Attributes:
        sentence: how accurate, how much better than nominal, where worst, what limits it.
        tiles: the figures of it: what, figure, remark.
        worst: where it is worst, in a sentence.
        limit: what limits it, in a sentence.
        held_out: whether the sentence rests on rows that the model never saw.
    """

    sentence: str
    tiles: tuple[tuple[str, str, str], ...]
    worst: str
    limit: str
    held_out: bool


@dataclass(frozen=True)
class Region:
    """The part of the space with the largest errors.

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
    model: CalibratedModel, accuracies: tuple[Accuracy, ...], rows: JudgedRows | None, limit: Limit
) -> Verdict:
    """Put the verdict together.

    Args:
        model: the model.
        accuracies: the first one counts.
        rows: judged rows, or None.
        limit: what limits the accuracy.
    """
    if not accuracies:
        return _without_poses(model)
    best = accuracies[0]
    clause, worst = worst_place(model, rows)
    parts = [_how_accurate(model, best)]
    parts += [clause] if clause else []
    parts += [f"what limits it is {limit.clause}"] if best.quantity[0] == "mm" else []
    tiles = _tiles(best)
    if limit.share is not None and limit.noise is not None:
        remark = f"of the squared error; {figure_text(limit.noise)} mm RMS"
        tiles.append(("scatter of a measurement", f"{100 * limit.share:.0f} %", remark))
    return Verdict(f"{'; '.join(parts)}.", tuple(tiles), worst, limit.sentence, best.held_out)


def _how_accurate(model: CalibratedModel, best: Accuracy) -> str:
    unit, quantity = best.quantity
    rms, p95, largest = (figure_text(best.last[f"{name}_{unit}"]) for name in ("rms", "p95", "max"))
    whose = "that it never saw" if best.held_out else "that it was made of"
    if best.reference:
        return (
            f"On {best.rows} poses {whose}, {model.name} keeps the tool to {rms} {unit} RMS (95 % within {p95}, all "
            f"within {largest}) at {best.reference}"
        )
    text = (
        f"On {best.rows} rows {whose}, {model.name} predicts the {quantity} to {rms} {unit} RMS (95 % within {p95}, "
        f"all within {largest})"
    )
    if best.factor is None:
        return text
    nominal = figure_text(best.models["nominal"][f"rms_{unit}"])
    if best.factor >= 1:
        return f"{text}, {best.factor:.1f} times better than the nominal robot ({nominal} {unit})"
    return (
        f"{text}, {1 / best.factor:.1f} times worse than the nominal robot ({nominal} {unit}): check that the rows are "
        "in the frame and of the target that the model was fitted to"
    )


def _tiles(best: Accuracy) -> list[tuple[str, str, str]]:
    unit, quantity = best.quantity
    rms, p95, largest = (
        f"{figure_text(best.last[f'{name}_{unit}'])} {unit}" for name in ("rms", "p95", "max")
    )
    tiles = [
        (f"{quantity}, RMS", rms, f"{best.rows} rows, {best.title}"),
        ("95 % within", p95, f"largest {largest}"),
    ]
    if best.factor is not None:
        nominal = f"nominal {figure_text(best.models['nominal'][f'rms_{unit}'])} {unit} RMS"
        better, times = ("better", best.factor) if best.factor >= 1 else ("worse", 1 / best.factor)
        tiles.append((f"{better} than nominal", f"{times:.1f} ×", nominal))
    if "rms_deg" in best.last and unit == "mm":
        turned, most = (f"{figure_text(best.last[f'{name}_deg'])} deg" for name in ("rms", "max"))
        tiles.append(("orientation, RMS", turned, f"largest {most}"))
    return tiles


def _without_poses(model: CalibratedModel) -> Verdict:
    """What joint errors say where no pose was judged."""
    joints = model.metrics.get("joints") or ()
    if not joints or "training" not in joints[0]:
        return Verdict(
            f"{model.name} holds no figures of its accuracy, and no measurements were given: nothing can be said of "
            "how accurate it is.",
            (), "", "Give a file with measurements that the model was not made of.", False,
        )  # fmt: skip
    part = "held_out" if "held_out" in joints[0] else "training"
    worst = max(joints, key=lambda joint: _average(joint[part]["after"]))
    before, after = (_average(worst[part][when]) for when in ("before", "after"))
    unit = next(iter(worst[part]["after"])).rsplit("_", 1)[1]
    whose = "On rows that it never saw" if part == "held_out" else "On the very rows that it was made of"
    factor = (
        f", {before / after:.0f} times better than nominal ({figure_text(before)} {unit})"
        if after > 0
        else ""
    )
    sentence = (
        f"{whose}, {model.name} gives the joint values of poses to {figure_text(after)} {unit} on average at its worst "
        f"joint, {worst['name']}{factor}; no pose errors were judged, so nothing is known of a measured robot."
    )
    tiles = (
        (
            f"worst joint, {worst['name']}",
            f"{figure_text(after)} {unit}",
            f"average, {part.replace('_', '-')} rows",
        ),
    )
    return Verdict(
        sentence, tiles, "", "Give a file with measured positions or poses to judge them.", part == "held_out"
    )


def _average(figures: Mapping[str, float]) -> float:
    return next(value for name, value in figures.items() if name.startswith("average"))


def worst_place(model: CalibratedModel, rows: JudgedRows | None) -> tuple[str, str]:
    """Where errors are largest: a clause for the verdict and a sentence; both empty without rows."""
    if rows is None:
        return "", ""
    _, after, unit = error_lengths(rows)
    known = np.isfinite(after)
    if not known.any():
        return "", ""
    place, errors = rows.place.numpy()[known], after[known]
    region = worst_region(place, errors)
    worst = int(errors.argmax())
    number = np.flatnonzero(known)[worst]
    at = ", ".join(str(round(value * 1e3)) for value in place[worst].tolist())
    q = rows.measurements.q.numpy()[number]
    joints = ", ".join(
        f"{np.degrees(value):.1f} deg" if turns else f"{value * 1e3:.1f} mm"
        for value, turns in zip(q, model.robot.revolute, strict=True)
    )
    own = (
        f"{_AMONG[rows.origin]} the worst is {_row_text(rows, int(number))}: "
        f"{figure_text(float(errors[worst]))} {unit} at x, y, z = {at} mm of the robot's base, joints {joints}."
    )
    return _region_text(region, unit, own, rows)


_AMONG = {
    "held_out": "Of the held-out rows",
    "training": "Of the rows that the model was made of",
    "other": "Of the rows of the file",
}


def _row_text(rows: JudgedRows, number: int) -> str:
    line = rows.measurements.line[number]
    return (
        f"line {line} of {rows.measurements.source}"
        if line
        else f"row {number + 1} of {rows.measurements.source}"
    )


def _region_text(region: Region | None, unit: str, own: str, rows: JudgedRows) -> tuple[str, str]:
    if region is None:
        return "", own
    seen = " (as far as the rows that it was made of tell)" if rows.origin == "training" else ""
    if not region.significant:
        return (
            f"nowhere in the measured space is it worse than elsewhere by more than chance{seen}",
            f"No part of the measured space is worse than the others by more than chance. {own}",
        )
    ranges = ", ".join(
        f"{axis} {round(low * 1e3)} to {round(high * 1e3)}"
        for axis, low, high in zip("xyz", region.low, region.high, strict=True)
    )
    clause = f"it is worst around {ranges} mm of the robot's base, {figure_text(region.rms)} {unit} RMS{seen}"
    sentence = (
        f"Largest errors in {ranges} mm of the robot's base: {figure_text(region.rms)} {unit} RMS over {region.rows} "
        f"rows, {region.ratio:.1f} times that of all rows, more than by chance. {own}"
    )
    return clause, sentence


def worst_region(place: Float64[np.ndarray, "rows 3"], errors: Float64[np.ndarray, " rows"]) -> Region | None:
    """The cell of a grid over the places whose errors are largest for sure.

    Args:
        place: of every row [m].
        errors: their lengths, all finite.

    Returns:
        None where there are too few rows, or all are in one cell.
    """
    low, high = (place.min(0), place.max(0)) if len(place) else (np.zeros(3), np.zeros(3))
    width = np.where(high > low, (high - low) / CELLS, 1.0)
    cell = np.clip(((place - low) / width).astype(int), 0, CELLS - 1)
    number = (cell * [CELLS * CELLS, CELLS, 1]).sum(1)
    best: tuple[float, int] | None = None
    counted = [(k, errors[number == k]) for k in np.unique(number)]
    counted = [(k, own) for k, own in counted if len(own) >= max(LEAST_ROWS, len(errors) // 100)]
    if len(counted) < 2:
        return None
    for k, own in counted:
        surely = root_mean_square(own) * (1 - 1 / math.sqrt(len(own)))
        best = max(best, (surely, int(k))) if best else (surely, int(k))
    assert best is not None
    inside = number == best[1]
    _, chance = groups_differ(inside.astype(int), errors)
    corner = low + width * cell[inside][0]
    rms = root_mean_square(errors[inside])
    return Region(
        tuple(corner.tolist()),
        tuple((corner + width).tolist()),
        int(inside.sum()),
        rms,
        rms / root_mean_square(errors),
        chance < SIGNIFICANT / len(counted),
    )
