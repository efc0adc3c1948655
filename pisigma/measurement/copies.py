"""Rows that stand there twice: the same joint values and readings, perhaps rounded, in another unit or order."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.measurement.fields import LeftOut, MeasuredFields
from pisigma.measurement.groups import numbers_of_names
from pisigma.measurement.readings import READINGS
from pisigma.robot.description import Robot
from pisigma.robot.se3 import rpy_from_rotation

DEGREE = math.pi / 180
LENGTH_STEPS = sorted((*(10.0**-k for k in range(3, 10)), *(0.0254 * 10.0**-k for k in range(2, 7))))[::-1]
"""[m] Lengths are rounded to one of these: decimals of a metre and of an inch."""
ANGLE_STEPS = sorted((*(DEGREE * 10.0**-k for k in range(1, 9)), *(10.0**-k for k in range(3, 10))))[::-1]
"""[rad] Angles are rounded to one of these: decimals of a degree and of a radian."""
ON_GRID = 1e-3
"""Share of a step by which rounded values may be beside it, as they were converted and rounded again."""
UNKNOWN_TURN = 1e-3
"""[rad] Orientations whose rounding cannot be known, as that of quaternions, are the same within this."""
OF_IMAGE = 1e-5
"""[m or rad] Poses that are found from corners are the same within this, as their pixels may have been rounded."""
STANDING, RETURNING = 2e-6, 2e-5
"""[m or rad] Least standard deviations of repeated readings: of a robot that stands still, and of one that has come
back to a pose. Larger ones make equal readings less likely."""
EVIDENCE = math.log(1e4)
"""Logarithm of the odds against chance from which on equal rows are copies."""
EXCESS, NEARLY_ALL = 10.0, 0.95
"""So many times as often as by chance rows are equal where some are copies, or so large a share of them is."""
ROW_READINGS, ROW_STEPS = 9, 4
"""Numbers of a row behind the values of its axes, and of roundings."""
NAMED = 5
"""Rows that a sentence names, at most."""
_CHUNK = 1 << 22


@dataclass(frozen=True)
class CopiedRow(LeftOut):
    """A row that does not count, as another one is the same measurement.

    Attributes:
        place: of the row.
        original: place of the row that counts.
    """

    place: str = ""
    original: str = ""


@dataclass(frozen=True, eq=False)
class RowValues:
    """What is compared of rows, and what their numbers were rounded to.

    Attributes:
        numbers: values of the controller's axes [rad or m]; the measured length, in three coordinates or fewer [SI];
            and the first two columns of the measured rotation. NaN where there is none.
        steps: what they were rounded to: axes that turn [rad], axes that slide [m], length [m], rotation [rad].
        kind: of every number, its column of `steps`.
        file: number of the file that a row comes from.
    """

    numbers: Float64[Tensor, "rows numbers"]
    steps: Float64[Tensor, "rows 4"]
    kind: Int64[Tensor, " numbers"]
    file: Int64[Tensor, " rows"]

    @staticmethod
    def of(rows: MeasuredFields, robot: Robot) -> "RowValues":
        """Take them from rows of a robot."""
        q = torch.from_numpy(robot.to_controller(rows.numbers["q"].detach().cpu().double().numpy()))
        length = _lengths(rows)
        rotation = (
            rows.numbers.get("rotation", torch.full((rows.rows, 3, 3), torch.nan)).detach().cpu().double()
        )
        turns = torch.tensor([axis.type == "revolute" for axis in robot.axes])
        axes = _steps(q[:, turns], ANGLE_STEPS), _steps(q[:, ~turns], LENGTH_STEPS)
        turn = _steps(rpy_from_rotation(rotation), ANGLE_STEPS, UNKNOWN_TURN)
        steps = torch.stack([*axes, _steps(length, LENGTH_STEPS), turn], 1)
        if "corner" in READINGS:
            steps[rows.measured("corner").cpu(), 2:] = OF_IMAGE
        numbers = torch.cat([q, length, rotation[:, :, :2].flatten(1)], 1)
        file = numbers_of_names(rows.origin or (rows.source,) * rows.rows)
        return RowValues(numbers, steps, _kinds(robot), file)

    @staticmethod
    def kept(
        numbers: Float64[Tensor, "rows numbers"], steps: Float64[Tensor, "rows 4"], robot: Robot
    ) -> "RowValues":
        """Take what was kept of rows of a robot, which are of one file."""
        return RowValues(numbers, steps, _kinds(robot), torch.zeros(len(numbers), dtype=torch.int64))

    def select(self, rows: Tensor) -> "RowValues":
        """The rows of an index."""
        return RowValues(self.numbers[rows], self.steps[rows], self.kind, self.file[rows])

    def __add__(self, other: "RowValues") -> "RowValues":
        """Put other rows, of other files, behind these."""
        return RowValues(
            torch.cat([self.numbers, other.numbers]),
            torch.cat([self.steps, other.steps]),
            self.kind,
            torch.cat([self.file, other.file + len(self.file)]),
        )

    @property
    def column_steps(self) -> Float64[Tensor, "rows numbers"]:
        """The step of every number; entries of a rotation change by as much as its three angles together."""
        return (self.steps * torch.tensor([1, 1, 1, 3**0.5]))[:, self.kind]

    @property
    def q(self) -> Float64[Tensor, "rows dof"]:
        """Values of the axes."""
        return self.numbers[:, :-ROW_READINGS]

    @property
    def length(self) -> Float64[Tensor, "rows 3"]:
        """The measured length."""
        return self.numbers[:, -ROW_READINGS:-6]


def _kinds(robot: Robot) -> Int64[Tensor, " numbers"]:
    """Of every number of a row of a robot, its column of the steps."""
    return torch.tensor([0 if axis.type == "revolute" else 1 for axis in robot.axes] + 3 * [2] + 6 * [3])


def _lengths(rows: MeasuredFields) -> Float64[Tensor, "rows 3"]:
    """The measured length of every row, and where it has none what a registered sensor measured instead."""
    found = torch.full((rows.rows, 3), torch.nan, dtype=torch.float64)
    groups = [("position",), ("touch",), ("distance",), *(one.numbers for one in READINGS.values())]
    for names in groups:
        those = [
            rows.numbers[name].detach().cpu().double().reshape(rows.rows, -1)
            for name in names
            if name in rows.numbers
        ]
        if not those:
            continue
        values = torch.cat(those, 1)[:, :3]
        values = torch.nn.functional.pad(values, (0, 3 - values.shape[1]), value=torch.nan)
        found = torch.where(found.isnan().all(1, keepdim=True), values, found)
    return found


def _steps(
    values: Float64[Tensor, "rows values"], steps: Sequence[float], otherwise: float = 0.0
) -> Float64[Tensor, " rows"]:
    """What the values of every row were rounded to: the coarsest step of which all are multiples.

    Args:
        values: NaN is a multiple of anything.
        steps: the coarsest first.
        otherwise: where they are multiples of none; 0 for the finest.
    """
    found = torch.full((len(values),), otherwise or steps[-1], dtype=torch.float64)
    for step in reversed(steps):
        beside = (values / step - (values / step).round()).abs().nan_to_num(nan=0.0)
        found = torch.where((beside <= ON_GRID).all(1), step, found)
    return found


def originals(values: RowValues, known: int = 0) -> Int64[Tensor, " rows"]:
    """For every row the row that it is a copy of; its own number where it is none.

    A copy has the joint values and all readings of another row to the coarser of both roundings. Which rows have so by
    chance depends on how well a robot repeats: equal rows are copies where that has less than 1e-4 of chance.

    Args:
        values: of all rows.
        known: so many rows stand first, and copies of these are looked for only.
    """
    count = len(values.numbers)
    own = torch.arange(count)
    keys = (own.numpy(), *values.steps.T[:3].numpy(), (own >= known).numpy())
    order = torch.from_numpy(np.lexsort(keys))
    rank = order.argsort()
    first, second = _equal_pairs(values)
    if known:
        between = (first < known) & (second >= known)
        first, second = first[between], second[between]
    swapped = rank[first] > rank[second]
    better, worse = torch.where(swapped, second, first), torch.where(swapped, first, second)
    same_joints = _SameJoints.of(values)
    standing = same_joints.run[better] == same_joints.run[worse]
    best = rank.clone()
    for scope, deviation in ((standing, STANDING), (~standing, RETURNING)):
        equal = torch.zeros(count, dtype=torch.bool)
        equal[worse[scope]] = True
        partners = same_joints.partners(rank, known, scope is standing)
        chance = same_joints.chance(values, deviation)
        if _are_copies(equal, partners, chance):
            best.scatter_reduce_(0, worse[scope], rank[better[scope]], "amin")
    return order[best]


def _are_copies(
    equal: Bool[Tensor, " rows"], partners: Int64[Tensor, " rows"], chance: Float64[Tensor, " rows"]
) -> bool:
    """Whether more rows equal another than do by chance (Chernoff's bound for independent trials).

    Args:
        equal: rows that do.
        partners: rows at the same joint values that they might be equal to.
        chance: that a row equals one of these.
    """
    tried = equal | (partners > 0)
    found, count = int(equal.sum()), int(tried.sum())
    if not found:
        return False
    once = chance[tried].clamp(max=1 - 1e-12)
    expected = float(-torch.expm1(partners[tried].clamp(min=1) * torch.log1p(-once)).sum())
    share, usual = found / count, expected / count
    if not (found >= EXCESS * expected or share >= max(NEARLY_ALL, usual)):
        return False
    rest = 0.0 if share == 1 else (1 - share) * math.log((1 - share) / (1 - usual))
    return count * (share * math.log(share / max(usual, 1e-300)) + rest) >= EVIDENCE


@dataclass(frozen=True, eq=False)
class _SameJoints:
    """Rows at the same joint values.

    Attributes:
        group: number of the joint values of a row.
        run: rows of one number were measured behind each other there.
    """

    group: Int64[Tensor, " rows"]
    run: Int64[Tensor, " rows"]

    @staticmethod
    def of(values: RowValues) -> "_SameJoints":
        coarsest = values.column_steps[:, : values.q.shape[1]].amax(0)
        group = torch.unique((values.q / coarsest).round() + 0.0, dim=0, return_inverse=True)[1]
        goes_on = (group[1:] == group[:-1]) & (values.file[1:] == values.file[:-1])
        run = torch.cat([torch.zeros(min(len(group), 1), dtype=torch.int64), (~goes_on).cumsum(0)])
        return _SameJoints(group, run)

    def partners(self, rank: Int64[Tensor, " rows"], known: int, standing: bool) -> Int64[Tensor, " rows"]:
        """How many other rows a row might be equal to: of its own run, or of other ones."""
        if known:
            there = torch.bincount(self.group[:known], minlength=len(rank))[self.group]
            return torch.where(torch.arange(len(rank)) < known, 0, 0 if standing else there)
        in_run = torch.bincount(self.run)[self.run]
        best = torch.full((len(rank),), len(rank)).scatter_reduce(0, self.group, rank, "amin")[self.group]
        if standing:
            first = torch.full((len(rank),), len(rank)).scatter_reduce(0, self.run, rank, "amin")[self.run]
            return torch.where(rank == first, 0, in_run - 1)
        return torch.where(
            self.run == self.run[rank.argsort()[best]], 0, torch.bincount(self.group)[self.group] - in_run
        )

    def chance(self, values: RowValues, deviation: float) -> Float64[Tensor, " rows"]:
        """That a repeated measurement reads the same as one at the same joint values, to the coarsest rounding there.

        Where joint values alone were measured, as at sockets, these are what is read.
        """
        steps = torch.stack(
            [one.scatter_reduce(0, self.group, one, "amax")[self.group] for one in values.steps.unbind(1)], 1
        )
        logarithms = _chance_of_equal(steps, deviation * 2**0.5).log()
        axes = logarithms[:, values.kind[: values.q.shape[1]]].sum(1)
        length, turn = logarithms[:, 2], logarithms[:, 3]
        lengths, turned = values.length.isfinite().sum(1), values.numbers[:, -1].isfinite()
        read = lengths * length + torch.where(turned, 3 * turn, 0.0)
        return torch.where((lengths > 0) | turned, read, axes).exp()


def _chance_of_equal(step: Float64[Tensor, "*shape"], deviation: float) -> Float64[Tensor, "*shape"]:
    """Chance that two values round to the same multiple of a step, whose difference has a standard deviation."""
    x = step / deviation
    within = torch.erf(x / 2**0.5)
    chance: Tensor = within + (2 / math.pi) ** 0.5 / x * torch.expm1(-x.square() / 2)
    return chance.clamp(min=1e-30)


def _equal_pairs(values: RowValues) -> tuple[Int64[Tensor, " pairs"], Int64[Tensor, " pairs"]]:
    """Pairs of rows, the first one's number lower, whose numbers agree to the coarser of both roundings.

    Rows are sorted by one sum of their numbers, whose neighbours alone may be equal.
    """
    numbers, steps = values.numbers, values.column_steps
    scale = steps.amax(0)
    weight = torch.arange(2.0, 2 + numbers.shape[1]).double().sqrt() % 1 + 0.5  # no simple ratios
    key, order = ((numbers / scale).nan_to_num(nan=0.0) @ weight).sort()
    last = torch.searchsorted(key, key + 1.1 * float(weight.sum()), right=True)
    ahead = last - torch.arange(len(key)) - 1
    found = [torch.zeros(2, 0, dtype=torch.int64)]
    for begin, end in _chunks(ahead):
        own = torch.repeat_interleave(torch.arange(begin, end), ahead[begin:end])
        offset = torch.arange(len(own)) - torch.repeat_interleave(
            ahead[begin:end].cumsum(0) - ahead[begin:end], ahead[begin:end]
        )
        pair = torch.stack([order[own], order[own + 1 + offset]])
        for column in range(numbers.shape[1]):
            pair = pair[:, _agree(numbers[:, column][pair], steps[:, column][pair])]
        found.append(pair)
    pairs = torch.cat(found, 1)
    return pairs.amin(0), pairs.amax(0)


def _agree(values: Float64[Tensor, "2 pairs"], steps: Float64[Tensor, "2 pairs"]) -> Bool[Tensor, " pairs"]:
    """Whether two values may have been rounded from one: to the same step, or to two of which one is coarser."""
    fine, coarse = steps.amin(0), steps.amax(0)
    most = torch.where(coarse - fine > ON_GRID * coarse, coarse + fine, coarse) * (0.5 + ON_GRID)
    return ((values[0] - values[1]).abs() <= most) | values.isnan().all(0)


def _chunks(ahead: Int64[Tensor, " rows"]) -> list[tuple[int, int]]:
    """Ranges of rows with so many neighbours together as fit into memory."""
    part = (ahead.cumsum(0) // _CHUNK).numpy()
    borders = [0, *(np.flatnonzero(np.diff(part)) + 1).tolist(), len(part)]
    return list(itertools.pairwise(borders))


def _whole_pairs(rows: MeasuredFields, copied: Bool[Tensor, " rows"]) -> Bool[Tensor, " rows"]:
    """Copies but for those of pairs of which only one row is a copy."""
    pairs = numbers_of_names(list(zip(rows.origin or ("",) * rows.rows, rows.text("pair"), strict=True)))
    paired = torch.tensor([bool(name) for name in rows.text("pair")])
    half = torch.zeros(rows.rows, dtype=torch.bool)
    half[pairs[paired & ~copied]] = True
    return copied & ~(paired & half[pairs])


def copies_of_known(rows: MeasuredFields, robot: Robot, known: RowValues) -> Bool[Tensor, " rows"]:
    """Whether rows are copies of rows that are known, perhaps rounded otherwise, in another order or in part."""
    if rows.rows == 0 or not len(known.numbers) or rows.numbers["q"].shape[1] != robot.dof:
        return torch.zeros(rows.rows, dtype=torch.bool)
    count = len(known.numbers)
    values = known + RowValues.of(rows, robot)
    original = originals(values, count)[count:]
    return _whole_pairs(rows, original != torch.arange(count, count + rows.rows))


def without_copies(rows: MeasuredFields, robot: Robot) -> MeasuredFields:
    """Leave out rows that are copies of others, of which the one with most digits stays; see `CopiedRow`.

    A row of a pair is left out together with the other one.
    """
    if rows.rows < 2 or rows.numbers["q"].shape[1] != robot.dof:
        return rows
    original = originals(RowValues.of(rows, robot))
    copied = _whole_pairs(rows, original != torch.arange(rows.rows))
    if not copied.any():
        return rows
    left_out = tuple(
        CopiedRow(rows.line[row], "a copy of another row", rows.label(row), rows.label(int(original[row])))
        for row in copied.nonzero()[:, 0].tolist()
    )
    kept = rows.select((~copied).nonzero()[:, 0])
    return replace(kept, left_out=(*rows.left_out, *left_out))


def places_text(rows: MeasuredFields, chosen: Bool[Tensor, " rows"]) -> str:
    """Name some rows, the first of many."""
    numbers = chosen.nonzero()[:, 0].tolist()
    named = ", ".join(rows.label(number) for number in numbers[:NAMED])
    return f"{named} and {len(numbers) - NAMED} more" if len(numbers) > NAMED else named


def copy_warnings(left_out: Sequence[LeftOut]) -> tuple[str, ...]:
    """Say which rows were left out as copies: a sentence, or nothing."""
    copies = [one for one in left_out if isinstance(one, CopiedRow)]
    if not copies:
        return ()
    named = ", ".join(f"{one.place} ({one.original})" for one in copies[:NAMED])
    more = f" and {len(copies) - NAMED} more" if len(copies) > NAMED else ""
    verb = (
        "row is a copy of another, and counts" if len(copies) == 1 else "rows are copies of others, and count"
    )
    return (
        f"{len(copies)} {verb} once: all joint values and readings agree to the coarser rounding of both: "
        f"{named}{more}; state every measurement once.",
    )
