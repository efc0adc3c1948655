"""Rules that rows of measurements must satisfy, individually and together, in files and in memory."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from pisigma.files.errors import MeasurementError, Phrase, Place, choice_remedy
from pisigma.measurement.dates import EXPECTED_DATE, is_date
from pisigma.measurement.faults import Fault
from pisigma.measurement.fields import NUMBERS, TEXTS, MeasuredFields
from pisigma.measurement.readings import READINGS, Unit, from_si, numeric_columns, text_columns

AXES = ("x", "y", "z")
"""Names of the axes of a frame, for touches."""
_SPLITS = ("train", "test")
_MIN_SIGMA = 1e-12
"""Smallest standard deviation of a sensor [m or rad]; no sensor is more accurate."""
_PAYLOADS = (0.0, 2500.0)
"""Range of payloads [kg]; the strongest arms on the market lift 2,300 kg."""
TEMPERATURES = (-50.0, 150.0)
"""Range of temperatures [deg C] in which robots work; it excludes room temperatures in kelvins (293)."""

_MAY_BE_PARTIAL = ("anchor_place", "approach", "torque")  # rows may have only some of the values
_ROTATION_TOLERANCE = 1e-6


@dataclass(frozen=True)
class FieldLabels:
    """Names of fields and units of values in messages.

    Attributes:
        names: column that messages name, by field or sensor; the field's name if a field is missing here.
        units: unit in which messages show values, by field; SI units if a field is missing here.
    """

    names: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, Unit] = field(default_factory=dict)

    def __call__(self, name: str) -> str:
        """Return the name of a field or a sensor in messages."""
        return self.names.get(name, name)

    def in_message_unit(self, name: str, value: float) -> float:
        """Return an SI value of a field in the unit of messages, with 6 digits."""
        return float(f"{float(from_si(np.array([value]), self.units.get(name, ''))[0]):.6g}")


def check_fields(data: MeasuredFields) -> None:
    """Refuse fields that do not fit together.

    Raises:
        MeasurementError: a shape, type or value is wrong, or rows contradict each other; `line` or the message states
            the row, and `column` the field.
    """
    _check_shapes(data)
    q = data.numbers["q"]
    _refuse(data, ~torch.isfinite(q).all(-1), "q", "finite joint values", "give every joint value")
    for name in data.numbers:
        if name != "q":
            _check_values(data, name)
    _check_rotations(data)
    sound = np.ones(data.rows, dtype=bool)
    for faults in (
        row_faults(data, FieldLabels()),
        group_faults(data, FieldLabels(), sound, data.place_text),
    ):
        for row, fault in faults:
            raise fault.error(data.place_of(row))


def _check_shapes(data: MeasuredFields) -> None:
    """Check that there is one row per measurement, in float64, on one device."""
    source, q = data.source, data.numbers["q"]
    sizes = {"q": (-1,), **NUMBERS, **dict.fromkeys(numeric_columns(), ())}
    for name, values in data.numbers.items():
        if name not in sizes:
            raise MeasurementError(
                f"no sensor has a reading '{name}'",
                option="readings",
                value=name,
                at=Place(source),
                remedy=choice_remedy(name, numeric_columns()),
            )
        shape = (len(q), *(q.shape[1] if size < 0 else size for size in sizes[name]))
        if tuple(values.shape) != shape:
            expected = f"shape {shape} for {len(q)} rows"
            raise MeasurementError(
                option=name, expected=expected, value=tuple(values.shape), at=Place(source)
            )
        if values.dtype != torch.float64:
            raise MeasurementError(
                option=name,
                expected="float64",
                value=values.dtype,
                at=Place(source),
                remedy="convert the values",
            )
        if values.device != q.device:
            raise MeasurementError(
                option=name,
                expected=f"values on the device of q, {q.device}",
                value=values.device,
                at=Place(source),
                remedy="move the values to that device",
            )
    for name, entries in {**data.texts, "line": data.line}.items():
        if name not in (*TEXTS, "line", *text_columns()):
            raise MeasurementError(
                f"no sensor has a text column '{name}'",
                option="readings",
                value=name,
                at=Place(source),
                remedy=choice_remedy(name, text_columns()),
            )
        if len(entries) != len(q):
            expected = f"{len(q)} entries, one per row"
            raise MeasurementError(option=name, expected=expected, value=len(entries), at=Place(source))


def _check_values(data: MeasuredFields, name: str) -> None:
    """Check that values are finite or NaN, and that a position or a rotation is complete or absent."""
    values = data.numbers[name]
    flat = values.reshape(len(values), math.prod(values.shape[1:]))
    missing = torch.isnan(flat)
    _refuse(data, torch.isinf(flat).any(-1), name, "finite values", "give NaN where nothing was measured")
    if name not in _MAY_BE_PARTIAL:
        partial = missing.any(-1) & ~missing.all(-1)
        _refuse(data, partial, name, "all values or none", "give all of them, or NaN for all")


def _check_rotations(data: MeasuredFields) -> None:
    """Check that rotations are orthonormal and right-handed."""
    R = data.numbers.get("rotation")
    if R is None:
        return
    deviation = (R.mT @ R - torch.eye(3, dtype=R.dtype, device=R.device)).abs().amax((-1, -2))
    left_handed = (torch.linalg.cross(R[..., 0], R[..., 1]) * R[..., 2]).sum(-1) < 0
    _refuse(data, deviation > _ROTATION_TOLERANCE, "rotation", "an orthonormal matrix", "normalise it")
    _refuse(
        data, left_handed, "rotation", "a right-handed matrix", "check its axes, because this is a reflection"
    )


def _refuse(data: MeasuredFields, bad: Bool[Tensor, " rows"], name: str, expected: str, remedy: str) -> None:
    """Raise an error for the first faulty row, if any."""
    if bad.any():
        row = int(bad.nonzero()[0])
        value = data.numbers[name][row].tolist()
        raise MeasurementError(expected=expected, value=value, at=data.place_of(row, name), remedy=remedy)


RowAndFault = tuple[int, Fault]
"""Index of a row, and its fault."""


def row_faults(data: MeasuredFields, labels: FieldLabels) -> Iterator[RowAndFault]:
    """Yield the faults of rows with impossible or contradictory values.

    A row contains one measured length: a position, the coordinate of a touch, a socket, or a distance. A second
    sensor's reading at the same joint values is a second row. Duplicate rows are allowed.
    """
    yield from _value_faults(data, labels)
    yield from _reading_faults(data, labels)
    lengths = {
        "position": (data.is_measured("position") | data.is_measured("pose")).cpu().numpy(),
        "socket": _named(data.text("socket")),
        "touch": ~np.isnan(data.array("touch")),
        "distance": ~np.isnan(data.array("distance")),
        **{name: data.is_measured(name).cpu().numpy() for name, one in READINGS.items() if one.is_length},
    }
    if {"touch", "touch_axis"} & {*data.numbers, *data.texts}:
        yield from _touch_faults(data, labels, lengths["touch"])
    if {"distance", "anchor", "anchor_place", "pair"} & {*data.numbers, *data.texts}:
        yield from _distance_faults(data, labels, lengths["distance"])
    for row in rows_where(np.sum(list(lengths.values()), axis=0) > 1):
        names = [labels(name) for name, there in lengths.items() if there[row]]
        yield (
            row,
            Fault(
                column=names[0],
                expected="one measured length per row",
                value=Phrase(" and ".join(names)),
                remedy="put each length in a separate row with equal joint values",
            ),
        )


def rows_where(mask: Bool[np.ndarray, " rows"]) -> list[int]:
    """Return the indices of the rows in which a mask is true."""
    rows: list[int] = np.flatnonzero(mask).tolist()
    return rows


def _value_faults(data: MeasuredFields, labels: FieldLabels) -> Iterator[RowAndFault]:
    """Find impossible standard deviations, payloads, temperatures, directions of approach, sets and dates."""
    for name, least, most in (
        ("sigma_position", _MIN_SIGMA, math.inf),
        ("sigma_rotation", _MIN_SIGMA, math.inf),
        ("payload", *_PAYLOADS),
        ("temperature", *TEMPERATURES),
    ):
        values = data.array(name)
        unit = {"temperature": "deg C", "payload": "kg"}.get(name, labels.units.get(name, ""))
        lower = f"{labels.in_message_unit(name, least):.3g}"
        expected = (
            f"{lower} {unit} or more".replace("  ", " ")
            if most == math.inf
            else f"{lower} to {most:g} {unit}"
        )
        formula = " (deg C = K - 273.15 = (deg F - 32) / 1.8)" if unit == "deg C" else ""
        for row in rows_where((values < least) | (values > most)):
            shown = labels.in_message_unit(name, values[row])
            yield row, Fault("", labels(name), expected, shown, f"correct it{formula} or leave it empty")
    if "approach" in data.numbers:
        expected = "+1 (the joint value increased) or -1 (it decreased)"
        for joint, values in enumerate(data.array("approach").T, start=1):
            for row in rows_where(~np.isnan(values) & (np.abs(values) != 1)):
                shown = labels.in_message_unit("approach", values[row])
                yield row, Fault("", labels(f"approach{joint}"), expected, shown, _CORRECT)
    for row, split in enumerate(data.texts.get("split", ())):
        if split not in _SPLITS:
            yield row, Fault("", labels("split"), "train or test", split, "write one of them")
    for row, date in enumerate(data.texts.get("date", ())):
        if date and not is_date(date):
            yield row, Fault("", labels("date"), EXPECTED_DATE, date, _CORRECT)


_CORRECT = "correct it or leave it empty"


def _reading_faults(data: MeasuredFields, labels: FieldLabels) -> Iterator[RowAndFault]:
    """Find readings of registered sensors that are incomplete or impossible."""
    for sensor, readings in READINGS.items():
        if not {*readings.numbers, *readings.texts} & {*data.numbers, *data.texts}:
            continue
        numbers = {name: data.array(name) for name in readings.numbers}
        missing = np.isnan(np.stack(list(numbers.values())))
        for row in rows_where(missing.any(0) & ~missing.all(0)):
            names = ", ".join(readings.numbers)
            yield (
                row,
                Fault(f"not all of {names} are given", labels(sensor), remedy="fill all of them or none"),
            )
        texts = {name: data.text(name) for name in readings.texts}
        for bad, describe in readings.row_faults({**numbers, **texts}):
            for row in rows_where(bad):
                yield row, _with_column(describe(row), labels(sensor))


def _with_column(what: str | Fault, column: str) -> Fault:
    """Return the fault that a sensor reports for a row, with a default column if the sensor does not name one."""
    fault = Fault(what) if isinstance(what, str) else what
    return fault if fault.column is not None else replace(fault, column=column)


def _named(names: Sequence[str]) -> Bool[np.ndarray, " rows"]:
    return np.array([bool(name) for name in names], dtype=bool)


def _touch_faults(
    data: MeasuredFields, labels: FieldLabels, touch: Bool[np.ndarray, " rows"]
) -> Iterator[RowAndFault]:
    axes = data.text("touch_axis")
    axis = _named(axes)
    column, expected = labels("touch_axis"), "the touched axis: x, y or z"
    for row in rows_where(np.array([name not in ("", *AXES) for name in axes], dtype=bool)):
        yield row, Fault("", column, expected, axes[row], "write x, y or z")
    for row in rows_where(touch & ~axis):
        yield row, Fault("", column, expected, "", "write x, y or z")
    for row in rows_where(axis & ~touch):
        problem = f"the touch along {axes[row]} has no coordinate"
        yield row, Fault(problem, labels("touch"), remedy="add the coordinate, or remove the axis too")
    for row in rows_where(touch & ~_named(data.text("frame"))):
        remedy = "write the name of the placement of the jig that was touched, such as left"
        yield row, Fault("", labels("frame"), "the frame of the touch", "", remedy)


def _distance_faults(
    data: MeasuredFields, labels: FieldLabels, distance: Bool[np.ndarray, " rows"]
) -> Iterator[RowAndFault]:
    anchors, pairs, values = data.text("anchor"), data.text("pair"), data.array("distance")
    anchor, pair = _named(anchors), _named(pairs)
    column, of_anchor, of_pair = labels("distance"), labels("anchor"), labels("pair")
    for row in rows_where(values < 0):
        yield (
            row,
            Fault(
                "",
                column,
                "a distance of 0 or more",
                labels.in_message_unit("distance", values[row]),
                "correct the distance",
            ),
        )
    for row in rows_where(distance & ~anchor & ~pair):
        remedy = "name its anchor, or the pair of rows between which it was measured"
        yield row, Fault("the distance has neither an anchor nor a pair", of_anchor, remedy=remedy)
    for row in rows_where(anchor & pair):
        problem = f"the distance has both an '{of_anchor}' and a '{of_pair}'"
        yield row, Fault(problem, of_anchor, remedy="keep one of them")
    for row in rows_where((anchor | pair) & ~distance):
        problem = f"the distance of '{anchors[row] or pairs[row]}' is missing"
        yield row, Fault(problem, column, remedy="add the distance")
    missing = np.isnan(data.array("anchor_place", 3))
    for row in rows_where(missing.any(1) & ~missing.all(1)):
        expected = "x, y and z of the anchor, or none of them"
        yield (
            row,
            Fault(
                "",
                labels("anchor_place"),
                expected,
                f"{3 - int(missing[row].sum())} of them",
                "fill all or none",
            ),
        )
    for row in rows_where(~missing.all(1) & ~anchor):
        problem = "the position of an anchor is given without its name"
        yield row, Fault(problem, of_anchor, remedy="name the anchor")


def group_faults(
    data: MeasuredFields, labels: FieldLabels, valid: Bool[np.ndarray, " rows"], place: Callable[[int], str]
) -> Iterator[RowAndFault]:
    """Yield the faults of rows that contradict other rows of the same pair, anchor or socket.

    Args:
        data: the rows.
        labels: names of fields in messages.
        valid: mask of the rows that have no fault by themselves.
        place: function that returns the place of a row for messages.
    """
    frame, anchor_place = data.text("frame"), data.array("anchor_place", 3)
    for name, rows in _groups(data.text("pair")).items():
        if fault := _pair_fault(data, labels, name, rows, valid, place):
            yield from ((row, fault) for row in rows)
    for kind in ("anchor", "socket"):
        for name, rows in _groups(data.text(kind)).items():
            frames = sorted({frame[row] for row in rows})
            for row in rows if len(frames) > 1 else ():
                problem = f"{kind} '{name}' is in the frames '{frames[0]}' and '{frames[1]}' instead of one"
                yield (
                    row,
                    Fault(problem, labels("frame"), value=frame[row], remedy="rename it in one frame"),
                )
    for name, rows in _groups(data.text("anchor")).items():
        places = np.where(np.isnan(anchor_place[rows]), np.inf, anchor_place[rows])  # NaN equals NaN
        for row in rows if (places != places[0]).any() else ():
            problem = f"anchor '{name}' does not have the same position in all its rows"
            remedy = "give one position in all of them or in none, or use different names"
            yield row, Fault(problem, labels("anchor_place"), value=name, remedy=remedy)


def _groups(names: Sequence[str]) -> dict[str, list[int]]:
    """Return the indices of the rows of every name, in order."""
    rows: dict[str, list[int]] = {}
    for row, name in enumerate(names) if any(names) else ():
        if name:
            rows.setdefault(name, []).append(row)
    return rows


def _pair_fault(
    data: MeasuredFields,
    labels: FieldLabels,
    name: str,
    rows: list[int],
    sound: Bool[np.ndarray, " rows"],
    place: Callable[[int], str],
) -> Fault | None:
    """Return the fault of a pair of rows; None if it has no fault."""
    column = labels("pair")
    if len(rows) != 2:
        remedy = "give the two poses between which the distance was measured"
        return Fault(
            "", column, f"two rows of pair '{name}'", f"{len(rows)} row{'s'[: len(rows) - 1]}", remedy
        )
    first, second = rows
    for row in rows:
        if not sound[row]:
            problem = f"pair '{name}' lacks a row, because {place(row)} cannot be used"
            return Fault(problem, column, value=name, remedy="correct that row")
    frame = data.text("frame")
    if frame[first] != frame[second]:
        frames = f"'{frame[first]}' and '{frame[second]}'"
        problem = f"expected one frame of pair '{name}', got {frames}"
        return Fault(problem, column, value=frames, remedy="measure both rows in one frame")
    for quantity in ("distance", "sigma_position"):
        a, b = data.array(quantity)[rows].tolist()
        if a != b and not (np.isnan(a) and np.isnan(b)):
            shown = f"{labels.in_message_unit(quantity, a):g} and {labels.in_message_unit(quantity, b):g}"
            problem = f"expected one value of '{labels(quantity)}' in both rows of pair '{name}', got {shown}"
            return Fault(problem, column, value=shown, remedy="give the same value in both rows")
    return None
