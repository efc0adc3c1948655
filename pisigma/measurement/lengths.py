"""Which length was measured in a row, and whether rows fit together: the rules for all of it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float64

from pisigma.measurement.readings import RowFault

AXES = ("x", "y", "z")
"""Names of the axes of a frame, as a touch gives them."""


@dataclass(frozen=True, eq=False)
class LengthCells:
    """What rows say of lengths, in any unit; "" and NaN where they say nothing.

    Attributes:
        labels: what complaints call a quantity; one that is not here is called a column.
        frame: per row, the frame.
        socket: per row, the socket that the ball sits in.
        touch_axis: per row, the axis along which the tip touched.
        anchor: per row, the anchor of a distance.
        pair: per row, the pair of a distance.
        position: whether a position was measured.
        touch: coordinate at which the tip touched.
        distance: distance from the anchor, or between the tool points of a pair.
        anchor_place: where the anchor stands.
        sigma: standard deviation of the length.
        others: by registered sensor that measures a length, the rows that have one.
    """

    labels: Mapping[str, str]
    frame: Sequence[str]
    socket: Sequence[str]
    touch_axis: Sequence[str]
    anchor: Sequence[str]
    pair: Sequence[str]
    position: Bool[np.ndarray, " rows"]
    touch: Float64[np.ndarray, " rows"]
    distance: Float64[np.ndarray, " rows"]
    anchor_place: Float64[np.ndarray, "rows 3"]
    sigma: Float64[np.ndarray, " rows"]
    others: Mapping[str, Bool[np.ndarray, " rows"]] = field(default_factory=dict)

    def label(self, quantity: str) -> str:
        """What complaints call a quantity."""
        return self.labels.get(quantity, f"column '{quantity}'")

    def measured(self) -> dict[str, Bool[np.ndarray, " rows"]]:
        """For every quantity that is a length, the rows that have one."""
        return {
            "position": self.position,
            "socket": _named(self.socket),
            "touch": ~np.isnan(self.touch),
            "distance": ~np.isnan(self.distance),
            **self.others,
        }


def _named(names: Sequence[str]) -> Bool[np.ndarray, " rows"]:
    return np.array([bool(name) for name in names], dtype=bool)


def row_faults(cells: LengthCells) -> Iterator[RowFault]:
    """Find the rows that contradict themselves.

    A row holds one length: a position, a coordinate that was touched, a socket, or a distance. What a second
    sensor saw at the same joint values is a second row.

    Yields:
        Rows at fault, and a function that says what is wrong with one of them and what to do.
    """
    measured = cells.measured()
    yield from _touch_faults(cells, measured["touch"])
    yield from _distance_faults(cells, measured["distance"])
    several = np.sum(list(measured.values()), axis=0) > 1

    def describe(row: int) -> str:
        names = " and ".join(cells.label(name) for name, there in measured.items() if there[row])
        return (
            f"{names}: a row holds one measured length; put each in a row of its own, with equal joint values"
        )

    yield several, describe


def _touch_faults(cells: LengthCells, touch: Bool[np.ndarray, " rows"]) -> Iterator[RowFault]:
    axis = _named(cells.touch_axis)
    label, value = cells.label("touch_axis"), cells.label("touch")
    yield (
        np.array([name not in ("", *AXES) for name in cells.touch_axis], dtype=bool),
        lambda row: f"{label}: '{cells.touch_axis[row]}' is no axis; write x, y or z",
    )
    yield touch & ~axis, lambda row: f"{label}: the touch has no axis; write x, y or z"
    yield (
        axis & ~touch,
        lambda row: (
            f"{value}: the touch along {cells.touch_axis[row]} has no coordinate; "
            "give it, or remove the "
            "axis too"
        ),
    )
    yield (
        touch & ~_named(cells.frame),
        lambda row: (
            f"{cells.label('frame')}: the touch names no frame; write which placement of the "
            "jig was touched, "
            "such as left"
        ),
    )


def _distance_faults(cells: LengthCells, distance: Bool[np.ndarray, " rows"]) -> Iterator[RowFault]:
    anchor, pair = _named(cells.anchor), _named(cells.pair)
    label, names = cells.label("distance"), (cells.label("anchor"), cells.label("pair"))
    yield (
        cells.distance < 0,
        lambda row: f"{label}: {cells.distance[row]:.6g} stands where 0 or more was wanted; correct it",
    )
    yield (
        distance & ~anchor & ~pair,
        lambda row: (
            f"{names[0]}: the distance is from nowhere; name its anchor, or the pair of rows it lies between"
        ),
    )
    yield (
        anchor & pair,
        lambda row: (
            f"{names[0]} and {names[1]}: a distance is from an anchor or within a pair; keep one of them"
        ),
    )
    yield (
        (anchor | pair) & ~distance,
        lambda row: f"{label}: the distance is missing for '{cells.anchor[row] or cells.pair[row]}'; give it",
    )
    missing = np.isnan(cells.anchor_place)
    yield (
        np.asarray(missing.any(1) & ~missing.all(1)),
        lambda row: (
            f"{cells.label('anchor_place')}: is there in part; give x, y and z of the anchor or none of them"
        ),
    )
    yield (
        np.asarray(~missing.all(1) & ~anchor),
        lambda row: f"{names[0]}: the place of an anchor is stated without its name; name the anchor",
    )


def group_faults(
    cells: LengthCells, sound: Bool[np.ndarray, " rows"], place: Callable[[int], str]
) -> Iterator[RowFault]:
    """Find the rows that contradict other rows of the same pair, anchor or socket.

    Args:
        cells: what the rows say.
        sound: rows that are not at fault themselves.
        place: what complaints call a row.

    Yields:
        Rows at fault, and a function that says what is wrong with one of them and what to do.
    """
    for name, rows in _groups(cells.pair).items():
        yield _fault(cells, rows, _pair_problem(cells, name, rows, sound, place))
    for kind, names in (("anchor", cells.anchor), ("socket", cells.socket)):
        for name, rows in _groups(names).items():
            frames = sorted({cells.frame[row] for row in rows})
            if len(frames) > 1:
                yield _fault(
                    cells,
                    rows,
                    f"{cells.label('frame')}: {kind} '{name}' is in the frames '{frames[0]}' and "
                    f"'{frames[1]}', but "
                    "its place is one point of one frame; use another name in each frame",
                )
    for name, rows in _groups(cells.anchor).items():
        places = np.where(
            np.isnan(cells.anchor_place[rows]), np.inf, cells.anchor_place[rows]
        )  # NaN equals NaN
        if (places != places[0]).any():
            yield _fault(
                cells,
                rows,
                f"{cells.label('anchor_place')}: anchor '{name}' has not the same place in all "
                "its rows; give one "
                "place in all of them or in none, or name the anchors apart",
            )


def _groups(names: Sequence[str]) -> dict[str, list[int]]:
    """The rows of every name, in their order."""
    rows: dict[str, list[int]] = {}
    for row, name in enumerate(names):
        if name:
            rows.setdefault(name, []).append(row)
    return rows


def _fault(cells: LengthCells, rows: list[int], problem: str) -> RowFault:
    bad = np.zeros(len(cells.frame), dtype=bool)
    bad[rows] = bool(problem)
    return bad, lambda row: problem


def _pair_problem(
    cells: LengthCells,
    name: str,
    rows: list[int],
    sound: Bool[np.ndarray, " rows"],
    place: Callable[[int], str],
) -> str:
    """What is wrong with a pair, "" where nothing is."""
    label = f"{cells.label('pair')}: pair '{name}'"
    if len(rows) != 2:
        count = f"{len(rows)} row" + ("s" if len(rows) > 1 else "")
        return f"{label} has {count} where two were wanted; give the two poses that the distance lies between"
    first, second = rows
    for row in rows:
        if not sound[row]:
            return f"{label} lacks a row, as {place(row)} cannot be used; correct that one"
    if cells.frame[first] != cells.frame[second]:
        return (
            f"{label} is in the frames '{cells.frame[first]}' and '{cells.frame[second]}'; measure it in one"
        )
    for quantity in ("distance", "sigma"):
        a, b = getattr(cells, quantity)[rows].tolist()
        if a != b and not (np.isnan(a) and np.isnan(b)):
            return (
                f"{label} has {a:.6g} and {b:.6g} as {cells.label(quantity)}, but it was measured "
                "once; give the "
                "same in both rows"
            )
    return ""
