"""Check whether only some of the rows agree with a model while the others belong to another setup."""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.registry import SENSORS
from pisigma.robot.frame_fits import best_base, best_tool
from pisigma.validation.checks.check import CheckedCalibration, RowsUnderModel
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.cause import join_words, length_text
from pisigma.validation.setup_faults.ordered_rows import SENSORS as POSE_SENSORS
from pisigma.validation.setup_faults.ordered_rows import OrderedRows
from pisigma.validation.setup_faults.populations import MIN_ROWS as MIN_ROWS_OF_TWO
from pisigma.validation.setup_faults.populations import (
    MIN_SHARE,
    Populations,
    find_populations,
    two_populations,
)
from pisigma.validation.setup_faults.setup_fault import combine_alternatives
from pisigma.validation.setup_faults.setup_faults import find_setup_faults

MIN_WRONG_SHARE = 0.25
"""Share of wrong rows above which it is unknown which rows are wrong."""
_MIN_AGREEING_SHARE = 0.35
"""Smallest share of the rows that must agree with the model."""
AGREES = 3.5
"""Ratio of an error to the expected error (of model and sensor) up to which a row agrees with a model."""
_APART = 2.0
"""Multiple of the limit `AGREES` above which a row belongs to another setup."""
_FAR_APART = 6.0
"""Smallest ratio of the median errors of two groups at which they are separate."""
_BETWEEN = 0.15
"""Largest share of the rows that may be neither near nor far."""
DRAWS, _SAMPLE, _REFITS = 100, 4, 2
"""Number and size of the random samples of rows to which a base or a tool is fitted, in addition to halves of the file
and every second row; and number of further fits to the rows that agree."""
_MAX_POSES = 2**13
"""Number of poses that are compared together."""
_SPARE_ROWS = 3
"""Number of rows that must agree with a fit in addition to the rows of its sample."""
_ADVICE = " No result is computed from all of them; measure again, or give each group its own file or frame."
_EXPLAINED = 2.5
"""Ratio of an error to the expected error up to which moved joint zeros explain all rows."""


def check_mixed_rows(judged: RowsUnderModel) -> Iterator[Diagnostic]:
    """Find the largest set of rows that agree with the model, with its own or a fitted base or tool.

    Bases and tools are fitted to random samples of rows (RANSAC: Fischler and Bolles 1981, Communications of the ACM
    24(6)). If more than a quarter of the rows are far off while the others agree within the noise, rows of two setups
    are mixed, or it is unknown which rows are wrong. Moved joint zeros cause errors of all sizes, so they are fitted to
    all rows first.
    """
    limit = AGREES * judged.predicted_sigma
    if not bool(torch.isfinite(limit).all()) or bool((judged.errors <= limit).all()):
        return  # unknown limits, or all rows agree with one setup
    found = [one for one in (_apart(judged, T) for T in _agreements(judged)) if one is not None]
    if found and not _joints_explain(judged):
        yield mixed_rows_diagnostic(judged, min(found, key=lambda far: int(far.sum())))


def mixed_rows_diagnostic(judged: RowsUnderModel, wrong_rows: Bool[Tensor, " rows"]) -> Diagnostic:
    """Report rows that do not agree with the others, what distinguishes them, and what explains them."""
    found = too_many_wrong_rows_diagnostic(judged.rows, wrong_rows)
    sentence = f"{found.sentence.removesuffix(_ADVICE)}{_cause(judged, wrong_rows)}{_ADVICE}"
    return found.model_copy(update={"sentence": sentence})


def too_many_wrong_rows_diagnostic(rows: Measurements, wrong_rows: Bool[Tensor, " rows"]) -> Diagnostic:
    """Report that more rows are wrong than can be left out."""
    distinction = distinguishing_property(rows, wrong_rows)
    return Diagnostic(
        kind="mixed_rows",
        severity="implausible",
        sentence=f"{int(wrong_rows.sum())} of {rows.rows} rows do not agree with the others: "
        f"{distinction.clause}.{_ADVICE}",
        row_places=tuple(rows.place(row) for row in wrong_rows.nonzero()[:, 0].tolist()),
        values={"distinguished_by": distinction.kind},
        remedy=_ADVICE.strip(),
    )


def _cause(judged: RowsUnderModel, wrong: Bool[Tensor, " rows"]) -> str:
    """Return a sentence about the cause that explains the wrong rows; empty if no cause does."""
    faults = find_setup_faults(judged.model, None, judged.rows.select(wrong), judged.fitted_kinds)
    if not faults:
        return ""
    fault = combine_alternatives(faults)
    fall = join_words(length_text(error) for error in (fault.rms_before, fault.rms_after))
    return f" In these rows, {fault.clause} (errors without and with this correction: {fall})."


def _agreements(judged: RowsUnderModel) -> Iterator[Float64[Tensor, "rows 4 4"]]:
    """Yield the predicted poses, and those with a base or a tool that agrees with as many rows as possible."""
    if not judged.fitted_kinds:
        yield judged.poses_before_fit
    if len(set(judged.rows.frame)) > 1 or len(set(judged.rows.target)) > 1:
        return
    count, limit = judged.rows.rows, AGREES * judged.predicted_sigma
    for kind in ("base", "tool"):
        agreeing = _samples(count)
        for _ in range(1 + _REFITS):  # local optimisation: fit again to all rows that agree
            chosen = agreeing[agreeing.sum(1) >= _SAMPLE]
            # Most samples soon lead to the same agreeing rows.
            sets, number = torch.unique(chosen, dim=0, return_inverse=True)
            agreeing = torch.cat(
                [
                    judged.error_lengths(_fitted(judged, kind, some)) <= limit
                    for some in torch.split(sets, max(1, _MAX_POSES // count))
                ]
            )[number]
        most = agreeing.sum(1)
        if len(most) and int(most.max()) >= _SAMPLE + _SPARE_ROWS:
            yield _fitted(judged, kind, chosen[most.argmax()][None])[0]


def _samples(rows: int) -> Bool[Tensor, "samples rows"]:
    """Return masks of the halves of the file, of every second row, and of small random samples."""
    every, draw = torch.arange(rows), torch.Generator().manual_seed(0)
    drawn = [torch.randperm(rows, generator=draw)[:_SAMPLE] for _ in range(DRAWS)]
    first, even = every < rows // 2, every % 2 == 0
    halves = torch.stack([first, ~first, even, ~even])
    return torch.cat([halves, (every == torch.stack(drawn)[..., None]).any(1)])


def _fitted(
    judged: RowsUnderModel, kind: str, chosen: Bool[Tensor, "samples rows"]
) -> Float64[Tensor, "samples rows 4 4"]:
    """Return predicted poses, with the base or the tool fitted to the chosen rows."""
    T = judged.poses_before_fit.expand(*chosen.shape, 4, 4)
    if kind == "base":
        return best_base(T, judged.measured, chosen.double())[:, None] @ T
    return T @ best_tool(T, judged.measured, chosen.double())[:, None]


def _apart(judged: RowsUnderModel, T: Float64[Tensor, "rows 4 4"]) -> Bool[Tensor, " rows"] | None:
    """Return the mask of rows that are far from the agreeing rows; None if they are few or not clearly apart."""
    ratio = judged.error_lengths(T) / (AGREES * judged.predicted_sigma)
    near, far = ratio <= 1, ratio > _APART
    count = judged.rows.rows
    if not int(far.sum()) > MIN_WRONG_SHARE * count or not int(near.sum()) >= _MIN_AGREEING_SHARE * count:
        return None
    if int((~near & ~far).sum()) > _BETWEEN * count:
        return None
    return far if float(ratio[far].median()) > _FAR_APART * float(ratio[near].median()) else None


def _joints_explain(judged: RowsUnderModel) -> bool:
    """Return whether moved joint zeros explain all rows (linearised at the fitted poses)."""
    error = judged.measured.position - judged.predicted[:, :3, 3]
    J = judged.poses_with_moved_zeros()[1][..., :3, 3].flatten(1).t()
    solution = torch.linalg.lstsq(J, error.flatten(), driver="gelsd").solution
    left = (error.flatten() - J @ solution).view(-1, 3).norm(dim=-1)
    return float((left / judged.predicted_sigma).square().mean().sqrt()) <= _EXPLAINED


_CERTAIN = 30.0
"""Log Bayes factor above which rows certainly differ. For one arm, unmodelled gear errors and sag give factors of up to
90 with frames and up to 30 otherwise, but the differences are small."""
_LARGE = {"tool": 1.6, "frame": 2.2, "arm": 2.2}
"""Ratio of the errors with and without the difference above which there are two populations. For one arm (simulated
with gear errors and sag, and measured: UR5, UR10, FANUC R-2000iC) the ratio is at most 1.3, 1.9 and 1.9."""
_HARDLY_USED = 0.38
"""Share of the values absorbed by parameters above which the ratios of one arm grow, because the best of many ways to
split the rows overfits: the ratio is at most 1.7 in 24 sets of 60 positions (share 0.35), 2.9 with 40 positions (0.5),
and 3.1 with arms of 7 joints (0.63)."""
_IMPLAUSIBLE = 5.0
"""Ratio of the errors with and without a different tool or frame above which the calibration is wrong; with two arms,
it always is."""


def check_two_populations(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Look for rows of another arm, tool or frame; if there are none, look for errors of two sizes.

    If at most a tenth of the rows are wrong, they are outliers, to which the robust loss gives no weight; more wrong
    rows need not be outliers. A hybrid has smaller residuals, so smaller differences are visible, but it absorbs part
    of large differences, so both calibrations are tested. Populations of the geometric calibration do not count if
    the hybrid explains its errors better, because errors of gears look like two populations, too.
    """
    learned = checked.hybrid if checked.hybrid is not None and checked.hybrid.learned is not None else None
    for result in (checked.geometric, learned):
        ordered = None if result is None else OrderedRows.from_result(result)
        found = None if ordered is None else find_populations(ordered, checked.rows.rows)
        if found is None or not _differ(found):
            continue
        if result is learned or learned is None or found.error_increase_factor > _factor_of_hybrid(checked):
            yield _two_populations(checked.rows, found)
            return
    yield from _two_sizes(checked)


def _factor_of_hybrid(checked: CheckedCalibration) -> float:
    """Return the ratio of the errors without and with the joint correction, all sensors counting alike."""
    before, after = (checked.errors[name] for name in ("geometric", "hybrid"))
    shares = [
        float(after[sensor].square().nanmean() / before[sensor].square().nanmean())
        for sensor in POSE_SENSORS
        if sensor in before
    ]
    return 1 / math.sqrt(np.nanmean(shares))


def _two_sizes(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Report sensors whose residuals come from two normal populations."""
    for sensor, errors in checked.final_errors.items():
        sigma = checked.rows.sigma_position if SENSORS[sensor].unit == "m" else checked.rows.sigma_rotation
        measured = torch.isfinite(errors).all(1)
        residuals = errors[measured].numpy()
        if sigma is not None and bool(torch.isfinite(sigma[measured]).all()):
            residuals = residuals * (sigma[measured].median() / sigma[measured])[:, None].numpy()
        if len(residuals) < MIN_ROWS_OF_TWO or not (fit := two_populations(residuals)).are_distinct:
            continue
        unit = "mm" if SENSORS[sensor].unit == "m" else "mrad"
        size, scatter = fit.offset * 1e3, fit.scatter * 1e3
        yield Diagnostic(
            kind="two_populations",
            severity="warning",
            sentence=f"{100 * fit.population_share:.0f} % of the values of {sensor} are off by about {size:.2g} "
            f"{unit}, while the others scatter by {scatter:.2g} {unit} per axis: many rows are wrong, or were measured "
            "under different conditions; check whether a target or an instrument was moved or hit.",
            cause="sizes",
            values={"sensor": sensor, "share": fit.population_share},
        )


def _differ(found: Populations) -> bool:
    """Return whether the rows are two populations rather than one arm with unmodelled errors."""
    return (
        found.log_bayes_factor > _CERTAIN
        and found.error_increase_factor
        > _LARGE[found.differing_part] * max((1 - _HARDLY_USED) / (1 - found.absorbed_share), 1.0)
        and int(found.in_smaller_population.sum()) >= MIN_SHARE * found.evaluated_rows
    )


def _two_populations(rows: Measurements, found: Populations) -> Diagnostic:
    """Report the rows of the smaller population and how they differ from the others."""
    second = torch.from_numpy(found.in_smaller_population)
    distinction = distinguishing_property(rows, second)
    size, moved = int(second.sum()), f"{length_text(math.hypot(*found.difference[:3]))}"
    difference, advice = {
        "arm": ("belong to a different arm from the others", "Calibrate each robot with its own rows"),
        "tool": (
            f"belong to a different target from the others, {moved} away on the tool",
            "Name another target in these rows (column 'target'), or leave them out",
        ),
        "frame": (
            "are in a different frame from the others, because the instrument or the robot was moved",
            "Name another frame in these rows (column 'frame'), or leave them out",
        ),
    }[found.differing_part]
    implausible = found.differing_part == "arm" or found.error_increase_factor > _IMPLAUSIBLE
    return Diagnostic(
        kind="two_populations",
        severity="implausible" if implausible else "warning",
        sentence=f"Two populations are mixed: {size} of {found.evaluated_rows} rows {difference} "
        f"({distinction.clause}); the errors of all rows together are {found.error_increase_factor:.2g} times as large "
        f"as separately. {advice}.",
        row_places=tuple(rows.place(row) for row in second.nonzero()[:, 0].tolist()),
        cause=found.differing_part,
        values={
            "factor": found.error_increase_factor,
            "log_odds": found.log_bayes_factor,
            "distinguished_by": distinction.kind,
        },
        remedy=f"{advice}.",
    )


_MAX_PLACES = 8
"""Largest number of rows that are listed individually."""


class Distinction(NamedTuple):
    """A property that distinguishes some rows from the others.

    Attributes:
        kind: "name", "range" (of the file), "period" (every n-th row), "value", or "nothing" if the rows are scattered.
        clause: the property in words, such as "all rows after rows.csv, line 8".
    """

    kind: Literal["name", "range", "period", "value", "nothing"]
    clause: str


def distinguishing_property(rows: Measurements, selected: Bool[Tensor, " rows"]) -> Distinction:
    """Return a property that the given rows have and all others do not."""
    for distinction in (*_by_name(rows, selected), *_by_order(rows, selected), *_by_value(rows, selected)):
        return distinction
    numbers = selected.nonzero()[:, 0].tolist()
    listed = join_words(rows.place(number) for number in numbers[:_MAX_PLACES])
    more = f" and {len(numbers) - _MAX_PLACES} more" if len(numbers) > _MAX_PLACES else ""
    return Distinction("nothing", f"{listed}{more}, which are scattered among the others")


def _by_name(rows: Measurements, some: Bool[Tensor, " rows"]) -> Iterator[Distinction]:
    """Return a distinction by file, frame, target or date; None if these do not distinguish the rows."""
    named: tuple[tuple[str, Sequence[str] | None], ...] = (
        ("file", rows.origin),
        ("frame", rows.frame),
        ("target", rows.target),
        ("date", rows.date),
    )
    for what, names in named:
        if not names:
            continue
        here = {name for name, one in zip(names, some.tolist(), strict=True) if one}
        there = {name for name, one in zip(names, some.tolist(), strict=True) if not one}
        if here and there and not here & there:
            yield Distinction("name", f"all rows of {what} {join_words(sorted(here))}")


def _by_order(rows: Measurements, some: Bool[Tensor, " rows"]) -> Iterator[Distinction]:
    """Return a distinction by a range of the file or by every n-th row; None if there is none."""
    numbers = some.nonzero()[:, 0].tolist()
    first, last = numbers[0], numbers[-1]
    if last - first + 1 == len(numbers) and len(numbers) > 1:
        if last == rows.rows - 1:
            yield Distinction("range", f"{rows.place(first)} and all later rows")
        elif first == 0:
            yield Distinction("range", f"all rows up to {rows.place(last)}")
        else:
            yield Distinction("range", f"all rows from {rows.place(first)} to {rows.place(last)}")
    steps = {later - earlier for earlier, later in itertools.pairwise(numbers)}
    if len(steps) == 1 and len(numbers) > 2 and (step := steps.pop()) > 1 and first < step:
        ordinal = {2: "second", 3: "third"}.get(step, f"{step}th")
        if last + step >= rows.rows:
            yield Distinction("period", f"every {ordinal} row, starting at {rows.place(first)}")


def _by_value(rows: Measurements, some: Bool[Tensor, " rows"]) -> Iterator[Distinction]:
    """Return a distinction by temperature, payload or a joint value; None if no value separates the rows."""
    columns: list[tuple[str, Tensor]] = []
    if rows.temperature is not None:
        columns.append(("a temperature", rows.temperature))
    if rows.payload is not None:
        columns.append(("a payload", rows.payload))
    columns += [(f"joint {number}", one) for number, one in enumerate(rows.q.t(), 1)]
    for what, values in columns:
        here, there = values[some], values[~some]
        if len(here) < 3 or len(there) < 3 or not bool(torch.isfinite(values).all()):
            continue
        for side, beyond in (("above", here.min() > there.max()), ("below", here.max() < there.min())):
            if bool(beyond):
                yield Distinction("value", f"all rows with {what} {side} that of the others")
