"""Dependence of errors on joint values, order of measurement, payload, temperature, frame and target."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64, Int64

from pisigma.measurement.conditions import CONDITIONS, conditions_of
from pisigma.measurement.groups import groups_of_equal_joints, numbers_of_names
from pisigma.robot.description import Robot
from pisigma.validation.held_out.judged_rows import JudgedRows
from pisigma.validation.held_out.rank_tests import SIGNIFICANT, kruskal_wallis, rank_correlation

NOTABLE_RATIO = 1.25
"""Ratio of the largest to the smallest RMS error of bins below which a dependence is small."""
_ORDERED = 0.3
"""Rank correlation of a joint with the order of the rows above which time and position are hard to distinguish."""
_MAX_BINS = 12
"""Largest number of bins of a joint's measured values."""
MIN_ROWS = 8
"""Smallest number of rows of a region or a bin."""
_MIN_ROWS_OF_RMS = 3
"""Smallest number of rows from which the RMS error of a bin is computed."""
_DEGREES = math.degrees(1.0)
_UNITS = {"kg": "kg", "c": "°C"}

Untested = Literal["joint not moved", "too few rows"]
"""Reason why a dependence on a joint or a condition was not tested."""


@dataclass(frozen=True)
class BinTest:
    """Result of the Kruskal-Wallis test of differences of errors between bins of values of a joint or a condition.

    Attributes:
        p_value: probability of such differences by chance.
        smallest_bin_rms: smallest RMS error of a bin.
        largest_bin_rms: largest RMS error of a bin, in the unit of the errors.
        worst_bin_edges: values that bound the bin with the largest RMS error, in their unit.
    """

    p_value: float
    smallest_bin_rms: float
    largest_bin_rms: float
    worst_bin_edges: tuple[float, float]

    @property
    def significant(self) -> bool:
        """Whether the differences are statistically significant."""
        return self.p_value < SIGNIFICANT

    @property
    def is_notable(self) -> bool:
        """Whether the RMS errors of bins differ by `NOTABLE_RATIO` or more."""
        return self.largest_bin_rms >= NOTABLE_RATIO * self.smallest_bin_rms


@dataclass(frozen=True)
class OrderTest:
    """Rank correlation (Spearman) of the error with the order of the rows.

    Attributes:
        component: "x", "y" or "z" of the signed error with the largest correlation; "length" if signs are unknown.
        correlation: rank correlation with the order.
        p_value: two-sided probability of such a correlation by chance.
        change: mean error of the last tenth of the rows minus that of the first, in the unit of the errors; 0 if the
            correlation is not significant.
        ordered_joint: number, from 1, of a joint whose values follow the order of the rows, so that order and position
            cannot be distinguished; None if there is no such joint.
        joint_correlation: absolute rank correlation of that joint with the order.
        are_training_residuals: whether signed errors are residuals of rows with which the model was calibrated.
    """

    component: Literal["x", "y", "z", "length"]
    correlation: float
    p_value: float
    change: float
    ordered_joint: int | None = None
    joint_correlation: float = 0.0
    are_training_residuals: bool = False

    @property
    def significant(self) -> bool:
        """Whether the correlation is statistically significant."""
        return self.p_value < SIGNIFICANT


@dataclass(frozen=True, eq=False)
class Dependence:
    """Errors as a function of a quantity, with a test of dependence.

    Attributes:
        key: key of the quantity, for file names.
        title: name of the quantity.
        unit: unit of the quantity; "" for none.
        values: values of the quantity, one per row.
        errors: lengths "before" and "after" per row, or signed components "x", "y" and "z".
        error_unit: "mm" or "deg".
        test: result of the test of dependence on the quantity.
    """

    key: str
    title: str
    unit: str
    values: Float64[np.ndarray, " rows"]
    errors: dict[str, Float64[np.ndarray, " rows"]]
    error_unit: str
    test: BinTest | OrderTest | Untested


@dataclass(frozen=True)
class FrameOrTargetErrors:
    """Errors of the rows of one frame or target.

    Attributes:
        name: frame or target.
        rows: number of rows.
        nominal_rms: RMS error of the nominal robot [mm or deg].
        model_rms: RMS error of the model [mm or deg].
        bias_mm: mean signed error in the row's frame [mm]; None if no signed error is known.
    """

    name: str
    rows: int
    nominal_rms: float
    model_rms: float
    bias_mm: tuple[float, float, float] | None


@dataclass(frozen=True)
class ErrorsByFrameOrTarget:
    """Errors per frame or per target.

    Attributes:
        name_errors: errors of every frame or target; empty if there is only one.
        unit: "mm" or "deg", of the RMS errors.
        p_value: probability of such differences by chance (Kruskal and Wallis).
    """

    name_errors: tuple[FrameOrTargetErrors, ...] = ()
    unit: str = "mm"
    p_value: float = 1.0

    @property
    def significant(self) -> bool:
        """Whether the differences are statistically significant."""
        return self.p_value < SIGNIFICANT

    @property
    def largest(self) -> FrameOrTargetErrors | None:
        """Frame or target with the largest RMS error under the model; None if there are no rows."""
        return max((one for one in self.name_errors if one.rows), key=lambda one: one.model_rms, default=None)

    def to_json(self) -> list[dict[str, object]]:
        """Return the errors of every frame or target as plain values."""
        return [
            {
                "name": one.name,
                "rows": one.rows,
                "before": one.nominal_rms,
                "after": one.model_rms,
                "bias": one.bias_mm,
            }
            for one in self.name_errors
        ]


@dataclass(frozen=True, eq=False)
class BinnedErrors:
    """Errors in bins of a quantity's values.

    Attributes:
        edges: edges of the bins, one more than there are bins.
        rms: RMS error of every bin; NaN where there are too few rows.
        bin_index: bin of every row.
    """

    edges: Float64[np.ndarray, " edges"]
    rms: Float64[np.ndarray, " bins"]
    bin_index: Int64[np.ndarray, " rows"]


def error_lengths(rows: JudgedRows) -> tuple[Float64[np.ndarray, " rows"], Float64[np.ndarray, " rows"], str]:
    """Return errors before and after, and their unit: positions in mm, or else orientations in deg."""
    if bool(np.isfinite(rows.model_errors.position.numpy()).any()) or rows.model_errors.rotation is None:
        return rows.nominal_errors.position.numpy() * 1e3, rows.model_errors.position.numpy() * 1e3, "mm"
    before = rows.nominal_errors.rotation
    after = rows.model_errors.rotation.numpy() * _DEGREES
    return (np.full_like(after, np.nan) if before is None else before.numpy() * _DEGREES), after, "deg"


def dependences(rows: JudgedRows, robot: Robot) -> tuple[Dependence, ...]:
    """Test the dependence of errors on joint values, order of the rows, and varying payload and temperature.

    Args:
        rows: rows with their errors.
        robot: robot that was measured.
    """
    before, after, unit = error_lengths(rows)
    judged = np.isfinite(after)
    errors = {"before": before[judged], "after": after[judged]}
    q = robot.in_file_units(rows.measurements.q)[judged]
    groups = groups_of_equal_joints(rows.measurements.q).numpy()[judged]
    result = []
    for number, (axis, values) in enumerate(zip(robot.axes, q.T, strict=True), 1):
        test = _over_bins(values, errors["after"], groups)
        result.append(Dependence(f"joint_{number}", axis.name, axis.file_unit, values, errors, unit, test))
    result.append(_over_order(rows, errors, judged, unit))
    conditions = conditions_of(rows.measurements, CONDITIONS)
    for name, column in zip(CONDITIONS, conditions.t(), strict=True):
        title, suffix = name.rsplit("_", 1)
        values = column.numpy()[judged]
        stated = np.isfinite(values)
        if stated.sum() > 2 and np.ptp(values[stated]) > 0:
            those = {when: lengths[stated] for when, lengths in errors.items()}
            equal = groups_of_equal_joints(torch.cat([rows.measurements.q, column[:, None]], 1)).numpy()
            test = _over_bins(values[stated], those["after"], equal[judged][stated])
            result.append(Dependence(title, title, _UNITS[suffix], values[stated], those, unit, test))
    return tuple(result)


def group_errors_by_name(rows: JudgedRows, names: Sequence[str]) -> ErrorsByFrameOrTarget:
    """Compute errors per name, and test whether they differ; empty if there is only one name.

    Args:
        rows: rows with their errors.
        names: frame or target of every row.
    """
    before, after, unit = error_lengths(rows)
    judged = np.isfinite(after)
    number, different = numbers_of_names(names).numpy(), dict.fromkeys(names)
    if len(different) < 2:
        return ErrorsByFrameOrTarget()
    residual = rows.residual.numpy() * 1e3
    result = []
    for k, name in enumerate(different):
        inside = judged & (number == k)
        signed = residual[inside]
        bias = tuple(np.nanmean(signed, 0).tolist()) if np.isfinite(signed).all(1).any() else None
        rms = [root_mean_square(lengths[inside]) for lengths in (before, after)]
        result.append(FrameOrTargetErrors(name, int(inside.sum()), rms[0], rms[1], bias))
    _, chance = kruskal_wallis(number[judged], after[judged])
    return ErrorsByFrameOrTarget(tuple(result), unit, chance)


def _over_bins(values: np.ndarray, errors: np.ndarray, groups: np.ndarray) -> BinTest | Untested:
    """Test the dependence of errors on values of a joint or a condition; rows of a group count once.

    A test of bins also finds errors that are smallest at the mean value, as those of an effect that is not corrected.
    """
    if len(errors) < 3 or np.ptp(values) == 0:
        return "joint not moved"
    bins = bin_errors(values, errors)
    if np.isnan(bins.rms).all():
        return "too few rows"
    # repeated rows are not independent, so every joint configuration is tested with its mean error
    _, first, group = np.unique(groups, return_index=True, return_inverse=True)
    _, chance = kruskal_wallis(bins.bin_index[first], np.bincount(group, errors) / np.bincount(group))
    worst = int(np.nanargmax(bins.rms))
    edges = (float(bins.edges[worst]), float(bins.edges[worst + 1]))
    return BinTest(chance, float(np.nanmin(bins.rms)), float(bins.rms[worst]), edges)


def _over_order(rows: JudgedRows, errors: dict[str, np.ndarray], judged: np.ndarray, unit: str) -> Dependence:
    """Test the dependence of signed errors, or else of error lengths, on the order of the rows."""
    number = np.arange(1.0, len(judged) + 1)[judged]
    residual = rows.residual.numpy()[judged] * 1e3
    signed = unit == "mm" and bool(np.isfinite(residual).all()) and len(residual) > 0
    components: dict[Literal["x", "y", "z", "length"], np.ndarray] = {"length": errors["after"]}
    if signed:
        components = {"x": residual[:, 0], "y": residual[:, 1], "z": residual[:, 2]}
    tests = {name: rank_correlation(number, values) for name, values in components.items()}
    name = max(tests, key=lambda name: abs(tests[name][0]))
    (r, chance), values = tests[name], components[name]
    significant, tenth = chance < SIGNIFICANT, max(len(number) // 10, 1)
    change = float(values[-tenth:].mean() - values[:tenth].mean()) if significant else 0.0
    joint, joint_r = _ordered_joint(rows) if significant else (None, 0.0)
    test = OrderTest(name, r, chance, change, joint, joint_r, signed and rows.residual_row_role == "training")
    shown: dict[str, np.ndarray] = (
        {str(one): those for one, those in components.items()} if signed else errors
    )
    return Dependence("order", "order of the rows", "", number, shown, unit, test)


def _ordered_joint(rows: JudgedRows) -> tuple[int | None, float]:
    """Return the joint whose values follow the order of the rows most closely; None if there is no such joint."""
    q = rows.measurements.q.numpy()
    r = [abs(rank_correlation(np.arange(float(len(q))), values)[0]) for values in q.T]
    return (None, 0.0) if max(r) < _ORDERED else (int(np.argmax(r)) + 1, max(r))


def root_mean_square(values: Float64[np.ndarray, " values"]) -> float:
    """Compute the root mean square; NaN without values."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def bin_errors(
    values: Float64[np.ndarray, " rows"], errors: Float64[np.ndarray, " rows"], bins: int = _MAX_BINS
) -> BinnedErrors:
    """Compute RMS errors in bins of equal width; fewer rows give fewer bins."""
    bins = int(np.clip(len(values) // MIN_ROWS, 1, bins))
    low, high = float(values.min()), float(values.max())
    edges = np.linspace(low, high if high > low else low + 1.0, bins + 1)
    number = np.clip(np.searchsorted(edges, values, "right") - 1, 0, bins - 1)
    inside = [errors[number == k] for k in range(bins)]
    rms = [root_mean_square(those) if len(those) >= _MIN_ROWS_OF_RMS else math.nan for those in inside]
    return BinnedErrors(edges, np.array(rms), number)
