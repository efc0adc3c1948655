"""Setup faults of targets: several reflectors under one name, or rows under the name of another one."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.identification.initial_guess.base_and_tool import fit_base_and_tool
from pisigma.kinematics.forward import forward_kinematics
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import numbers_of_names
from pisigma.robot.description import Robot
from pisigma.se3 import transform_from_xyzrpy
from pisigma.verification.cause import Cause, joined

MOST_TARGETS = 4
"""Targets that are looked for under one name."""
EXAMPLES = 3
"""Rows that are named, at most."""
ITERATIONS = 10
"""Of every fit of base and targets, at most."""
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


def better_labellings(robot: Robot, rows: Measurements) -> Iterator[Labelling]:
    """Find targets from the measurements alone: points of the tool that the measured positions cluster about.

    As k-means, but base and targets are fitted to all rows in every round (see `fit_base_and_tool`). With several
    names there are as many targets, and each keeps the name that most of its rows have; with one name there are 2,
    then 3, up to `MOST_TARGETS`.

    Args:
        robot: as drawn.
        rows: with positions, of one frame.
    """
    names = tuple(dict.fromkeys(rows.target))
    for count in range(2, MOST_TARGETS + 1) if len(names) == 1 else (len(names),):
        number, T = _clustered(robot, rows, count)
        cause = _one_name(rows, number) if len(names) == 1 else _other_names(rows, number, names)
        yield Labelling(cause, T, count)


def fitted_poses(robot: Robot, rows: Measurements) -> Float64[Tensor, "rows 4 4"]:
    """Predict the poses of targets with base and tools fitted under the names of the file."""
    return _fitted(robot, rows, numbers_of_names(rows.target))[1]


def _one_name(rows: Measurements, number: Int64[Tensor, " rows"]) -> Cause:
    used, sizes = torch.unique(number, return_counts=True)
    first = [_where(rows, int((number == k).nonzero()[0, 0])) for k in used]
    clause = f"the rows are of {len(used)} targets under one name ({joined(map(str, sizes.tolist()))} rows)"
    return Cause(
        "target", clause, f"name the targets in a column 'target'; they begin at {joined(first)}", 2.0
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
    robot: Robot, rows: Measurements, count: int
) -> tuple[Int64[Tensor, " rows"], Float64[Tensor, "rows 4 4"]]:
    """Cluster the points of the tool that were measured; returns their numbers and the predicted poses."""
    points, _ = _fitted(robot, rows, torch.zeros(rows.rows))
    centres = points.median(0).values[None]
    for _ in range(count):
        far = torch.cdist(points, centres).amin(1).topk(max(1, rows.rows // (4 * count))).indices
        centres = torch.cat([centres, points[far].median(0).values[None]])
    number = torch.cdist(points, centres[1:]).argmin(1)
    for _ in range(ROUNDS):
        points, T = _fitted(robot, rows, number)
        used, index = torch.unique(number, return_inverse=True)
        centres = torch.stack([points[index == k].median(0).values for k in range(len(used))])
        nearest = used[torch.cdist(points, centres).argmin(1)]
        if bool((nearest == number).all()):
            break
        number = nearest
    return number, T


def _fitted(
    robot: Robot, rows: Measurements, number: Tensor
) -> tuple[Float64[Tensor, "rows 3"], Float64[Tensor, "rows 4 4"]]:
    """Fit base and targets; returns where the measured points are behind the last row [m], and the predicted poses."""
    names = tuple(str(int(k)) for k in number)
    fit = fit_base_and_tool(robot, replace(rows, target=names), maximum_iterations=ITERATIONS)
    T = forward_kinematics(fit.robot.with_geometry(tool=np.zeros(6)), rows.q)
    assert rows.position is not None
    points = (T[:, :3, :3].mT @ (rows.position - T[:, :3, 3])[..., None])[..., 0]
    return points, T @ transform_from_xyzrpy(torch.from_numpy(np.stack([fit.tools[name] for name in names])))
