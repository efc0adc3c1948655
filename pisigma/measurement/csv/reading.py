"""Reading a measurement file: every row checked, every complaint with file, line and column."""

import os

import numpy as np
import torch
from torch import Tensor

from pisigma.errors import MeasurementError, nearest_choice
from pisigma.measurement.csv.columns import ANCHOR_PLACE, POSITION, QUATERNION, to_si
from pisigma.measurement.csv.header import Layout, read_header
from pisigma.measurement.csv.rows import CheckedRows, check_rows
from pisigma.measurement.csv.table import Table, read_table
from pisigma.measurement.dataset import LeftOut, Measurements, OnBadRow
from pisigma.robot import Robot
from pisigma.se3 import rotation_from_quaternion, rotation_from_rpy


def read_csv(
    path: str | os.PathLike[str], robot: Robot | None = None, on_bad_row: OnBadRow = "error"
) -> Measurements:
    """Read a measurement file; the header says quantity and unit of every column, in any order.

    `q1_deg` or `q1_rad` and so on (prismatic: `q3_mm` or `q3_m`) must be there, and at least one kind of
    length (each also in `_m`), of which a row holds one: `x_mm,y_mm,z_mm`; `socket`, the name of the fixed
    point that the ball sits in; `touch_axis` (x, y or z) and `touch_mm` with `frame`, the jig; `distance_mm`
    with `anchor`, the name of a fixed point whose place `anchor_x_mm,anchor_y_mm,anchor_z_mm` may be known,
    or with `pair`, the name of the two rows it lies between, given in both.

    `roll_deg,pitch_deg,yaw_deg` (RotZ(roll) · RotY(pitch) · RotX(yaw)) or `qx,qy,qz,qw`, `target`, `frame`,
    `sigma_mm` (of the length in the row), `sigma_deg`, `set`, `payload_kg` and `temperature_c` may be, and
    `approach1` and so on: +1 where that joint's value grew before it stopped, -1 where it fell. An empty cell is
    what was not measured.

    Args:
        path: the file.
        robot: checks number, units and limits of the joints, where given.
        on_bad_row: "error" to raise at the first row that cannot be used, "leave_out" to go on without such
            rows and to list them in `left_out`.

    Raises:
        MeasurementError: the file, its header or a row cannot be used; the message names file, line and
            column.
    """
    if on_bad_row not in ("error", "leave_out"):
        raise MeasurementError(
            f"on_bad_row '{on_bad_row}': {nearest_choice(on_bad_row, ('error', 'leave_out'))}"
        )
    table = read_table(path)
    layout = read_header(table, robot)
    rows = check_rows(table, layout, robot)
    if rows.faults and (on_bad_row == "error" or len(rows.faults) == len(table.lines)):
        raise MeasurementError(_complaint(table, rows.faults))
    return _measurements(table, layout, rows)


def _complaint(table: Table, faults: dict[int, str]) -> str:
    """Say what the first fault is, where, and how many rows more have one."""
    row = min(faults)
    more = len(faults) - 1
    others = f" ({more} more row{'s have' if more > 1 else ' has'} a fault)" if more else ""
    return f"{table.source}, line {table.lines[row]}, {faults[row]}{others}."


def _measurements(table: Table, layout: Layout, rows: CheckedRows) -> Measurements:
    """The sound rows in SI units."""
    values, cells, faults = rows.values, rows.cells, rows.faults
    kept = [row for row in range(len(table.lines)) if row not in faults]

    def numbers(*quantities: str) -> Tensor | None:
        if not quantities or any(quantity not in layout.index for quantity in quantities):
            return None
        columns = [to_si(values[kept, layout.index[name]], layout.column(name).unit) for name in quantities]
        stacked = np.stack(columns, axis=1)
        return None if np.isnan(stacked).all() else torch.from_numpy(stacked)

    def single(quantity: str) -> Tensor | None:
        found = numbers(quantity)
        return None if found is None else found[:, 0]

    def texts(quantity: str) -> tuple[str, ...]:
        column = cells[layout.index[quantity]] if quantity in layout.index else ()
        return tuple(column[row].strip() for row in kept) if column else ()

    def approaches() -> Tensor | None:
        columns = [single(f"approach{number}") for number in range(1, layout.dof + 1)]
        if all(column is None for column in columns):
            return None
        missing = torch.full((len(kept),), torch.nan, dtype=torch.float64)
        return torch.stack([missing if column is None else column for column in columns], 1)

    q = numbers(*layout.joints)
    assert q is not None
    orientation = numbers(*layout.orientation)
    to_rotation = rotation_from_quaternion if layout.orientation == QUATERNION else rotation_from_rpy
    return Measurements(
        q=q,
        position=numbers(*POSITION),
        rotation=None if orientation is None else to_rotation(orientation),
        frame=texts("frame"),
        target=texts("target"),
        sigma_position=single("sigma_position"),
        sigma_rotation=single("sigma_rotation"),
        split=texts("set") or None,
        payload=single("payload"),
        temperature=single("temperature"),
        socket=texts("socket") or None,
        touch_axis=texts("touch_axis") or None,
        touch=single("touch"),
        distance=single("distance"),
        anchor=texts("anchor") or None,
        anchor_place=numbers(*ANCHOR_PLACE),
        pair=texts("pair") or None,
        approach=approaches(),
        line=tuple(table.lines[row] for row in kept),
        source=table.source,
        left_out=tuple(LeftOut(table.lines[row], faults[row]) for row in sorted(faults)),
    )
