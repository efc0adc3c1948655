"""What errors depend on: joint values, order of measurement, payload, temperature, frame and target."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from pisigma.measurement.conditions import CONDITIONS, conditions_of
from pisigma.measurement.groups import groups_of_equal_joints, numbers_of_names
from pisigma.reporting.rendering import sentences
from pisigma.robot.description import Robot
from pisigma.validation.held_out.judged_rows import JudgedRows
from pisigma.validation.held_out.rank_tests import SIGNIFICANT, groups_differ, rank_correlation

_say = functools.partial(sentences, "report.txt.j2")

NOTABLE = 1.25
"""Bins whose RMS errors differ by a smaller factor are called alike."""
ORDERED = 0.3
"""Rank correlation of a joint with the order of the rows from which on time and position are hard to separate."""
BINS = 12
"""Bins of a joint's measured values."""
LEAST_ROWS = 8
"""Fewer rows say too little of a region or bin."""
_DEGREES = math.degrees(1.0)
_UNITS = {"kg": "kg", "c": "°C"}


@dataclass(frozen=True, eq=False)
class Dependence:
    """Errors over one quantity.

    Attributes:
        key: for the file name of its figure.
        title: the quantity.
        unit: of the quantity; "" for none.
        values: of the quantity, per row.
        errors: "before" and "after": lengths per row, or "x", "y" and "z": signed.
        error_unit: "mm" or "deg".
        sentence: what the errors do.
    """

    key: str
    title: str
    unit: str
    values: Float64[np.ndarray, " rows"]
    errors: dict[str, Float64[np.ndarray, " rows"]]
    error_unit: str
    sentence: str


@dataclass(frozen=True)
class NameErrors:
    """Errors of the rows of one frame or target.

    Attributes:
        name: of the frame or target.
        rows: how many.
        before: RMS error of the robot as drawn [mm or deg].
        after: of the model.
        bias: mean of the signed errors [mm], or None.
    """

    name: str
    rows: int
    before: float
    after: float
    bias: tuple[float, float, float] | None


@dataclass(frozen=True, eq=False)
class Binned:
    """Errors in bins of a quantity's values.

    Attributes:
        edges: of the bins, one more than there are bins.
        rms: of every bin; NaN where there are too few rows.
        number: of every row, in which bin it is.
    """

    edges: Float64[np.ndarray, " edges"]
    rms: Float64[np.ndarray, " bins"]
    number: Int64[np.ndarray, " rows"]


def error_lengths(rows: JudgedRows) -> tuple[Float64[np.ndarray, " rows"], Float64[np.ndarray, " rows"], str]:
    """Give errors before and after, and their unit: of positions in mm, where there are none of orientations in deg."""
    if bool(np.isfinite(rows.after.position.numpy()).any()) or rows.after.rotation is None:
        return rows.before.position.numpy() * 1e3, rows.after.position.numpy() * 1e3, "mm"
    before = rows.before.rotation
    after = rows.after.rotation.numpy() * _DEGREES
    return (np.full_like(after, np.nan) if before is None else before.numpy() * _DEGREES), after, "deg"


def dependences(rows: JudgedRows, robot: Robot) -> tuple[Dependence, ...]:
    """Relate errors to every joint's value, the order of the rows, and payload and temperature where they vary.

    Args:
        rows: judged.
        robot: names the joints and says which of them turn.
    """
    before, after, unit = error_lengths(rows)
    judged = np.isfinite(after)
    errors = {"before": before[judged], "after": after[judged]}
    q = rows.measurements.q.numpy()[judged]
    groups = groups_of_equal_joints(rows.measurements.q).numpy()[judged]
    result = []
    for j, joint in enumerate(robot.joints):
        factor, joint_unit = (_DEGREES, "deg") if robot.revolute[j] else (1e3, "mm")
        values = q[:, j] * factor
        sentence = _over_values(joint.name, joint_unit, values, errors["after"], unit, groups)
        result.append(Dependence(f"joint_{j + 1}", joint.name, joint_unit, values, errors, unit, sentence))
    result.append(_over_time(rows, errors, judged, unit))
    conditions = conditions_of(rows.measurements, CONDITIONS).numpy()[judged]
    for name, values in zip(CONDITIONS, conditions.T, strict=True):
        title, suffix = name.rsplit("_", 1)
        stated = np.isfinite(values)
        if stated.sum() > 2 and np.ptp(values[stated]) > 0:
            those = {when: lengths[stated] for when, lengths in errors.items()}
            sentence = _over_condition(title, _UNITS[suffix], values[stated], those["after"])
            result.append(Dependence(title, title, _UNITS[suffix], values[stated], those, unit, sentence))
    return tuple(result)


def by_name(rows: JudgedRows, names: Sequence[str]) -> tuple[tuple[NameErrors, ...], str]:
    """Give errors per name, and what they do, in a sentence; nothing where there is one name only.

    Args:
        rows: judged.
        names: per row, its frame or target.
    """
    before, after, unit = error_lengths(rows)
    judged = np.isfinite(after)
    number, different = numbers_of_names(names).numpy(), dict.fromkeys(names)
    if len(different) < 2:
        return (), ""
    residual = rows.residual.numpy() * 1e3
    result = []
    for k, name in enumerate(different):
        inside = judged & (number == k)
        signed = residual[inside]
        bias = tuple(np.nanmean(signed, 0).tolist()) if np.isfinite(signed).all(1).any() else None
        rms = [root_mean_square(lengths[inside]) for lengths in (before, after)]
        result.append(NameErrors(name, int(inside.sum()), rms[0], rms[1], bias))
    _, chance = groups_differ(number[judged], after[judged])
    largest = max((one for one in result if one.rows), key=lambda one: one.after, default=None)
    return tuple(result), _say("by_name", largest, unit, chance_text(chance), chance < SIGNIFICANT)[0]


def _over_values(
    name: str, joint_unit: str, values: np.ndarray, errors: np.ndarray, unit: str, groups: np.ndarray
) -> str:
    """Say what errors do over a joint's values; rows of equal joint values count once."""
    if len(errors) < 3 or np.ptp(values) == 0:
        return f"{name} hardly moved, so nothing can be said of it."
    bins = binned(values, errors)
    if np.isnan(bins.rms).all():
        return f"Too few rows to say what errors do over {name}."
    _, first, group = np.unique(groups, return_index=True, return_inverse=True)
    _, chance = groups_differ(bins.number[first], np.bincount(group, errors) / np.bincount(group))
    worst = int(np.nanargmax(bins.rms))
    high, low = bins.rms[worst], np.nanmin(bins.rms)
    sure, notable = chance < SIGNIFICANT, high >= NOTABLE * low
    edges = (bins.edges[worst], bins.edges[worst + 1])
    return _say("over_joint", name, joint_unit, unit, chance_text(chance), sure, notable, low, high, edges)[0]


def _over_time(rows: JudgedRows, errors: dict[str, np.ndarray], judged: np.ndarray, unit: str) -> Dependence:
    """Relate signed errors to the order of the rows, lengths where signs are not known."""
    number = np.arange(1.0, len(judged) + 1)[judged]
    residual = rows.residual.numpy()[judged] * 1e3
    signed = unit == "mm" and bool(np.isfinite(residual).all()) and len(residual) > 0
    components = dict(zip("xyz", residual.T, strict=True)) if signed else {"length": errors["after"]}
    tests = {name: rank_correlation(number, values) for name, values in components.items()}
    name = max(tests, key=lambda name: abs(tests[name][0]))
    (r, chance), values = tests[name], components[name]
    what = f"component {name} of the error" if signed else "length of the error"
    sure, tenth = chance < SIGNIFICANT, max(len(number) // 10, 1)
    moved = float(values[-tenth:].mean() - values[:tenth].mean()) if sure else 0.0
    sentence = " ".join(
        (
            *_say("over_time", what, r, chance_text(chance), sure, moved, unit),
            *(_order_remark(rows) if sure else ()),
        )
    )
    if signed and rows.residual_origin == "training":
        sentence += " Signed errors are residuals of the rows that the model was made of."
    shown = components if signed else errors
    return Dependence("order", "order of the rows", "", number, shown, unit, sentence)


def _order_remark(rows: JudgedRows) -> tuple[str, ...]:
    """Warn where the rows were measured joint value after joint value."""
    q = rows.measurements.q.numpy()
    r = [abs(rank_correlation(np.arange(float(len(q))), values)[0]) for values in q.T]
    return () if max(r) < ORDERED else _say("ordered", int(np.argmax(r)) + 1, max(r))


def _over_condition(title: str, unit: str, values: np.ndarray, errors: np.ndarray) -> str:
    r, chance = rank_correlation(values, errors)
    low, high, sure = values.min(), values.max(), chance < SIGNIFICANT
    return _say("over_condition", title, unit, low, high, r, chance_text(chance), sure)[0]


def root_mean_square(values: Float64[np.ndarray, " values"]) -> float:
    """Compute the root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def binned(
    values: Float64[np.ndarray, " rows"], errors: Float64[np.ndarray, " rows"], bins: int = BINS
) -> Binned:
    """Compute errors in bins of equal width; of few rows in fewer bins."""
    bins = int(np.clip(len(values) // LEAST_ROWS, 1, bins))
    low, high = float(values.min()), float(values.max())
    edges = np.linspace(low, high if high > low else low + 1.0, bins + 1)
    number = np.clip(np.searchsorted(edges, values, "right") - 1, 0, bins - 1)
    inside = [errors[number == k] for k in range(bins)]
    return Binned(edges, np.array([root_mean_square(e) if len(e) >= 3 else math.nan for e in inside]), number)


def chance_text(probability: float) -> str:
    """Write a probability, such as "p = 0.02"."""
    return "p < 1e-12" if probability < 1e-12 else f"p = {probability:.2g}"
