"""The rules that rows of measurements follow, alone and together, in files and in memory."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from pisigma.files.errors import MeasurementError, nearest_choice
from pisigma.measurement.dates import WANTED, is_date
from pisigma.measurement.fields import NUMBERS, TEXTS, MeasuredFields
from pisigma.measurement.readings import READINGS, Unit, from_si, reading_numbers, reading_texts

AXES = ("x", "y", "z")
"""Names of the axes of a frame, as a touch gives them."""
SPLITS = ("train", "test")
SMALLEST_SIGMA = 1e-12
"""[m or rad] Nothing is measured more exactly."""
PAYLOADS = (0.0, 2500.0)
"""[kg] The strongest arms that are sold lift 2,300 kg."""
TEMPERATURES = (-50.0, 150.0)
"""[deg C] Outside these no robot works; 293 is a room in kelvins, and -400 lies below absolute zero."""

_PARTIAL = ("anchor_place", "approach")  # a row may have some of their values without the others
_ROTATION_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Labels:
    """How complaints call fields and show their values.

    Attributes:
        form: of the name of a field that is not in `names`.
        names: by field or sensor, what it is called.
        units: by field, the unit that its values are shown in; SI where none is here.
    """

    form: str = "'{}'"
    names: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, Unit] = field(default_factory=dict)

    def __call__(self, name: str) -> str:
        """Call a field or a sensor."""
        return self.names.get(name, self.form.format(name))

    def shown(self, name: str, value: float) -> str:
        """Show an SI value of a field."""
        return f"{float(from_si(np.array([value]), self.units.get(name, ''))[0]):.6g}"


def check_fields(data: MeasuredFields) -> None:
    """Refuse fields that do not fit together.

    Raises:
        MeasurementError: a shape, type or value is wrong, or rows contradict themselves or each other; the message
            names the row.
    """
    _check_shapes(data)
    _refuse(data, ~torch.isfinite(data.numbers["q"]).all(-1), "q", "is not finite; give every joint value")
    for name in data.numbers:
        if name != "q":
            _check_values(data, name)
    _check_rotations(data)
    sound = np.ones(data.rows, dtype=bool)
    for faults in (row_faults(data, Labels()), group_faults(data, Labels(), sound, data.label)):
        for row, what in faults:
            raise MeasurementError(f"{data.label(row)}: {what}.")


def _check_shapes(data: MeasuredFields) -> None:
    """One row per measurement, float64, on one device."""
    source, q = data.source, data.numbers["q"]
    sizes = {"q": (-1,), **NUMBERS, **dict.fromkeys(reading_numbers(), ())}
    for name, values in data.numbers.items():
        if name not in sizes:
            raise MeasurementError(
                f"{source}: no sensor has readings called '{name}'; {nearest_choice(name, reading_numbers())}"
            )
        shape = (len(q), *(q.shape[1] if size < 0 else size for size in sizes[name]))
        if tuple(values.shape) != shape:
            raise MeasurementError(
                f"{source}: '{name}' of shape {shape} was wanted for {len(q)} rows, got {tuple(values.shape)}."
            )
        if values.dtype != torch.float64:
            raise MeasurementError(
                f"{source}: '{name}' in float64 was wanted, got {values.dtype}; convert it."
            )
        if values.device != q.device:
            raise MeasurementError(
                f"{source}: '{name}' is on {values.device}, but q is on {q.device}; move it there."
            )
    for name, entries in {**data.texts, "line": data.line}.items():
        if name not in (*TEXTS, "line", *reading_texts()):
            raise MeasurementError(
                f"{source}: no sensor has names called '{name}'; {nearest_choice(name, reading_texts())}"
            )
        if len(entries) != len(q):
            raise MeasurementError(f"{source}: '{name}' has {len(entries)} entries for {len(q)} rows.")


def _check_values(data: MeasuredFields, name: str) -> None:
    """What is not NaN is finite; a position or a rotation is there whole or not at all."""
    values = data.numbers[name]
    flat = values.reshape(len(values), math.prod(values.shape[1:]))
    missing = torch.isnan(flat)
    _refuse(data, torch.isinf(flat).any(-1), name, "is infinite; give NaN where nothing was measured")
    if name not in _PARTIAL:
        _refuse(data, missing.any(-1) & ~missing.all(-1), name, "is NaN in part; give all of it or none")


def _check_rotations(data: MeasuredFields) -> None:
    """Rotations are orthonormal and right-handed."""
    R = data.numbers.get("rotation")
    if R is None:
        return
    deviation = (R.mT @ R - torch.eye(3, dtype=R.dtype, device=R.device)).abs().amax((-1, -2))
    left_handed = (torch.linalg.cross(R[..., 0], R[..., 1]) * R[..., 2]).sum(-1) < 0
    _refuse(data, deviation > _ROTATION_TOLERANCE, "rotation", "is not orthonormal; normalise it")
    _refuse(data, left_handed, "rotation", "is left-handed; a reflection is no rotation, check its axes")


def _refuse(data: MeasuredFields, bad: Bool[Tensor, " rows"], name: str, what: str) -> None:
    """Raise for the first bad row, if there is one."""
    if bad.any():
        row = int(bad.nonzero()[0])
        raise MeasurementError(f"{data.label(row)}: {name} {data.numbers[name][row].tolist()} {what}.")


Fault = tuple[int, str]
"""A row at fault, and what is wrong with it and what to do."""


def row_faults(data: MeasuredFields, labels: Labels) -> Iterator[Fault]:
    """Find the rows that cannot be, or contradict themselves.

    A row holds one length: a position, a coordinate that was touched, a socket, or a distance. What a second
    sensor measured at the same joint values is a second row. A row may be found several times.
    """
    yield from _value_faults(data, labels)
    yield from _reading_faults(data, labels)
    lengths = {
        "position": (data.measured("position") | data.measured("pose")).cpu().numpy(),
        "socket": _named(data.text("socket")),
        "touch": ~np.isnan(data.array("touch")),
        "distance": ~np.isnan(data.array("distance")),
        **{name: data.measured(name).cpu().numpy() for name, one in READINGS.items() if one.is_length},
    }
    if {"touch", "touch_axis"} & {*data.numbers, *data.texts}:
        yield from _touch_faults(data, labels, lengths["touch"])
    if {"distance", "anchor", "anchor_place", "pair"} & {*data.numbers, *data.texts}:
        yield from _distance_faults(data, labels, lengths["distance"])
    for row in rows_where(np.sum(list(lengths.values()), axis=0) > 1):
        names = " and ".join(labels(name) for name, there in lengths.items() if there[row])
        yield (
            row,
            f"{names}: a row holds one measured length; put each in a row of its own, with equal joint values",
        )


def rows_where(bad: Bool[np.ndarray, " rows"]) -> list[int]:
    """The numbers of the rows where something is true."""
    rows: list[int] = np.flatnonzero(bad).tolist()
    return rows


def _value_faults(data: MeasuredFields, labels: Labels) -> Iterator[Fault]:
    """Rows with values that cannot be: of standard deviations, payloads, directions of approach, sets and dates."""
    for name, least, most in (
        ("sigma_position", SMALLEST_SIGMA, math.inf),
        ("sigma_rotation", SMALLEST_SIGMA, math.inf),
        ("payload", *PAYLOADS),
        ("temperature", *TEMPERATURES),
    ):
        values = data.array(name)
        unit = {"temperature": "deg C", "payload": "kg"}.get(name, "")
        wanted = f"{labels.shown(name, least)} {'or more' if most == math.inf else f'to {most:g} {unit}'}"
        for row in rows_where((values < least) | (values > most)):
            what = (
                f"{labels(name)}: {labels.shown(name, values[row])} stands where {wanted} was wanted; correct it"
                f"{' (deg C = K - 273.15 = (deg F - 32) / 1.8)' if unit == 'deg C' else ''} or leave it empty"
            )
            yield row, what
    if "approach" in data.numbers:
        for joint, values in enumerate(data.array("approach").T, start=1):
            for row in rows_where(~np.isnan(values) & (np.abs(values) != 1)):
                what = (
                    f"{labels(f'approach{joint}')}: {values[row]:.6g} stands where +1 (the joint value grew) or -1 (it "
                    "fell) was wanted; correct it or leave it empty"
                )
                yield row, what
    for row, split in enumerate(data.texts.get("split", ())):
        if split not in SPLITS:
            yield (
                row,
                f"{labels('split')}: '{split}' stands where train or test was wanted; write one of them",
            )
    for row, date in enumerate(data.texts.get("date", ())):
        if date and not is_date(date):
            yield (
                row,
                f"{labels('date')}: expected {WANTED}, got '{date}'; correct it or leave it empty",
            )


def _reading_faults(data: MeasuredFields, labels: Labels) -> Iterator[Fault]:
    """Rows whose readings of a registered sensor are there in part, or cannot be."""
    for sensor, readings in READINGS.items():
        if not {*readings.numbers, *readings.texts} & {*data.numbers, *data.texts}:
            continue
        numbers = {name: data.array(name) for name in readings.numbers}
        missing = np.isnan(np.stack(list(numbers.values())))
        for row in rows_where(missing.any(0) & ~missing.all(0)):
            yield row, f"{labels(sensor)}: is there in part; fill all of it or none"
        texts = {name: data.text(name) for name in readings.texts}
        for bad, describe in readings.row_faults({**numbers, **texts}):
            for row in rows_where(bad):
                yield row, f"{labels(sensor)}: {describe(row)}"


def _named(names: Sequence[str]) -> Bool[np.ndarray, " rows"]:
    return np.array([bool(name) for name in names], dtype=bool)


def _touch_faults(data: MeasuredFields, labels: Labels, touch: Bool[np.ndarray, " rows"]) -> Iterator[Fault]:
    axes = data.text("touch_axis")
    axis = _named(axes)
    label, value = labels("touch_axis"), labels("touch")
    for row in rows_where(np.array([name not in ("", *AXES) for name in axes], dtype=bool)):
        yield row, f"{label}: '{axes[row]}' is no axis; write x, y or z"
    for row in rows_where(touch & ~axis):
        yield row, f"{label}: the touch has no axis; write x, y or z"
    for row in rows_where(axis & ~touch):
        yield row, f"{value}: the touch along {axes[row]} has no coordinate; give it, or remove the axis too"
    for row in rows_where(touch & ~_named(data.text("frame"))):
        what = "the touch names no frame; write which placement of the jig was touched, such as left"
        yield row, f"{labels('frame')}: {what}"


def _distance_faults(
    data: MeasuredFields, labels: Labels, distance: Bool[np.ndarray, " rows"]
) -> Iterator[Fault]:
    anchors, pairs, values = data.text("anchor"), data.text("pair"), data.array("distance")
    anchor, pair = _named(anchors), _named(pairs)
    label, names = labels("distance"), (labels("anchor"), labels("pair"))
    for row in rows_where(values < 0):
        yield (
            row,
            f"{label}: {labels.shown('distance', values[row])} stands where 0 or more was wanted; correct it",
        )
    for row in rows_where(distance & ~anchor & ~pair):
        yield (
            row,
            f"{names[0]}: the distance is from nowhere; name its anchor, or the pair of rows it lies between",
        )
    for row in rows_where(anchor & pair):
        yield (
            row,
            f"{names[0]} and {names[1]}: a distance is from an anchor or within a pair; keep one of them",
        )
    for row in rows_where((anchor | pair) & ~distance):
        yield row, f"{label}: the distance is missing for '{anchors[row] or pairs[row]}'; give it"
    missing = np.isnan(data.array("anchor_place", 3))
    for row in rows_where(missing.any(1) & ~missing.all(1)):
        yield (
            row,
            f"{labels('anchor_place')}: is there in part; give x, y and z of the anchor or none of them",
        )
    for row in rows_where(~missing.all(1) & ~anchor):
        yield row, f"{names[0]}: the place of an anchor is stated without its name; name the anchor"


def group_faults(
    data: MeasuredFields, labels: Labels, sound: Bool[np.ndarray, " rows"], place: Callable[[int], str]
) -> Iterator[Fault]:
    """Find the rows that contradict other rows of the same pair, anchor or socket.

    Args:
        data: what the rows say.
        labels: how complaints call fields.
        sound: rows that are not at fault themselves.
        place: what complaints call a row.
    """
    frame, anchor_place = data.text("frame"), data.array("anchor_place", 3)
    for name, rows in _groups(data.text("pair")).items():
        if problem := _pair_problem(data, labels, name, rows, sound, place):
            yield from ((row, problem) for row in rows)
    for kind in ("anchor", "socket"):
        for name, rows in _groups(data.text(kind)).items():
            frames = sorted({frame[row] for row in rows})
            for row in rows if len(frames) > 1 else ():
                what = (
                    f"{labels('frame')}: {kind} '{name}' is in the frames '{frames[0]}' and '{frames[1]}', but its "
                    "place is one point of one frame; use another name in each frame"
                )
                yield row, what
    for name, rows in _groups(data.text("anchor")).items():
        places = np.where(np.isnan(anchor_place[rows]), np.inf, anchor_place[rows])  # NaN equals NaN
        for row in rows if (places != places[0]).any() else ():
            what = (
                f"{labels('anchor_place')}: anchor '{name}' has not the same place in all its rows; give one place in "
                "all of them or in none, or name the anchors apart"
            )
            yield row, what


def _groups(names: Sequence[str]) -> dict[str, list[int]]:
    """The rows of every name, in their order."""
    rows: dict[str, list[int]] = {}
    for row, name in enumerate(names) if any(names) else ():
        if name:
            rows.setdefault(name, []).append(row)
    return rows


def _pair_problem(
    data: MeasuredFields,
    labels: Labels,
    name: str,
    rows: list[int],
    sound: Bool[np.ndarray, " rows"],
    place: Callable[[int], str],
) -> str:
    """What is wrong with a pair, "" where nothing is."""
    label = f"{labels('pair')}: pair '{name}'"
    if len(rows) != 2:
        count = f"{len(rows)} row" + ("s" if len(rows) > 1 else "")
        return f"{label} has {count} where two were wanted; give the two poses that the distance lies between"
    first, second = rows
    for row in rows:
        if not sound[row]:
            return f"{label} lacks a row, as {place(row)} cannot be used; correct that one"
    frame = data.text("frame")
    if frame[first] != frame[second]:
        return f"{label} is in the frames '{frame[first]}' and '{frame[second]}'; measure it in one"
    for quantity in ("distance", "sigma_position"):
        a, b = data.array(quantity)[rows].tolist()
        if a != b and not (np.isnan(a) and np.isnan(b)):
            return (
                f"{label} has {labels.shown(quantity, a)} and {labels.shown(quantity, b)} as {labels(quantity)}, but "
                "it was measured once; give the same in both rows"
            )
    return ""
