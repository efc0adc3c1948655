"""Splits of measurements into training and test rows; rows of equal joint values, and of a pair, stay together."""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.files.errors import MeasurementError, nearest_choice
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_of_equal_joints as groups_of_equal_joints
from pisigma.measurement.groups import groups_to_keep_whole, placement_groups

SplitBy = Literal["joints", "interleaved", "time", "space", "placement"]
"""By joints: at random; interleaved: in turn, in the file's order; by time: blocks of that order; by space: blocks of
the measured positions; by placement: all sockets of a placement together, or all rows of a frame."""

AT_RANDOM: tuple[SplitBy, ...] = ("joints", "placement")
"""Ways that put groups into folds at random, so that another repeat gives other folds."""
JUDGED_GROUPS, MOST_REPEATS = 200, 10
"""Groups held out, counted anew in every repeat, after which the luck of a single repeat hardly shows."""

FOLDS = 5
"""Of a cross-validation that is not by placement."""

TrainTest = tuple[Int64[Tensor, " _train"], Int64[Tensor, " _test"]]
"""Rows to train on and rows to test on, each in the order of the measurements."""


@dataclass(frozen=True)
class Splitting:
    """How rows are split into those to train on and those to judge on.

    Attributes:
        by: what stays together, see `SplitBy`.
        seed: of all draws.
        folds: of a cross-validation; 0 for none, None for `FOLDS` or one for every placement.
        hold_out: share of the rows that are held out once, instead of folds.
    """

    by: SplitBy
    seed: int
    folds: int | None
    hold_out: float | None

    def of(
        self, measurements: Measurements, times: int | None, train_rows: int | None
    ) -> Sequence[Sequence[TrainTest]]:
        """Give training and test rows of every fold, per repeat; nothing without a validation.

        Args:
            measurements: the rows.
            times: see `repeats`.
            train_rows: so many training rows are drawn in every fold; None for all.

        Raises:
            MeasurementError: the measurements cannot be split like that.
        """
        if self.hold_out is not None:
            splits: Sequence[Sequence[TrainTest]] = [
                [holdout(measurements, self.hold_out, self.seed, self.by)]
            ]
        elif self.folds == 0:
            return []
        else:
            folds = FOLDS if self.folds is None and self.by != "placement" else self.folds
            if folds is not self.folds and len(set(groups_to_keep_whole(measurements).tolist())) < FOLDS:
                raise MeasurementError(
                    f"{measurements.source}: {FOLDS} different poses or more were wanted, so that each can be left out "
                    "once to judge the others; measure more, about 50 for a good calibration, or leave that out "
                    "(--folds 0)."
                )
            splits = repeats(measurements, folds, self.seed, self.by, times)
        if train_rows is None:
            return splits
        return [with_fewer(measurements, folds, train_rows, self.seed) for folds in splits]


def k_folds(
    measurements: Measurements, folds: int | None, seed: int | torch.Generator, by: SplitBy = "joints"
) -> tuple[TrainTest, ...]:
    """Split the measurements into folds, each of which is the test once.

    Args:
        measurements: what to split.
        folds: how many, 2 or more; None for as many as there are groups to keep whole.
        seed: decides which groups come together by joints and by placement; unused otherwise.
        by: "joints": groups of equal joints, shuffled and assigned such that folds are as equal as the groups
            allow; "interleaved": the same unshuffled, so that groups of one size go to the folds in turn, as
            with scikit-learn's GroupKFold; "time": contiguous blocks of the rows' order, a group counting
            where its first row stands; "space": blocks from cutting the measured positions again and again
            across their widest axis; "placement": assigned like joints, but whole placements (see `placements`);
            rows of none are in no test.

    Returns:
        Per fold the rows to train on and the rows to test on.

    Raises:
        MeasurementError: there are fewer groups than folds, or positions or names that are needed are not there.
    """
    group, sizes = _groups(measurements, by)
    _check_several(measurements, sizes, by)
    folds = len(sizes) if folds is None else folds
    if folds < 2 or folds > len(sizes):
        more = "placements" if by == "placement" else "poses"
        raise MeasurementError(
            f"{measurements.source}: {folds} folds were wanted from {len(sizes)} {_kind(by)}; "
            f"ask for 2 to {len(sizes)} folds or measure more {more}."
        )
    fold = torch.zeros(len(sizes), dtype=torch.int64)
    if by in ("joints", "placement", "interleaved"):
        order = torch.arange(len(sizes)) if by == "interleaved" else _shuffled(len(sizes), seed)
        _assign(fold, sizes, order, folds)
    else:
        positions = _group_positions(measurements, group, len(sizes)) if by == "space" else None
        _cut_into_folds(fold, sizes, positions, torch.arange(len(sizes)), 0, folds)
    return tuple(_train_test(measurements, (fold[group] == number) & (group >= 0)) for number in range(folds))


def repeats(
    measurements: Measurements, folds: int | None, seed: int, by: SplitBy = "joints", times: int | None = None
) -> tuple[tuple[TrainTest, ...], ...]:
    """Split the measurements into folds several times over, differently each time.

    With few groups the error of held-out rows depends on which of them came together; over several repeats that
    averages out (Burman 1989, Biometrika 76(3), 503-514).

    Args:
        measurements: what to split.
        folds: how many, 2 or more; None for as many as there are groups.
        seed: of the first repeat; the others follow from it.
        by: see `k_folds`.
        times: how many repeats; None for as many as it takes to hold out `JUDGED_GROUPS` groups, `MOST_REPEATS` at
            most, and one where groups are not assigned at random, by placement, or one by one.

    Returns:
        Per repeat its folds, as from `k_folds`; the first one as with `k_folds`.

    Raises:
        MeasurementError: several repeats were wanted where they do not differ; see `k_folds` too.
    """
    generator = torch.Generator().manual_seed(seed)
    first = k_folds(measurements, folds, generator, by)
    groups = len(_groups(measurements, by)[1])
    differ = by in AT_RANDOM and len(first) < groups
    if times is None:
        usual = min(JUDGED_GROUPS // groups, MOST_REPEATS)
        times = max(usual, 1) if by == "joints" and differ else 1
    if times > 1 and not differ:
        what = f"{groups} folds of {groups} {_kind(by)}" if by in AT_RANDOM else f"folds by {by}"
        raise MeasurementError(
            f"{measurements.source}: {times} repeats were wanted, but {what} are the same every time; ask for one "
            "repeat, or for fewer folds by joints or placement."
        )
    return first, *(k_folds(measurements, folds, generator, by) for _ in range(times - 1))


def holdout(
    measurements: Measurements, share: float, seed: int | torch.Generator, by: SplitBy = "joints"
) -> TrainTest:
    """Keep a share of the measurements for the test.

    Args:
        measurements: what to split.
        share: of the rows for the test, between 0 and 1; met as closely as the groups allow.
        seed: decides which rows by joints and by placement; unused otherwise.
        by: "joints": groups of equal joints at random; "interleaved": every so many groups one; "time": the last
            rows; "space": the far end of the widest axis of the measured positions; "placement": whole placements
            at random.

    Raises:
        MeasurementError: the share is not between 0 and 1, there is one group only, or positions or names that are
            needed are not there.
    """
    if not 0 < share < 1:
        raise MeasurementError(
            f"{measurements.source}: a test share between 0 and 1 was wanted, got {share:g}."
        )
    group, sizes = _groups(measurements, by)
    _check_several(measurements, sizes, by)
    if by == "interleaved":
        is_test = _interleaved(sizes, share)
        return _train_test(measurements, is_test[group])
    order = torch.arange(len(sizes))
    if by in ("joints", "placement"):
        order = _shuffled(len(sizes), seed)
    elif by == "space":
        order = _along_widest_axis(_group_positions(measurements, group, len(sizes)), order)
    cut = _cut(sizes[order], 1 - share, 1, 1)
    is_test = torch.zeros(len(sizes), dtype=torch.bool)
    is_test[order[cut:]] = True
    return _train_test(measurements, is_test[group] & (group >= 0))


def draw_rows(measurements: Measurements, rows: int, seed: int) -> Int64[Tensor, " _drawn"]:
    """Draw rows at random; those of equal joint values, and of a pair, come together.

    With one seed a smaller draw is part of every larger one.

    Args:
        measurements: to draw from.
        rows: how many are wanted; it is met as closely as whole configurations allow.
        seed: of the draw.

    Returns:
        Numbers of the rows in the order of the measurements.

    Raises:
        MeasurementError: there are fewer rows, or less than one is wanted.
    """
    if not 1 <= rows <= measurements.rows:
        raise MeasurementError(
            f"{measurements.source}: {rows} training rows were wanted, but there are {measurements.rows} to draw "
            f"from; ask for 1 to {measurements.rows}."
        )
    group = groups_to_keep_whole(measurements).cpu()
    sizes = torch.bincount(group)
    order = torch.randperm(len(sizes), generator=torch.Generator().manual_seed(seed))
    count = int((sizes[order].cumsum(0) - rows).abs().argmin()) + 1
    return torch.isin(group, order[:count]).nonzero()[:, 0].to(measurements.q.device)


def with_fewer(
    measurements: Measurements, splits: Sequence[TrainTest], rows: int, seed: int
) -> tuple[TrainTest, ...]:
    """Draw the training rows of every split of a cross-validation; its test rows stay. See `draw_rows`.

    Raises:
        MeasurementError: a split has fewer training rows.
    """
    return tuple((train[draw_rows(measurements.select(train), rows, seed)], test) for train, test in splits)


def _groups(
    measurements: Measurements, by: SplitBy
) -> tuple[Int64[Tensor, " rows"], Int64[Tensor, " groups"]]:
    """The number of every row's group, -1 for rows that are in no test, and how many rows each has."""
    if by not in get_args(SplitBy):
        raise MeasurementError(f"split by '{by}' is unknown; {nearest_choice(by, get_args(SplitBy))}")
    group = (placement_groups if by == "placement" else groups_to_keep_whole)(measurements).cpu()
    return group, torch.bincount(group[group >= 0])


def _check_several(measurements: Measurements, sizes: Int64[Tensor, " groups"], by: SplitBy) -> None:
    """Refuse a single group.

    Raises:
        MeasurementError: see above.
    """
    if len(sizes) < 2:
        what = "placement" if by == "placement" else "joint vector, so they are one pose"
        raise MeasurementError(
            f"{measurements.source}: all {measurements.rows} rows are of one {what}, which cannot be split into "
            "training and test; measure at other joint values, spread over the workspace."
        )


def _kind(by: SplitBy) -> str:
    return "placements" if by == "placement" else "different joint vectors"


def _shuffled(count: int, seed: int | torch.Generator) -> Int64[Tensor, " count"]:
    generator = seed if isinstance(seed, torch.Generator) else torch.Generator().manual_seed(seed)
    return torch.randperm(count, generator=generator, device=generator.device).cpu()


def _assign(
    fold: Int64[Tensor, " groups"],
    sizes: Int64[Tensor, " groups"],
    order: Int64[Tensor, " groups"],
    folds: int,
) -> None:
    """Assign the groups, large ones first, each to the fold with the fewest rows."""
    order = order[sizes[order].argsort(descending=True, stable=True)]
    heap = [(0, number) for number in range(folds)]
    for group, size in zip(order.tolist(), sizes[order].tolist(), strict=True):
        rows, number = heap[0]
        fold[group] = number
        heapq.heapreplace(heap, (rows + size, number))


def _interleaved(sizes: Int64[Tensor, " groups"], share: float) -> Bool[Tensor, " groups"]:
    """Which groups are the test, so that of the rows up to any group it holds the share as closely as may be."""
    is_test, passed, held = [], 0, 0
    for size in sizes.tolist():
        passed += size
        is_test.append(abs(held + size - share * passed) < abs(held - share * passed))
        held += size * is_test[-1]
    if all(is_test) or not any(is_test):
        is_test[-1] = not is_test[-1]
    return torch.tensor(is_test)


def _cut_into_folds(
    fold: Int64[Tensor, " groups"],
    sizes: Int64[Tensor, " groups"],
    positions: Float64[Tensor, "groups 3"] | None,
    members: Int64[Tensor, " _members"],
    first: int,
    folds: int,
) -> None:
    """Give `members` the folds from `first` on: halve them and go on with the halves."""
    if folds == 1:
        fold[members] = first
        return
    if positions is not None:
        members = _along_widest_axis(positions, members)
    left = folds // 2
    cut = _cut(sizes[members], left / folds, left, folds - left)
    _cut_into_folds(fold, sizes, positions, members[:cut], first, left)
    _cut_into_folds(fold, sizes, positions, members[cut:], first + left, folds - left)


def _cut(sizes: Int64[Tensor, " _members"], share: float, least_before: int, least_after: int) -> int:
    """Number of groups before the cut, such that they hold a share of the rows as closely as may be."""
    rows_before = sizes.cumsum(0)
    deviation = (rows_before - share * rows_before[-1]).abs()
    allowed = deviation[least_before - 1 : len(sizes) - least_after]
    return least_before + int(allowed.argmin())


def _along_widest_axis(
    positions: Float64[Tensor, "groups 3"], members: Int64[Tensor, " members"]
) -> Int64[Tensor, " members"]:
    """The members in order of the coordinate in which they are farthest apart."""
    points = positions[members]
    axis = int((points.amax(0) - points.amin(0)).argmax())
    return members[points[:, axis].argsort(stable=True)]


def _group_positions(
    measurements: Measurements, group: Int64[Tensor, " rows"], groups: int
) -> Float64[Tensor, "groups 3"]:
    """Mean measured position of every group [m]."""
    if len(set(measurements.frame)) > 1:
        raise MeasurementError(
            f"{measurements.source}: positions in {len(set(measurements.frame))} frames cannot be compared; "
            "split by joints or by time."
        )
    position = torch.full((measurements.rows, 3), torch.nan, dtype=torch.float64)
    if measurements.position is not None:
        position = measurements.position.detach().cpu()
    measured = ~position.isnan().any(-1)
    count = torch.bincount(group[measured], minlength=groups)
    if (count == 0).any():
        row = int((group == int((count == 0).nonzero()[0])).nonzero()[0])
        raise MeasurementError(
            f"{measurements.place(row)}: no position was measured, so it cannot be split by space; split by "
            "joints or by time."
        )
    total = torch.zeros(groups, 3, dtype=torch.float64).index_add(0, group[measured], position[measured])
    return total / count[:, None]


def _train_test(measurements: Measurements, is_test: Tensor) -> TrainTest:
    rows = torch.arange(measurements.rows)
    device = measurements.q.device
    return rows[~is_test].to(device), rows[is_test].to(device)
