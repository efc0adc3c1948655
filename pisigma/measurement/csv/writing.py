"""Writing a measurement file that reads back as it was, whole or not at all."""

import csv
import io
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import MeasurementError, OutputError
from pisigma.measurement.csv.columns import ANCHOR_PLACE, POSITION, QUATERNION, from_si
from pisigma.measurement.csv.rows import first_of_equal_rows
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot


def write_csv(
    measurements: Measurements,
    path: str | os.PathLike[str],
    robot: Robot | None = None,
    revolute: Sequence[bool] | None = None,
) -> None:
    """Write a measurement file: degrees and millimetres with every digit, orientations as quaternions.

    The file is put in its place in one step when it is complete. Read back it gives the same values to 1e-12
    relative (a rotation, where it is orthonormal to that).

    Args:
        measurements: at least one row.
        path: the file; one that is there is replaced.
        robot: says which joints turn (degrees) and which slide (millimetres).
        revolute: the same per joint, without a robot; with neither, all joints turn.

    Raises:
        MeasurementError: the measurements would not read back: no row, a row in which nothing was measured,
            two equal rows, a name that a CSV cell cannot hold, or joints that do not fit.
        OutputError: the file cannot be written there.
    """
    columns = _columns(measurements, _revolute(measurements, robot, revolute))
    _check(measurements, columns)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*columns.numbers, *columns.texts])
    cells: list[list[object]] = [
        ["" if number != number else number for number in values.tolist()]
        for values in columns.numbers.values()
    ]
    writer.writerows(zip(*cells, *columns.texts.values(), strict=True))
    _put(Path(path), text.getvalue())


@dataclass(frozen=True)
class _Columns:
    """The columns by name: numbers in the file's units, and texts."""

    numbers: dict[str, Float64[np.ndarray, " rows"]] = field(default_factory=dict)
    texts: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def add(self, name: str, values: Tensor, unit: str = "") -> None:
        self.numbers[name] = from_si(values.detach().cpu().numpy(), unit)


def _revolute(
    measurements: Measurements, robot: Robot | None, revolute: Sequence[bool] | None
) -> tuple[bool, ...]:
    """For every joint, whether it turns."""
    if robot is not None:
        kinds, origin = robot.revolute, f"robot '{robot.name}'"
    elif revolute is not None:
        kinds, origin = tuple(revolute), "'revolute'"
    else:
        return (True,) * measurements.dof
    if len(kinds) != measurements.dof:
        raise MeasurementError(
            f"{measurements.source}: has {measurements.dof} joints, but {origin} has {len(kinds)}; give the "
            "robot that was measured."
        )
    return kinds


def _columns(measurements: Measurements, revolute: tuple[bool, ...]) -> _Columns:
    """What stands in the file; columns that would hold nothing are left away, but for the position."""
    columns = _Columns()
    for number, (q, turns) in enumerate(zip(measurements.q.T, revolute, strict=True), start=1):
        unit = "deg" if turns else "mm"
        columns.add(f"q{number}_{unit}", q, unit)
    _add_lengths(columns, measurements)
    if measurements.rotation is not None and not measurements.rotation.isnan().all():
        for name, values in zip(QUATERNION, _quaternions(measurements.rotation).T, strict=True):
            columns.add(name, values)
    for name, optional, unit in (
        ("sigma_mm", measurements.sigma_position, "mm"),
        ("sigma_deg", measurements.sigma_rotation, "deg"),
        ("payload_kg", measurements.payload, ""),
        ("temperature_c", measurements.temperature, ""),
    ):
        if optional is not None and not optional.isnan().all():
            columns.add(name, optional, unit)
    if measurements.approach is not None:
        for number, approach in enumerate(measurements.approach.T, start=1):
            if not approach.isnan().all():
                columns.add(f"approach{number}", approach)
    for name, texts in (
        ("target", measurements.target),
        ("frame", measurements.frame),
        ("set", measurements.split),
        ("socket", measurements.socket),
        ("touch_axis", measurements.touch_axis),
        ("anchor", measurements.anchor),
        ("pair", measurements.pair),
    ):
        if texts is not None and any(texts):
            columns.texts[name] = texts
    return columns


def _add_lengths(columns: _Columns, measurements: Measurements) -> None:
    """The measured lengths; the position also where there is none, unless there are others."""
    position = measurements.position
    if position is None:
        position = measurements.q.new_full((measurements.rows, 3), torch.nan)
    if not position.isnan().all() or not measurements.kinds & {"socket", "touch", "distance"}:
        for name, values in zip(POSITION, position.T, strict=True):
            columns.add(f"{name}_mm", values, "mm")
    for name, lengths in (("touch_mm", measurements.touch), ("distance_mm", measurements.distance)):
        if lengths is not None and not lengths.isnan().all():
            columns.add(name, lengths, "mm")
    if measurements.anchor_place is not None and not measurements.anchor_place.isnan().all():
        for name, values in zip(ANCHOR_PLACE, measurements.anchor_place.T, strict=True):
            columns.add(f"{name}_mm", values, "mm")


def _quaternions(R: Float64[Tensor, "rows 3 3"]) -> Float64[Tensor, "rows 4"]:
    """Quaternions (x, y, z, w) of rotations, w >= 0.

    The outer product 4·q·q^T is linear in R (Shepperd 1978, J. Guidance and Control 1(3)); its row with the
    largest diagonal entry is q up to length and sign, without cancellation for any angle.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in R.unbind(-2))
    rows = [
        torch.stack([1 + xx - yy - zz, xy + yx, xz + zx, zy - yz], -1),
        torch.stack([xy + yx, 1 - xx + yy - zz, yz + zy, xz - zx], -1),
        torch.stack([xz + zx, yz + zy, 1 - xx - yy + zz, yx - xy], -1),
        torch.stack([zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz], -1),
    ]
    outer = torch.stack(rows, -2)
    largest = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    q = torch.take_along_dim(outer, largest[:, None, None], -2)[:, 0]
    sign = torch.where(q[:, 3:] < 0, -1.0, 1.0).to(q)
    length = (q * q).sum(-1, keepdim=True).sqrt()
    return sign * q / length


def _check(measurements: Measurements, columns: _Columns) -> None:
    """Refuse what would not read back."""
    if measurements.rows == 0:
        raise MeasurementError(
            f"{measurements.source}: holds no row to write; give at least one measurement."
        )
    values = np.stack(list(columns.numbers.values()), axis=1)
    something = np.zeros(measurements.rows, dtype=bool)
    for kind in measurements.kinds:
        something |= measurements.seen(kind).cpu().numpy()
    nothing = ~something
    if nothing.any():
        place = measurements.place(int(nothing.argmax()))
        raise MeasurementError(
            f"{place}: nothing was measured in this row; leave it out with select before writing."
        )
    first = first_of_equal_rows(values, list(columns.texts.values()))
    equal = first != np.arange(len(first))
    if equal.any():
        row = int(equal.argmax())
        raise MeasurementError(
            f"{measurements.place(row)}: equals row {int(first[row])} in everything; leave one of them out "
            "with select before writing."
        )
    for name, texts in columns.texts.items():
        for text in set(texts):
            if not _fits_cell(text):
                place = measurements.place(texts.index(text))
                raise MeasurementError(
                    f"{place}, column '{name}': the name {text!r} cannot stand in a CSV cell; use one of a "
                    "single line without blanks around it."
                )


def _fits_cell(text: str) -> bool:
    """Whether a name reads back as it is."""
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return text == text.strip() and not set(text) & {"\n", "\r", "\0"}


def _put(path: Path, text: str) -> None:
    """Write a file beside `path` and move it there in one step."""
    path = Path(os.path.realpath(path))
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        try:
            with temporary.open("w", encoding="utf-8", newline="") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as problem:
        raise OutputError(
            f"{path}: cannot be written ({problem.strerror}); check the folder and its rights."
        ) from None
