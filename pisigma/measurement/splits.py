"""Split measurements into training and held-out rows; rows with equal joint values, or of a pair, stay together."""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.files.errors import MeasurementError, Phrase, Place, check_choice
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_of_equal_joints as groups_of_equal_joints
from pisigma.measurement.groups import groups_to_keep_whole, placement_groups

SplitBy = Literal["joints", "interleaved", "time", "space", "placement"]
"""Assignment to folds. "joints": at random; "interleaved": alternating, in the order of the file; "time": contiguous
blocks in the order of the file; "space": blocks of the measured positions; "placement": all sockets of a placement, or
all rows of a frame, together."""

_RANDOM_SPLITS: tuple[SplitBy, ...] = ("joints", "placement")
"""Kinds of splits that assign groups to folds at random, so that repeats differ."""
_HELD_OUT_GROUPS, _MAX_REPEATS = 200, 10
"""Number of held-out groups, summed over repeats, at which the random assignment has little influence; and the largest
number of repeats."""

_FOLDS = 5
"""Default number of folds of a cross-validation that is not by placement."""

TrainTest = tuple[Int64[Tensor, " _train"], Int64[Tensor, " _test"]]
"""Training rows and held-out rows, both in the order of the measurements."""


@dataclass(frozen=True)
class Splitting:
    """Settings of a split into training and held-out rows.

    Attributes:
        by: how rows are assigned, see `SplitBy`.
        seed: random seed.
        folds: number of folds of a cross-validation; 0 for no cross-validation, None for `_FOLDS` or one per placement.
        hold_out: share of the rows that is held out once, instead of folds.
    """

    by: SplitBy
    seed: int
    folds: int | None
    hold_out: float | None

    def split(
        self, measurements: Measurements, repeats: int | None, train_rows: int | None
    ) -> Sequence[Sequence[TrainTest]]:
        """Return training and held-out rows of every fold, per repeat; empty without a validation.

        Args:
            measurements: the rows.
            repeats: see `repeats`.
            train_rows: number of training rows that are sampled in every fold; None for all rows.

        Raises:
            MeasurementError: the measurements cannot be split in this way.
        """
        if self.hold_out is not None:
            splits: Sequence[Sequence[TrainTest]] = [
                [holdout(measurements, self.hold_out, self.seed, self.by)]
            ]
        elif self.folds == 0:
            return []
        else:
            folds = _FOLDS if self.folds is None and self.by != "placement" else self.folds
            if folds is not self.folds and len(set(groups_to_keep_whole(measurements).tolist())) < _FOLDS:
                raise MeasurementError(
                    expected=f"{_FOLDS} or more different poses for a cross-validation",
                    value=len(set(groups_to_keep_whole(measurements).tolist())),
                    at=Place(measurements.source),
                    remedy="measure more (about 50 for a good calibration), or do not cross-validate (--folds 0)",
                )
            splits = repeated_k_folds(measurements, folds, self.seed, self.by, repeats)
        if train_rows is None:
            return splits
        return [with_fewer_training_rows(measurements, folds, train_rows, self.seed) for folds in splits]


def k_folds(
    measurements: Measurements, folds: int | None, seed: int | torch.Generator, by: SplitBy = "joints"
) -> tuple[TrainTest, ...]:
    """Split the measurements into folds, each of which is held out once.

    Args:
        measurements: the rows to split.
        folds: number of folds, 2 or more; None for as many as there are groups to keep whole.
        seed: random seed for "joints" and "placement"; otherwise unused.
        by: "joints": groups of equal joint values, shuffled and assigned such that folds are as equal as the groups
            allow; "interleaved": the same without shuffling, so that groups of equal size alternate between the
            folds, as in scikit-learn's GroupKFold; "time": contiguous blocks in the order of the groups' first rows;
            "space": blocks from cutting the measured positions recursively across their widest axis; "placement":
            as for "joints", but with whole placements (see `placements`); rows without a placement are never held out.

    Returns:
        The training rows and the held-out rows of every fold.

    Raises:
        MeasurementError: there are fewer groups than folds, or required positions or names are missing.
    """
    group, sizes = _groups(measurements, by)
    _check_several(measurements, sizes, by)
    folds = len(sizes) if folds is None else folds
    if folds < 2 or folds > len(sizes):
        more = "placements" if by == "placement" else "poses"
        raise MeasurementError(
            option="folds",
            expected=f"2 to {len(sizes)} folds of {len(sizes)} {_kind(by)}",
            value=folds,
            at=Place(measurements.source),
            remedy=f"choose a number in this range, or measure more {more}",
        )
    fold = torch.zeros(len(sizes), dtype=torch.int64)
    if by in ("joints", "placement", "interleaved"):
        order = torch.arange(len(sizes)) if by == "interleaved" else _shuffled(len(sizes), seed)
        _assign(fold, sizes, order, folds)
    else:
        positions = _group_positions(measurements, group, len(sizes)) if by == "space" else None
        _cut_into_folds(fold, sizes, positions, torch.arange(len(sizes)), 0, folds)
    return tuple(_train_test(measurements, (fold[group] == number) & (group >= 0)) for number in range(folds))


def repeated_k_folds(
    measurements: Measurements,
    folds: int | None,
    seed: int,
    by: SplitBy = "joints",
    repeats: int | None = None,
) -> tuple[tuple[TrainTest, ...], ...]:
    """Split the measurements into folds several times, differently each time.

    With few groups, the error of held-out rows depends on which groups share a fold; several repeats average this out
    (Burman 1989, Biometrika 76(3), 503-514).

    Args:
        measurements: the rows to split.
        folds: number of folds, 2 or more; None for as many as there are groups.
        seed: random seed of the first repeat; the seeds of the other repeats follow from it.
        by: see `k_folds`.
        repeats: number of repeats; None for the number that holds out `_HELD_OUT_GROUPS` groups, limited to
            `_MAX_REPEATS`, or for one repeat if groups are held out one by one or are not assigned at random by joints.

    Returns:
        The folds of every repeat, see `k_folds`; the first repeat is that of `k_folds` with the same seed.

    Raises:
        MeasurementError: several repeats would be equal, or a split is impossible, see `k_folds`.
    """
    generator = torch.Generator().manual_seed(seed)
    first = k_folds(measurements, folds, generator, by)
    groups = len(_groups(measurements, by)[1])
    differ = by in _RANDOM_SPLITS and len(first) < groups
    if repeats is None:
        usual = min(_HELD_OUT_GROUPS // groups, _MAX_REPEATS)
        repeats = max(usual, 1) if by == "joints" and differ else 1
    if repeats > 1 and not differ:
        what = f"{groups} folds of {groups} {_kind(by)}" if by in _RANDOM_SPLITS else f"folds by {by}"
        raise MeasurementError(
            option="repeats",
            expected=f"one repeat, because {what} are the same every time",
            value=repeats,
            at=Place(measurements.source),
            remedy="choose one repeat, or fewer folds by joints or placement",
        )
    return first, *(k_folds(measurements, folds, generator, by) for _ in range(repeats - 1))


def holdout(
    measurements: Measurements, share: float, seed: int | torch.Generator, by: SplitBy = "joints"
) -> TrainTest:
    """Hold out a share of the measurements.

    Args:
        measurements: the rows to split.
        share: share of the rows to hold out, between 0 and 1; met as closely as the groups allow.
        seed: random seed for "joints" and "placement"; otherwise unused.
        by: "joints": groups of equal joint values at random; "interleaved": groups at regular intervals; "time": the
            last rows; "space": the far end of the widest axis of the measured positions; "placement": whole placements
            at random.

    Raises:
        MeasurementError: the share is not between 0 and 1, there is only one group, or required positions or names
            are missing.
    """
    if not 0 < share < 1:
        raise MeasurementError(
            option="hold_out",
            expected="a fraction between 0 and 1",
            value=float(share),
            at=Place(measurements.source),
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


def draw_rows(measurements: Measurements, rows: int, seed: int) -> Int64[Tensor, " _sampled"]:
    """Draw rows at random; rows with equal joint values, or of a pair, are drawn together.

    With the same seed, a smaller draw is a subset of every larger one.

    Args:
        measurements: the rows to draw from.
        rows: number of rows to draw; met as closely as whole configurations allow.
        seed: random seed.

    Returns:
        Indices of the rows, in the order of the measurements.

    Raises:
        MeasurementError: `rows` is less than 1 or more than the number of measurements.
    """
    if not 1 <= rows <= measurements.rows:
        raise MeasurementError(
            option="train_rows",
            expected=f"1 to {measurements.rows} training rows",
            value=rows,
            at=Place(measurements.source),
        )
    group = groups_to_keep_whole(measurements).cpu()
    sizes = torch.bincount(group)
    order = torch.randperm(len(sizes), generator=torch.Generator().manual_seed(seed))
    count = int((sizes[order].cumsum(0) - rows).abs().argmin()) + 1
    return torch.isin(group, order[:count]).nonzero()[:, 0].to(measurements.q.device)


def with_fewer_training_rows(
    measurements: Measurements, splits: Sequence[TrainTest], rows: int, seed: int
) -> tuple[TrainTest, ...]:
    """Draw training rows in every fold of a cross-validation by `draw_rows`; held-out rows are unchanged.

    Raises:
        MeasurementError: a fold has fewer training rows.
    """
    return tuple((train[draw_rows(measurements.select(train), rows, seed)], test) for train, test in splits)


def _groups(
    measurements: Measurements, by: SplitBy
) -> tuple[Int64[Tensor, " rows"], Int64[Tensor, " groups"]]:
    """Return the index of every row's group (-1 for rows that are never held out), and the sizes of the groups."""
    check_choice(MeasurementError, "by", by, get_args(SplitBy))
    group = (placement_groups if by == "placement" else groups_to_keep_whole)(measurements).cpu()
    return group, torch.bincount(group[group >= 0])


def _check_several(measurements: Measurements, sizes: Int64[Tensor, " groups"], by: SplitBy) -> None:
    """Refuse a single group.

    Raises:
        MeasurementError: there is only one group.
    """
    if len(sizes) < 2:
        what = "placement" if by == "placement" else "pose, with equal joint values"
        raise MeasurementError(
            f"all {measurements.rows} rows belong to one {what}, so they cannot be split into training and held-out "
            "rows",
            option="by",
            value=by,
            at=Place(measurements.source),
            remedy="measure at other joint values, spread over the workspace",
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
    """Assign groups in the order of decreasing size, each to the fold with the fewest rows."""
    order = order[sizes[order].argsort(descending=True, stable=True)]
    heap = [(0, number) for number in range(folds)]
    for group, size in zip(order.tolist(), sizes[order].tolist(), strict=True):
        rows, number = heap[0]
        fold[group] = number
        heapq.heapreplace(heap, (rows + size, number))


def _interleaved(sizes: Int64[Tensor, " groups"], share: float) -> Bool[Tensor, " groups"]:
    """Choose held-out groups so that their share of the rows up to any group is as close as possible to `share`."""
    # error diffusion: a group is held out if that brings the share of the rows so far nearer to `share`
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
    """Assign the folds from `first` on to `members` by recursive bisection."""
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
    """Return the number of groups before a cut for which their share of the rows is closest to `share`."""
    rows_before = sizes.cumsum(0)
    deviation = (rows_before - share * rows_before[-1]).abs()
    allowed = deviation[least_before - 1 : len(sizes) - least_after]
    return least_before + int(allowed.argmin())


def _along_widest_axis(
    positions: Float64[Tensor, "groups 3"], members: Int64[Tensor, " members"]
) -> Int64[Tensor, " members"]:
    """Return the members sorted by the coordinate with the largest range."""
    points = positions[members]
    axis = int((points.amax(0) - points.amin(0)).argmax())
    return members[points[:, axis].argsort(stable=True)]


def _group_positions(
    measurements: Measurements, group: Int64[Tensor, " rows"], groups: int
) -> Float64[Tensor, "groups 3"]:
    """Return the mean measured position of every group [m]."""
    if len(set(measurements.frame)) > 1:
        raise MeasurementError(
            option="by",
            expected="positions in one frame, to split them by space",
            value=Phrase(f"{len(set(measurements.frame))} frames"),
            at=Place(measurements.source),
            remedy="split by joints or by time",
        )
    position = torch.full((measurements.rows, 3), torch.nan, dtype=torch.float64)
    if measurements.position is not None:
        position = measurements.position.detach().cpu()
    measured = ~position.isnan().any(-1)
    count = torch.bincount(group[measured], minlength=groups)
    if (count == 0).any():
        row = int((group == int((count == 0).nonzero()[0])).nonzero()[0])
        raise MeasurementError(
            "no position was measured, so the rows cannot be split by space",
            option="by",
            at=measurements.place_of(row),
            remedy="split by joints or by time",
        )
    total = torch.zeros(groups, 3, dtype=torch.float64).index_add(0, group[measured], position[measured])
    return total / count[:, None]


def _train_test(measurements: Measurements, is_test: Tensor) -> TrainTest:
    rows = torch.arange(measurements.rows)
    device = measurements.q.device
    return rows[~is_test].to(device), rows[is_test].to(device)
