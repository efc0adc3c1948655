"""Whether the parts of a data set fit together: shapes, types, and values that can be."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from pisigma.errors import MeasurementError, nearest_choice
from pisigma.measurement.lengths import LengthCells, group_faults, row_faults

NUMBERS: dict[str, tuple[int, ...]] = {
    "position": (3,),
    "rotation": (3, 3),
    "sigma_position": (),
    "sigma_rotation": (),
    "payload": (),
    "temperature": (),
    "touch": (),
    "distance": (),
    "anchor_place": (3,),
    "approach": (-1,),
}
"""Fields that are numbers, with the shape of a row; -1 stands for the number of joints."""
PARTIAL = ("anchor_place", "approach")
"""Fields of which a row may have some values without the others."""


def row_shape(name: str, dof: int) -> tuple[int, ...]:
    """Return the shape that a row of a field has, for a robot with so many joints."""
    return tuple(dof if size < 0 else size for size in NUMBERS[name])


TEXTS = ("frame", "target", "split", "socket", "touch_axis", "anchor", "pair")
"""Parts that are texts."""

_SPLITS = ("train", "test")
_ROTATION_TOLERANCE = 1e-6


def row_place(source: str, lines: Sequence[int], row: int) -> str:
    """Where a row is from, as complaints say it: file and line, or source and row counted from 0."""
    line = lines[row] if row < len(lines) else 0
    return f"{source}, line {line}" if line else f"{source}, row {row}"


def check_parts(parts: Mapping[str, Any]) -> None:
    """Refuse parts of a data set that do not fit together.

    Args:
        parts: the fields of `Measurements` by name.

    Raises:
        MeasurementError: a shape, type or value is wrong; the message names the row.
    """
    _check_shapes(parts)
    _refuse(parts, ~torch.isfinite(parts["q"]).all(-1), "q", "is not finite; give every joint value")
    _check_values(parts)
    _check_rotations(parts)
    for row, name in enumerate(parts["split"] or ()):
        if name not in _SPLITS:
            place = row_place(parts["source"], parts["line"], row)
            raise MeasurementError(f"{place}: split '{name}' is unknown; {nearest_choice(name, _SPLITS)}")
    _check_lengths(parts)


def _check_shapes(parts: Mapping[str, Any]) -> None:
    """One row per measurement, float64, on one device."""
    source, q = parts["source"], parts["q"]
    dof = q.shape[1]
    for name, shape in {"q": (dof,), **{name: row_shape(name, dof) for name in NUMBERS}}.items():
        values = parts[name]
        if values is None:
            continue
        if tuple(values.shape) != (len(q), *shape):
            raise MeasurementError(
                f"{source}: '{name}' of shape {(len(q), *shape)} was wanted for {len(q)} rows, got "
                f"{tuple(values.shape)}."
            )
        if values.dtype != torch.float64:
            raise MeasurementError(
                f"{source}: '{name}' in float64 was wanted, got {values.dtype}; convert it."
            )
        if values.device != q.device:
            raise MeasurementError(
                f"{source}: '{name}' is on {values.device}, but q is on {q.device}; move it there."
            )
    for name in (*TEXTS, "line"):
        if parts[name] is not None and len(parts[name]) != len(q):
            raise MeasurementError(f"{source}: '{name}' has {len(parts[name])} entries for {len(q)} rows.")


def _check_values(parts: Mapping[str, Any]) -> None:
    """What is not NaN is finite and can be; a position or a rotation is there whole or not at all."""
    for name in NUMBERS:
        values = parts[name]
        if values is None:
            continue
        flat = values.reshape(len(values), math.prod(values.shape[1:]))
        missing = torch.isnan(flat)
        _refuse(parts, torch.isinf(flat).any(-1), name, "is infinite; give NaN where nothing was measured")
        if name not in PARTIAL:
            _refuse(parts, missing.any(-1) & ~missing.all(-1), name, "is NaN in part; give all of it or none")
        if name.startswith("sigma"):
            _refuse(parts, flat[:, 0] <= 0, name, "is not above 0; give a standard deviation or NaN")
        if name == "payload":
            _refuse(parts, flat[:, 0] < 0, name, "is below 0; give a mass or NaN")
        if name == "approach":
            stated = ~missing & (flat.abs() != 1)
            _refuse(parts, stated.any(-1), name, "has a value other than +1 or -1; give one of them, or NaN")


def _check_rotations(parts: Mapping[str, Any]) -> None:
    """Rotations are orthonormal and right-handed."""
    R = parts["rotation"]
    if R is None:
        return
    deviation = (R.mT @ R - torch.eye(3, dtype=R.dtype, device=R.device)).abs().amax((-1, -2))
    left_handed = (torch.linalg.cross(R[..., 0], R[..., 1]) * R[..., 2]).sum(-1) < 0
    _refuse(parts, deviation > _ROTATION_TOLERANCE, "rotation", "is not orthonormal; normalise it")
    _refuse(parts, left_handed, "rotation", "is left-handed; a reflection is no rotation, check its axes")


def _refuse(parts: Mapping[str, Any], bad: Bool[Tensor, " rows"], name: str, what: str) -> None:
    """Raise for the first bad row, if there is one."""
    if bad.any():
        row = int(bad.nonzero()[0])
        place = row_place(parts["source"], parts["line"], row)
        raise MeasurementError(f"{place}: {name} {parts[name][row].tolist()} {what}.")


def _check_lengths(parts: Mapping[str, Any]) -> None:
    """Rows contradict neither themselves nor each other in what lengths were measured."""
    if all(
        parts[name] is None
        for name in ("socket", "touch_axis", "touch", "distance", "anchor", "anchor_place", "pair")
    ):
        return
    cells = _length_cells(parts)

    def place(row: int) -> str:
        return row_place(parts["source"], parts["line"], row)

    sound = np.ones(len(cells.frame), dtype=bool)
    for faults in (row_faults(cells), group_faults(cells, sound, place)):
        for bad, describe in faults:
            if bad.any():
                row = int(bad.argmax())
                raise MeasurementError(f"{place(row)}: {describe(row)}.")


def _length_cells(parts: Mapping[str, Any]) -> LengthCells:
    """The same as the rules for lengths want it."""
    rows = len(parts["q"])

    def numbers(name: str, *shape: int) -> np.ndarray:
        values = parts[name]
        if values is None:
            return np.full((rows, *shape), np.nan)
        array: np.ndarray = values.detach().cpu().numpy()
        return array

    names = {name: parts[name] or ("",) * rows for name in TEXTS}
    return LengthCells(
        labels={name: f"'{name}'" for name in (*NUMBERS, *TEXTS)} | {"sigma": "'sigma_position'"},
        frame=names["frame"],
        socket=names["socket"],
        touch_axis=names["touch_axis"],
        anchor=names["anchor"],
        pair=names["pair"],
        position=np.isfinite(numbers("position", 3)).all(1),
        touch=numbers("touch"),
        distance=numbers("distance"),
        anchor_place=numbers("anchor_place", 3),
        sigma=numbers("sigma_position"),
    )
