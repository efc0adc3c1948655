"""Find duplicate rows: the same joint values and readings, perhaps rounded, reordered or in another unit."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.measurement.fields import MeasuredFields, UnusableRow
from pisigma.measurement.groups import numbers_of_names
from pisigma.measurement.readings import READINGS
from pisigma.robot.description import Robot
from pisigma.robot.se3 import zyx_from_rotation

_DEGREE = math.pi / 180
_LENGTH_STEPS = sorted((*(10.0**-k for k in range(3, 10)), *(0.0254 * 10.0**-k for k in range(2, 7))))[::-1]
"""Rounding steps of lengths [m]: decimals of a metre and of an inch."""
_ANGLE_STEPS = sorted((*(_DEGREE * 10.0**-k for k in range(1, 9)), *(10.0**-k for k in range(3, 10))))[::-1]
"""Rounding steps of angles [rad]: decimals of a degree and of a radian."""
_GRID_TOLERANCE = 1e-3
"""Largest deviation of a rounded value from a multiple of its step, as a share of the step; values may have been
converted and rounded again."""
_ROTATION_STEP = 1e-3
"""Rounding step [rad] assumed for orientations whose rounding is unknown, such as quaternions."""
_IMAGE_STEP = 1e-5
"""Rounding step [m or rad] assumed for poses from corners of images, whose pixels may have been rounded."""
_STANDING, _RETURNING = 2e-6, 2e-5
"""Smallest standard deviations of repeated readings [m or rad], for a robot at standstill and for a robot that
returned to a pose."""
_MIN_EVIDENCE = math.log(1e4)
"""Natural logarithm of the odds against chance above which equal rows are treated as copies."""
_MIN_EXCESS, _MIN_SHARE = 10.0, 0.95
"""Rows are treated as copies only if equal rows are this many times as frequent as by chance, or have this share."""
ROW_READINGS, ROW_STEPS = 9, 4
"""Number of values of a row after the joint values, and number of rounding steps of a row."""
MAX_NAMED = 5
"""Largest number of rows that a sentence lists."""
_CHUNK = 1 << 22


@dataclass(frozen=True)
class CopiedRow(UnusableRow):
    """A row that is left out because another row contains the same measurement.

    Attributes:
        place: file and line of the row.
        original: file and line of the row that is kept.
    """

    place: str = ""
    original: str = ""


@dataclass(frozen=True, eq=False)
class RowValues:
    """Values of rows to compare, and the steps to which they were rounded.

    Attributes:
        numbers: values of the controller's axes [rad or m]; the measured length in up to three coordinates [SI]; and
            the first two columns of the measured rotation. NaN where nothing was measured.
        rounding_steps: rounding steps of revolute axes [rad], prismatic axes [m], length [m] and rotation [rad].
        step_index: for every column of `numbers`, its column of `rounding_steps`.
        file_index: index of the file from which a row comes.
    """

    numbers: Float64[Tensor, "rows numbers"]
    rounding_steps: Float64[Tensor, "rows 4"]
    step_index: Int64[Tensor, " numbers"]
    file_index: Int64[Tensor, " rows"]

    @staticmethod
    def from_rows(rows: MeasuredFields, robot: Robot) -> "RowValues":
        """Return the values of measured rows of a robot."""
        q = torch.from_numpy(robot.to_controller(rows.numbers["q"].detach().cpu().double().numpy()))
        length = _lengths(rows)
        rotation = (
            rows.numbers.get("rotation", torch.full((rows.rows, 3, 3), torch.nan)).detach().cpu().double()
        )
        revolute = torch.tensor([axis.type == "revolute" for axis in robot.axes])
        axes = _steps(q[:, revolute], _ANGLE_STEPS), _steps(q[:, ~revolute], _LENGTH_STEPS)
        angle = _steps(zyx_from_rotation(rotation), _ANGLE_STEPS, _ROTATION_STEP)
        steps = torch.stack([*axes, _steps(length, _LENGTH_STEPS), angle], 1)
        if "corner" in READINGS:
            steps[rows.is_measured("corner").cpu(), 2:] = _IMAGE_STEP
        numbers = torch.cat([q, length, rotation[:, :, :2].flatten(1)], 1)
        file = numbers_of_names(rows.origin or (rows.source,) * rows.rows)
        return RowValues(numbers, steps, _kinds(robot), file)

    @staticmethod
    def from_stored_numbers(
        numbers: Float64[Tensor, "rows numbers"], rounding_steps: Float64[Tensor, "rows 4"], robot: Robot
    ) -> "RowValues":
        """Return values of rows of one file from stored numbers and steps."""
        return RowValues(numbers, rounding_steps, _kinds(robot), torch.zeros(len(numbers), dtype=torch.int64))

    def select(self, rows: Tensor) -> "RowValues":
        """Return the rows that an index selects."""
        return RowValues(
            self.numbers[rows], self.rounding_steps[rows], self.step_index, self.file_index[rows]
        )

    def __add__(self, other: "RowValues") -> "RowValues":
        """Return the rows followed by rows of other files."""
        return RowValues(
            torch.cat([self.numbers, other.numbers]),
            torch.cat([self.rounding_steps, other.rounding_steps]),
            self.step_index,
            torch.cat([self.file_index, other.file_index + len(self.file_index)]),
        )

    @property
    def number_rounding_steps(self) -> Float64[Tensor, "rows numbers"]:
        """Rounding step of every number; the entries of a rotation depend on the steps of all three angles together."""
        return (self.rounding_steps * torch.tensor([1, 1, 1, 3**0.5]))[:, self.step_index]

    @property
    def q(self) -> Float64[Tensor, "rows dof"]:
        """Values of the controller's axes [rad or m]."""
        return self.numbers[:, :-ROW_READINGS]

    @property
    def length_coordinates(self) -> Float64[Tensor, "rows 3"]:
        """Measured length in up to three coordinates [SI units]."""
        return self.numbers[:, -ROW_READINGS:-6]


def _kinds(robot: Robot) -> Int64[Tensor, " numbers"]:
    """Return the column of the rounding steps for every number of a row."""
    return torch.tensor([0 if axis.type == "revolute" else 1 for axis in robot.axes] + 3 * [2] + 6 * [3])


def _lengths(rows: MeasuredFields) -> Float64[Tensor, "rows 3"]:
    """Return the measured length of every row, or the reading of a registered sensor in rows without one."""
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
    """Return the rounding step of every row: the coarsest step of which all values are multiples.

    Args:
        values: the values; NaN is a multiple of any step.
        steps: the steps, coarsest first.
        otherwise: result for values that are multiples of no step; 0 for the finest step.
    """
    found = torch.full((len(values),), otherwise or steps[-1], dtype=torch.float64)
    for step in reversed(steps):
        deviation = (values / step - (values / step).round()).abs().nan_to_num(nan=0.0)
        found = torch.where((deviation <= _GRID_TOLERANCE).all(1), step, found)
    return found


def original_rows(values: RowValues, known_row_count: int = 0) -> Int64[Tensor, " rows"]:
    """Return, for every row, the index of the row of which it is a copy; the row's own index if it is not a copy.

    A copy has the joint values and all readings of another row up to the coarser of both roundings. How many rows
    agree by chance depends on the repeatability of the robot: equal rows are copies if chance explains them with a
    probability of less than 1e-4.

    Args:
        values: values of all rows.
        known_row_count: if nonzero, only copies of the first `known_row_count` rows are searched for.
    """
    count = len(values.numbers)
    own = torch.arange(count)
    # known rows rank first, then those with the finest rounding, then those that come first in the file
    keys = (own.numpy(), *values.rounding_steps.T[:3].numpy(), (own >= known_row_count).numpy())
    order = torch.from_numpy(np.lexsort(keys))
    rank = order.argsort()
    first, second = _equal_pairs(values)
    if known_row_count:
        between = (first < known_row_count) & (second >= known_row_count)
        first, second = first[between], second[between]
    swapped = rank[first] > rank[second]
    better, worse = torch.where(swapped, second, first), torch.where(swapped, first, second)
    same_joints = _SameJoints.from_values(values)
    standing = same_joints.run[better] == same_joints.run[worse]
    best = rank.clone()
    # consecutive rows at a pose repeat better than returns to it, so their probabilities of equal readings differ
    for scope, deviation in ((standing, _STANDING), (~standing, _RETURNING)):
        equal = torch.zeros(count, dtype=torch.bool)
        equal[worse[scope]] = True
        partners = same_joints.count_partners(rank, known_row_count, scope is standing)
        chance = same_joints.repeat_probability(values, deviation)
        if _are_copies(equal, partners, chance):
            best.scatter_reduce_(0, worse[scope], rank[better[scope]], "amin")
    return order[best]


def _are_copies(
    equal: Bool[Tensor, " rows"], partners: Int64[Tensor, " rows"], chance: Float64[Tensor, " rows"]
) -> bool:
    """Return whether more rows are equal than by chance (Chernoff's bound for independent trials).

    Args:
        equal: mask of the rows that equal another row.
        partners: number of rows at the same joint values, to which a row might be equal.
        chance: probability that a row equals one of its partners.
    """
    tried = equal | (partners > 0)
    found, count = int(equal.sum()), int(tried.sum())
    if not found:
        return False
    once = chance[tried].clamp(max=1 - 1e-12)
    expected = float(-torch.expm1(partners[tried].clamp(min=1) * torch.log1p(-once)).sum())
    share, usual = found / count, expected / count
    if not (found >= _MIN_EXCESS * expected or share >= max(_MIN_SHARE, usual)):
        return False
    # the exponent of Chernoff's bound: Kullback-Leibler divergence of the observed from the expected share
    different = 0.0 if share == 1 else (1 - share) * math.log((1 - share) / (1 - usual))
    return count * (share * math.log(share / max(usual, 1e-300)) + different) >= _MIN_EVIDENCE


@dataclass(frozen=True, eq=False)
class _SameJoints:
    """Groups of rows at the same joint values.

    Attributes:
        group: index of the group of equal joint values, for every row.
        run: index of the sequence of consecutive rows at the same joint values, for every row.
    """

    group: Int64[Tensor, " rows"]
    run: Int64[Tensor, " rows"]

    @staticmethod
    def from_values(values: RowValues) -> "_SameJoints":
        coarsest = values.number_rounding_steps[:, : values.q.shape[1]].amax(0)
        group = torch.unique((values.q / coarsest).round() + 0.0, dim=0, return_inverse=True)[1]
        continues = (group[1:] == group[:-1]) & (values.file_index[1:] == values.file_index[:-1])
        run = torch.cat([torch.zeros(min(len(group), 1), dtype=torch.int64), (~continues).cumsum(0)])
        return _SameJoints(group, run)

    def count_partners(
        self, rank: Int64[Tensor, " rows"], known: int, standing: bool
    ) -> Int64[Tensor, " rows"]:
        """Return the number of rows that each row might equal, in its run if `standing`, otherwise in other runs."""
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

    def repeat_probability(self, values: RowValues, deviation: float) -> Float64[Tensor, " rows"]:
        """Return the probability that a repeated measurement gives the same reading.

        The rounding is the coarsest one among the rows with the same joint values. Rows without a reading, such as
        rows at sockets, are compared by their joint values.
        """
        columns = values.rounding_steps.unbind(1)
        steps = torch.stack(
            [one.scatter_reduce(0, self.group, one, "amax")[self.group] for one in columns], 1
        )
        logarithms = _chance_of_equal(steps, deviation * 2**0.5).log()
        axes = logarithms[:, values.step_index[: values.q.shape[1]]].sum(1)
        length, angle = logarithms[:, 2], logarithms[:, 3]
        lengths, has_rotation = values.length_coordinates.isfinite().sum(1), values.numbers[:, -1].isfinite()
        read = lengths * length + torch.where(has_rotation, 3 * angle, 0.0)
        return torch.where((lengths > 0) | has_rotation, read, axes).exp()


def _chance_of_equal(step: Float64[Tensor, "*shape"], deviation: float) -> Float64[Tensor, "*shape"]:
    """Return the probability that two values round to the same multiple of a step.

    `deviation` is the standard deviation of their difference.
    """
    x = step / deviation
    within = torch.erf(x / 2**0.5)
    chance: Tensor = within + (2 / math.pi) ** 0.5 / x * torch.expm1(-x.square() / 2)
    return chance.clamp(min=1e-30)


def _equal_pairs(values: RowValues) -> tuple[Int64[Tensor, " pairs"], Int64[Tensor, " pairs"]]:
    """Return the pairs of rows (lower index first) whose numbers agree to within the coarser of both roundings.

    Rows are sorted by a weighted sum of their numbers, so that only neighbours need to be compared.
    """
    numbers, steps = values.numbers, values.number_rounding_steps
    scale = steps.amax(0)
    # weights without simple ratios
    weight = torch.arange(2.0, 2 + numbers.shape[1]).double().sqrt() % 1 + 0.5
    key, order = ((numbers / scale).nan_to_num(nan=0.0) @ weight).sort()
    last = torch.searchsorted(key, key + 1.1 * float(weight.sum()), right=True)
    ahead = last - torch.arange(len(key)) - 1
    found = [torch.zeros(2, 0, dtype=torch.int64)]
    for start, end in _chunks(ahead):
        own = torch.repeat_interleave(torch.arange(start, end), ahead[start:end])
        offset = torch.arange(len(own)) - torch.repeat_interleave(
            ahead[start:end].cumsum(0) - ahead[start:end], ahead[start:end]
        )
        pair = torch.stack([order[own], order[own + 1 + offset]])
        for column in range(numbers.shape[1]):
            pair = pair[:, _agree(numbers[:, column][pair], steps[:, column][pair])]
        found.append(pair)
    pairs = torch.cat(found, 1)
    return pairs.amin(0), pairs.amax(0)


def _agree(values: Float64[Tensor, "2 pairs"], steps: Float64[Tensor, "2 pairs"]) -> Bool[Tensor, " pairs"]:
    """Return whether two values may be roundings of one value, to the same step or to two different steps."""
    fine, coarse = steps.amin(0), steps.amax(0)
    largest = torch.where(coarse - fine > _GRID_TOLERANCE * coarse, coarse + fine, coarse) * (
        0.5 + _GRID_TOLERANCE
    )
    return ((values[0] - values[1]).abs() <= largest) | values.isnan().all(0)


def _chunks(ahead: Int64[Tensor, " rows"]) -> list[tuple[int, int]]:
    """Yield ranges of rows that have few enough neighbours to fit into memory."""
    part = (ahead.cumsum(0) // _CHUNK).numpy()
    borders = [0, *(np.flatnonzero(np.diff(part)) + 1).tolist(), len(part)]
    return list(itertools.pairwise(borders))


def _whole_pairs(rows: MeasuredFields, copied: Bool[Tensor, " rows"]) -> Bool[Tensor, " rows"]:
    """Return the mask of copies without the rows of pairs whose other row is not a copy."""
    pairs = numbers_of_names(list(zip(rows.origin or ("",) * rows.rows, rows.text("pair"), strict=True)))
    paired = torch.tensor([bool(name) for name in rows.text("pair")])
    half = torch.zeros(rows.rows, dtype=torch.bool)
    half[pairs[paired & ~copied]] = True
    return copied & ~(paired & half[pairs])


def copies_of_known(rows: MeasuredFields, robot: Robot, known_rows: RowValues) -> Bool[Tensor, " rows"]:
    """Return the mask of the rows that are copies of known rows, perhaps rounded differently or in another order."""
    if rows.rows == 0 or not len(known_rows.numbers) or rows.numbers["q"].shape[1] != robot.dof:
        return torch.zeros(rows.rows, dtype=torch.bool)
    count = len(known_rows.numbers)
    values = known_rows + RowValues.from_rows(rows, robot)
    original = original_rows(values, count)[count:]
    return _whole_pairs(rows, original != torch.arange(count, count + rows.rows))


def without_copies(rows: MeasuredFields, robot: Robot) -> MeasuredFields:
    """Return the rows without copies of other rows; the copy with the most digits is kept, see `CopiedRow`.

    The two rows of a pair are left out together.
    """
    if rows.rows < 2 or rows.numbers["q"].shape[1] != robot.dof:
        return rows
    original = original_rows(RowValues.from_rows(rows, robot))
    copied = _whole_pairs(rows, original != torch.arange(rows.rows))
    if not copied.any():
        return rows
    left_out = tuple(
        CopiedRow(
            rows.line[row],
            "the row is a copy of another",
            place=rows.place_text(row),
            original=rows.place_text(int(original[row])),
        )
        for row in copied.nonzero()[:, 0].tolist()
    )
    kept = rows.select((~copied).nonzero()[:, 0])
    return replace(kept, left_out=(*rows.left_out, *left_out))


def places_text(rows: MeasuredFields, selected: Bool[Tensor, " rows"]) -> str:
    """Return a text that lists files and lines of the chosen rows, at most `MAX_NAMED` of them."""
    numbers = selected.nonzero()[:, 0].tolist()
    named = ", ".join(rows.place_text(number) for number in numbers[:MAX_NAMED])
    return f"{named} and {len(numbers) - MAX_NAMED} more" if len(numbers) > MAX_NAMED else named


def copy_warnings(left_out: Sequence[UnusableRow]) -> tuple[str, ...]:
    """Return a warning about the rows that were left out as copies; empty if there are none."""
    copies = [one for one in left_out if isinstance(one, CopiedRow)]
    if not copies:
        return ()
    named = ", ".join(f"{one.place} (of {one.original})" for one in copies[:MAX_NAMED])
    more = f" and {len(copies) - MAX_NAMED} more" if len(copies) > MAX_NAMED else ""
    verb = "row is a copy of another" if len(copies) == 1 else "rows are copies of others"
    return (
        f"{len(copies)} {verb} (equal joint values and readings to the coarser rounding) and "
        f"{'is' if len(copies) == 1 else 'are'} left out: {named}{more}. Give every measurement once.",
    )
