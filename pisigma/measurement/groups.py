"""Groups of rows that belong together: rows with equal joint values, of a pair, or of a placement."""

from collections.abc import Hashable, Sequence

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.files.errors import MeasurementError, Phrase, Place
from pisigma.measurement.dataset import Measurements

_MIN_GROUPS = 3
"""Smallest number of placements, sockets or anchors that are held out as wholes; with fewer, too few rows would
remain."""
_REPEATABILITY = 1e-3
"""Largest difference of joint values of one pose [rad or m]; values that encoders read differ from repeat to repeat."""


def groups_of_equal_joints(
    q: Float64[Tensor, "rows dof"], tolerance: float = _REPEATABILITY
) -> Int64[Tensor, " rows"]:
    """Return the index of every row's joint values among the distinct ones, numbered by their first row.

    Every group has a row that all its rows equal up to the tolerance, so rows along a path do not all belong together.

    Args:
        q: joint values [rad or m].
        tolerance: largest difference of joint values of one pose [rad or m]; 0 for exactly equal values.

    Returns:
        For every row, the index of its group, from 0.
    """
    if q.shape[0] == 0:
        return torch.zeros(0, dtype=torch.int64, device=q.device)
    distinct, number = torch.unique(q + 0.0, dim=0, return_inverse=True)  # -0.0 becomes 0.0
    if tolerance > 0 and len(distinct) > 1:
        number = _nearby(distinct.detach().cpu().numpy(), tolerance).to(q.device)[number]
    return _numbered(number)


def _nearby(values: Float64[np.ndarray, "rows columns"], tolerance: float) -> Int64[Tensor, " rows"]:
    """Return, for every row, the index of the first row without an earlier equal one that it equals."""
    from scipy.spatial import KDTree  # imported here, because models are loaded without scipy

    tree = KDTree(values)
    representative = np.arange(len(values))
    distance, _ = tree.query(values, k=2, p=np.inf, distance_upper_bound=tolerance)
    for row in np.flatnonzero(np.isfinite(distance[:, 1])):
        if representative[row] == row:
            near = np.array(tree.query_ball_point(values[row], tolerance, p=np.inf))
            representative[near[(near > row) & (representative[near] == near)]] = row
    return torch.from_numpy(representative)


def numbers_of_names(names: Sequence[Hashable]) -> Int64[Tensor, " rows"]:
    """Return the index of every row's name among the distinct names, numbered by their first row.

    Returns:
        For every row, the index of its name, from 0.
    """
    index = {name: number for number, name in enumerate(dict.fromkeys(names))}
    return torch.tensor([index[name] for name in names], dtype=torch.int64)


def groups_to_keep_whole(measurements: Measurements) -> Int64[Tensor, " rows"]:
    """Return the index of the group that a split must keep together, for every row.

    Rows with equal joint values belong together, as do the two rows of a pair and all rows that belong to either of
    them.

    Args:
        measurements: the rows.

    Returns:
        For every row, the index of its group, from 0.
    """
    group = groups_of_equal_joints(measurements.q)
    return group if measurements.pair is None else _joined(group, measurements.pair)


def held_out_groups(measurements: Measurements) -> Int64[Tensor, " rows"]:
    """Return the index of the group that is held out together for model selection, for every row.

    Rows of one socket or anchor share its unknown position, so they predict each other better than they predict other
    rows; the same holds for the sockets of one placement. Groups are therefore whole placements if there are at least
    `_MIN_GROUPS`, or else whole sockets and anchors, or else the groups of `groups_to_keep_whole`.

    Returns:
        For every row, the index of its group, from 0.
    """
    whole = groups_to_keep_whole(measurements)
    owners = [
        measurements.socket or ("",) * measurements.rows,
        measurements.anchor or ("",) * measurements.rows,
    ]
    placed = [name.rpartition("/")[0] or name for name in owners[0]]
    for names in ([placed, owners[1]], owners):
        group = whole
        for column in names:
            group = _joined(group, column)
        named = torch.tensor(
            [bool(one or other) for one, other in zip(*names, strict=True)], dtype=torch.bool
        )
        if len(torch.unique(group[named])) >= _MIN_GROUPS:
            return group
    return whole


def placements(measurements: Measurements) -> tuple[str, ...]:
    """Return the name of every row's placement: the position of the touched object or of the sensor.

    Sockets "plate/0" and "plate/1" belong to the placement "plate"; a socket without "/" is a placement by itself.
    Without sockets, every frame is a placement.

    Returns:
        A name per row; "" in rows without a socket if other rows have a socket.

    Raises:
        MeasurementError: there are fewer than two placements.
    """
    names = measurements.frame
    if measurements.socket is not None:
        names = tuple(name.rpartition("/")[0] or name for name in measurements.socket)
    placed = list(dict.fromkeys(name for name in names if name))
    if len(placed) < 2:
        raise MeasurementError(
            expected="two or more placements",
            value=Phrase(placed[0] if placed else "no names of sockets or frames"),
            at=Place(measurements.source),
            remedy="name sockets by placement, such as low/0 and low/1, or frames, or split by joints, time or space",
        )
    return names


def placement_groups(measurements: Measurements) -> Int64[Tensor, " rows"]:
    """Return the index of every row's placement, numbered by their first row; -1 in rows without a placement.

    Placements that share joint values or a pair of rows are one group.

    Raises:
        MeasurementError: there are fewer than two placements.
    """
    names = placements(measurements)
    group = _joined(groups_to_keep_whole(measurements), names)
    named = torch.tensor([bool(name) for name in names], device=group.device)
    placed = torch.isin(group, group[named])
    group[placed] = _numbered(group[placed])
    return torch.where(placed, group, -1)


def _joined(group: Int64[Tensor, " rows"], names: Sequence[str]) -> Int64[Tensor, " rows"]:
    """Merge the groups of rows that have the same name."""
    numbers = group.tolist()
    leader = list(range(max(numbers, default=0) + 1))

    def lead(number: int) -> int:
        while leader[number] != number:
            leader[number] = leader[leader[number]]
            number = leader[number]
        return number

    first: dict[str, int] = {}
    for row, name in enumerate(names):
        if name:
            leader[lead(numbers[row])] = lead(numbers[first.setdefault(name, row)])
    return _numbered(
        torch.tensor([lead(number) for number in numbers], dtype=torch.int64, device=group.device)
    )


def _numbered(label: Int64[Tensor, " rows"]) -> Int64[Tensor, " rows"]:
    """Return labels replaced by indices from 0, in the order in which they first appear."""
    values, group = torch.unique(label, return_inverse=True)
    rows = torch.arange(len(label), device=label.device)
    first = torch.full((len(values),), len(label), device=label.device).scatter_reduce(0, group, rows, "amin")
    return first.argsort().argsort()[group]
