"""Setup faults of targets: several reflectors under one name, or rows under the name of another one."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import numbers_of_names
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.validation.held_out.frames.frame_fits import MeasuredPoses, best_base_and_tool
from pisigma.validation.setup_faults.cause import Cause, joined

MOST_TARGETS = 4
"""Targets that are looked for under one name."""
EXAMPLES = 3
"""Rows that are named, at most."""
TURNS = 20
"""Turns of fitting base and targets, at most."""
SETTLED = 1e-2
"""They end where a turn lowers the mean square by less than this share."""
ROUNDS = 8
"""Rounds of naming every row after the nearest target and fitting base and targets anew, at most."""


@dataclass(frozen=True, eq=False)
class Labelling:
    """Rows named after the targets that they fit.

    Attributes:
        cause: what is wrong with the names of the file.
        T: predicted poses of the targets, base and tools being fitted under the better names.
        targets: number of targets.
    """

    cause: Cause
    T: Float64[Tensor, "rows 4 4"]
    targets: int


def better_labellings(robot: Robot, rows: Measurements, measured: MeasuredPoses) -> Iterator[Labelling]:
    """Find targets from the measurements alone: points of the tool that the measured positions cluster about.

    As k-means, but base and targets are fitted to all rows in every round. With several names there are as many
    targets, and each keeps the name that most of its rows have; with one name there are 2, then 3, up to
    `MOST_TARGETS`.

    Args:
        robot: as drawn.
        rows: with positions, of one frame.
        measured: their poses.
    """
    names = tuple(dict.fromkeys(rows.target))
    T = forward_kinematics(robot, rows.q)
    for count in range(2, MOST_TARGETS + 1) if len(names) == 1 else (len(names),):
        number, poses = _clustered(T, measured, count)
        cause = _one_name(rows, number) if len(names) == 1 else _other_names(rows, number, names)
        yield Labelling(cause, poses, count)


def fit_targets(
    T: Float64[Tensor, "rows 4 4"], measured: MeasuredPoses, number: Int64[Tensor, " rows"]
) -> tuple[Float64[Tensor, "4 4"], Float64[Tensor, "rows 4 4"]]:
    """Fit base and targets to measured poses by turns: base and the targets' mean, then every target's place.

    Args:
        T: predicted poses, with any base and tool.
        measured: what was measured there.
        number: of every row's target, 0 and up.

    Returns:
        The base, and the poses that are predicted with it.
    """
    places = torch.zeros(int(number.max()) + 1, 3).to(T)
    last = math.inf
    for _ in range(TURNS):
        of_rows = T.clone()
        of_rows[:, :3, 3] += (T[:, :3, :3] @ places[number][..., None])[..., 0]
        base, tool = best_base_and_tool(of_rows, measured)
        fitted = base @ of_rows @ tool
        error = float(measured.squares(fitted).mean())
        if error > (1 - SETTLED) * last:
            break
        last = error
        points = _behind(base @ T, measured)
        places = torch.stack([points[number == k].mean(0) for k in range(len(places))])
    return base, fitted


def _behind(T: Float64[Tensor, "rows 4 4"], measured: MeasuredPoses) -> Float64[Tensor, "rows 3"]:
    """Give measured positions as predicted poses see them [m]."""
    return (T[:, :3, :3].mT @ (measured.position - T[:, :3, 3])[..., None])[..., 0]


def _one_name(rows: Measurements, number: Int64[Tensor, " rows"]) -> Cause:
    used, sizes = torch.unique(number, return_counts=True)
    first = [_where(rows, int((number == k).nonzero()[0, 0])) for k in used]
    shares = joined(f"{100 * size / len(number):.0f} %" for size in sizes.tolist())
    clause = (
        f"the targets look mixed up: the rows are of {len(used)} targets under one name ({shares} of them)"
    )
    return Cause(
        "target",
        clause,
        f"name the targets in a column 'target'; they begin in {joined(first)}",
        float(len(used)),
    )


def _other_names(rows: Measurements, number: Int64[Tensor, " rows"], names: tuple[str, ...]) -> Cause:
    shared = torch.zeros(int(number.max()) + 1, len(names))
    shared.index_put_((number, numbers_of_names(rows.target)), torch.tensor(1.0), accumulate=True)
    better = [names[k] for k in shared.argmax(1)[number].tolist()]
    wrong = [row for row, (name, other) in enumerate(zip(rows.target, better, strict=True)) if name != other]
    examples = [
        f"{_where(rows, row)} fits '{better[row]}' instead of '{rows.target[row]}'"
        for row in wrong[:EXAMPLES]
    ]
    clause = f"the targets look mixed up: {len(wrong)} of {rows.rows} rows fit another target than the one they name"
    return Cause("target", clause, f"check the column 'target': {joined(examples)}", 2.0)


def _where(rows: Measurements, row: int) -> str:
    """Name a row in short: the file stands before it."""
    return f"line {rows.line[row]}" if rows.line[row] else f"row {row}"


def _clustered(
    T: Float64[Tensor, "rows 4 4"], measured: MeasuredPoses, count: int
) -> tuple[Int64[Tensor, " rows"], Float64[Tensor, "rows 4 4"]]:
    """Cluster the points of the tool that were measured; returns their numbers and the predicted poses."""
    number = torch.zeros(len(T), dtype=torch.int64)
    base, tool = best_base_and_tool(T, measured)
    points, fitted = _behind(base @ T, measured), base @ T @ tool
    centres = points.median(0).values[None]
    for _ in range(count):
        far = torch.cdist(points, centres).amin(1).topk(max(1, len(T) // (4 * count))).indices
        centres = torch.cat([centres, points[far].median(0).values[None]])
    centres = centres[1:]
    for _ in range(ROUNDS):
        nearest = torch.cdist(points, centres).argmin(1)
        if bool((nearest == number).all()):
            break
        number = torch.unique(nearest, return_inverse=True)[1]
        base, fitted = fit_targets(T, measured, number)
        points = _behind(base @ T, measured)
        centres = torch.stack([points[number == k].median(0).values for k in range(int(number.max()) + 1)])
    return number, fitted
