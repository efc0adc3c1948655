"""Where a calibration is worst, in words."""

import numpy as np

from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.page.dependence import error_lengths
from pisigma.reporting.page.judged_rows import JudgedRows
from pisigma.reporting.page.regions import Region, worst_region
from pisigma.reporting.tables import figure_text


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
