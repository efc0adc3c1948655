"""What errors depend on: joint values, order of measurement, payload, temperature, frame and target."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from pisigma.judging.rank_tests import SIGNIFICANT, groups_differ, rank_correlation
from pisigma.measurement.conditions import CONDITIONS, conditions_of
from pisigma.measurement.groups import groups_of_equal_joints
from pisigma.reporting.page.judged_rows import JudgedRows
from pisigma.reporting.tables import figure_text
from pisigma.robot.description import Robot

NOTABLE = 1.25
"""Parts whose RMS errors differ by a smaller factor are called alike."""
ORDERED = 0.3
"""From such a rank correlation of a joint with the order of the rows on, time and place cannot be told apart."""
BINS = 12
"""Parts of a joint's measured values."""
LEAST_ROWS = 8
"""Fewer rows say too little of a region or part."""
_DEGREES = math.degrees(1.0)


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
        sentence: what is seen.
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


def error_lengths(
    rows: JudgedRows,
) -> tuple[Float64[np.ndarray, " rows"], Float64[np.ndarray, " rows"], str]:
    """Errors before and after, and their unit: of positions in mm, where there are none of orientations in deg."""
    if bool(np.isfinite(rows.after.position.numpy()).any()) or rows.after.rotation is None:
        return rows.before.position.numpy() * 1e3, rows.after.position.numpy() * 1e3, "mm"
    before = rows.before.rotation
    after = rows.after.rotation.numpy() * _DEGREES
    return (np.full_like(after, np.nan) if before is None else before.numpy() * _DEGREES), after, "deg"


def dependences(rows: JudgedRows, robot: Robot) -> tuple[Dependence, ...]:
    """Errors over every joint's value, the order of the rows, and payload and temperature where they vary.

    Args:
        rows: judged.
        robot: names the joints and says which of them turn.
    """
    before, after, unit = error_lengths(rows)
    known = np.isfinite(after)
    errors = {"before": before[known], "after": after[known]}
    q = rows.measurements.q.numpy()[known]
    found = []
    for j, joint in enumerate(robot.joints):
        turns = robot.revolute[j]
        values = q[:, j] * (_DEGREES if turns else 1e3)
        own = "deg" if turns else "mm"
        groups = groups_of_equal_joints(rows.measurements.q).numpy()[known]
        sentence = _over_values(joint.name, own, values, errors["after"], unit, groups)
        found.append(Dependence(f"joint_{j + 1}", joint.name, own, values, errors, unit, sentence))
    found.append(_over_time(rows, errors, known, unit))
    conditions = conditions_of(rows.measurements, CONDITIONS).numpy()[known]
    for name, values in zip(CONDITIONS, conditions.T, strict=True):
        title, own = name.rsplit("_", 1)
        own = {"kg": "kg", "c": "°C"}[own]
        stated = np.isfinite(values)
        if stated.sum() > 2 and np.ptp(values[stated]) > 0:
            those = {when: lengths[stated] for when, lengths in errors.items()}
            sentence = _over_condition(title, own, values[stated], those["after"], unit)
            found.append(Dependence(title, title, own, values[stated], those, unit, sentence))
    return tuple(found)


def by_name(rows: JudgedRows, names: Sequence[str]) -> tuple[tuple[NameErrors, ...], str]:
    """Errors per name, and what is seen; nothing where there is one name only.

    Args:
        rows: judged.
        names: per row, its frame or target.
    """
    before, after, unit = error_lengths(rows)
    known = np.isfinite(after)
    order = {name: number for number, name in enumerate(dict.fromkeys(names))}
    number = np.array([order[name] for name in names])
    if len(order) < 2:
        return (), ""
    residual = rows.residual.numpy() * 1e3
    found = []
    for name, k in order.items():
        own = known & (number == k)
        signed = residual[own]
        bias = tuple(np.nanmean(signed, 0).tolist()) if np.isfinite(signed).all(1).any() else None
        b, a = (root_mean_square(lengths[own]) for lengths in (before, after))
        found.append(NameErrors(name, int(own.sum()), b, a, bias))
    _, chance = groups_differ(number[known], after[known])
    largest = max((one for one in found if one.rows), key=lambda one: one.after)
    if chance >= SIGNIFICANT:
        return tuple(found), f"They do not differ more than by chance ({chance_text(chance)})."
    return tuple(found), (
        f"They differ more than by chance ({chance_text(chance)}); '{largest.name}' has the largest errors "
        f"({figure_text(largest.after)} {unit} RMS)."
    )


def _over_values(
    name: str, own: str, values: np.ndarray, errors: np.ndarray, unit: str, groups: np.ndarray
) -> str:
    """What errors do over a joint's values; rows of equal joint values count once."""
    if len(errors) < 3 or np.ptp(values) == 0:
        return f"{name} hardly moved, so nothing can be said of it."
    parts = binned(values, errors)
    _, first = np.unique(groups, return_index=True)
    _, dense = np.unique(groups, return_inverse=True)
    mean = np.bincount(dense, errors) / np.bincount(dense)
    _, chance = groups_differ(parts.number[first], mean)
    if np.isnan(parts.rms).all():
        return f"Too few rows to say what errors do over {name}."
    worst, best = int(np.nanargmax(parts.rms)), int(np.nanargmin(parts.rms))
    high, low = parts.rms[worst], parts.rms[best]
    between = f"RMS from {figure_text(low)} to {figure_text(high)} {unit}"
    if chance >= SIGNIFICANT:
        return f"No dependence on {name} beyond chance ({chance_text(chance)}): {between} over its values."
    if high < NOTABLE * low:
        return f"Depends on {name} a little, yet more than by chance ({chance_text(chance)}): {between}."
    return (
        f"Largest at {name} from {parts.edges[worst]:.0f} to {parts.edges[worst + 1]:.0f} {own}, "
        f"{figure_text(high)} {unit} RMS, {high / low:.1f} times the smallest part: more than by chance "
        f"({chance_text(chance)})."
    )


def _over_time(rows: JudgedRows, errors: dict[str, np.ndarray], known: np.ndarray, unit: str) -> Dependence:
    """Signed errors over the order of the rows, lengths where signs are not known."""
    number = np.arange(1.0, len(known) + 1)[known]
    residual = rows.residual.numpy()[known] * 1e3
    signed = unit == "mm" and bool(np.isfinite(residual).all()) and len(residual) > 0
    parts = dict(zip("xyz", residual.T, strict=True)) if signed else {"length": errors["after"]}
    tenth = max(len(number) // 10, 1)
    found = {name: (*rank_correlation(number, values), values) for name, values in parts.items()}
    name, (r, chance, values) = max(found.items(), key=lambda item: abs(item[1][0]))
    what = "length of the error" if name == "length" else f"component {name} of the error"
    if chance >= SIGNIFICANT:
        sentence = (
            f"No drift beyond chance: the largest rank correlation with the order of the rows is {r:.2f}, of the "
            f"{what} ({chance_text(chance)})."
        )
    else:
        moved = float(values[-tenth:].mean() - values[:tenth].mean())
        sentence = (
            f"{what[0].upper()}{what[1:]} changes with the order of the rows (rank correlation {r:.2f}, "
            f"{chance_text(chance)}): by {moved:+.3f} {unit} on average from the first tenth of them to the last."
        )
        sentence += _order_remark(rows)
    if signed and rows.residual_origin == "training":
        sentence += " Signed errors are residuals of the rows that the model was made of."
    return Dependence("order", "order of the rows", "", number, parts if signed else errors, unit, sentence)


def _order_remark(rows: JudgedRows) -> str:
    """A warning where the rows were measured joint value after joint value."""
    q = rows.measurements.q.numpy()
    r = [abs(rank_correlation(np.arange(len(q)), values)[0]) for values in q.T]
    if max(r) < ORDERED:
        return ""
    return (
        f" The rows were measured in an order (rank correlation of joint {int(np.argmax(r)) + 1} with it "
        f"{max(r):.2f}), so this may come of the poses instead of the time."
    )


def _over_condition(title: str, own: str, values: np.ndarray, errors: np.ndarray, unit: str) -> str:
    r, chance = rank_correlation(values, errors)
    span = f"{values.min():.4g} to {values.max():.4g} {own}"
    if chance >= SIGNIFICANT:
        return f"No dependence on {title} beyond chance ({span}; rank correlation {r:.2f}, {chance_text(chance)})."
    grows = "grows" if r > 0 else "falls"
    return f"The error {grows} with {title} ({span}; rank correlation {r:.2f}, {chance_text(chance)})."


def chance_text(probability: float) -> str:
    """A probability in words, such as "p = 0.02"."""
    return "p < 1e-12" if probability < 1e-12 else f"p = {probability:.2g}"


def root_mean_square(values: Float64[np.ndarray, " values"]) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


@dataclass(frozen=True, eq=False)
class Binned:
    """Errors in parts of a quantity's values.

    Attributes:
        edges: of the parts, one more than there are parts.
        rms: of every part; NaN where there are too few rows.
        number: of every row, in which part it is.
    """

    edges: Float64[np.ndarray, " edges"]
    rms: Float64[np.ndarray, " bins"]
    number: Int64[np.ndarray, " rows"]


def binned(
    values: Float64[np.ndarray, " rows"], errors: Float64[np.ndarray, " rows"], bins: int = BINS
) -> Binned:
    """Errors in parts of equal width; of few rows in fewer parts."""
    bins = int(np.clip(len(values) // LEAST_ROWS, 1, bins))
    low, high = float(values.min()), float(values.max())
    edges = np.linspace(low, high if high > low else low + 1.0, bins + 1)
    number = np.clip(np.searchsorted(edges, values, "right") - 1, 0, bins - 1)
    parts = [errors[number == k] for k in range(bins)]
    rms = [root_mean_square(part) if len(part) >= 3 else math.nan for part in parts]
    return Binned(edges, np.array(rms), number)
