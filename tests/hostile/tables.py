"""Hostile measurement files and pose files: damaged text, and tables that are well formed but wrong."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from hostile.case import Case, Rng, calibrate, one_of
from hostile.clean import Clean
from hostile.damage import NUMBERS, TEXTS, damaged


@dataclass(eq=False)
class Columns:
    """A table of texts, to be changed column by column.

    Attributes:
        header: names of the columns.
        cells: texts `(rows, columns)`.
    """

    header: list[str]
    cells: np.ndarray

    @staticmethod
    def read(path: Path) -> "Columns":
        """Read a clean file, which has no quotes."""
        header, *lines = path.read_text(encoding="utf-8").splitlines()
        return Columns(header.split(","), np.array([line.split(",") for line in lines], dtype=object))

    def write(self, path: Path) -> None:
        """Write the table as a file."""
        lines = [",".join(self.header), *(",".join(row) for row in self.cells.tolist())]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")

    def named(self, *starts: str) -> list[int]:
        """Return the columns whose names have this prefix."""
        return [i for i, name in enumerate(self.header) if name.startswith(starts)]

    def numbers(self, columns: list[int]) -> np.ndarray:
        """Return columns as numbers, NaN for empty cells."""
        return np.array([[float(cell or "nan") for cell in row] for row in self.cells[:, columns]])

    def put(self, columns: list[int], values: np.ndarray, digits: int = 9) -> None:
        """Put numbers into columns, except into empty cells."""
        texts = [[f"{v:.{digits}f}" if v == v else "" for v in row] for row in values]
        self.cells[:, columns] = np.array(texts, dtype=object).reshape(len(texts), len(columns))

    @property
    def joints(self) -> list[int]:
        """The columns of the joint values."""
        return [i for i in self.named("q") if self.header[i][1:2].isdigit()]

    @property
    def lengths(self) -> list[int]:
        """The columns of the measured lengths."""
        return self.named("x_", "y_", "z_", "touch_m", "distance_")

    @property
    def measured(self) -> list[int]:
        """The measured columns."""
        return [*self.lengths, *self.named("qx", "qy", "qz", "qw")]


Change = Callable[[Rng, Columns], None]


def _scaled(rng: Rng, table: Columns) -> None:
    columns = one_of(rng, (table.lengths, table.joints, [one_of(rng, table.lengths or table.joints)]))
    table.put(
        columns, table.numbers(columns) * one_of(rng, (1e-3, 1e3, 25.4, 1 / 25.4, 0.9, 1.1, 180 / np.pi, 1e6))
    )


def _another_unit_in_the_header(rng: Rng, table: Columns) -> None:
    units = {"_deg": "_rad", "_rad": "_deg", "_mm": "_m", "_m": "_mm"}
    ending = one_of(rng, ("_deg", "_rad", "_mm", "_m"))
    some = rng.random() < 0.3
    for i, name in enumerate(table.header):
        if name.endswith(ending) and not (some and rng.random() < 0.5):
            table.header[i] = name.removesuffix(ending) + units[ending]


def _columns_exchanged(rng: Rng, table: Columns) -> None:
    group = one_of(rng, (table.joints, table.measured, [*table.joints, *table.measured]))
    if len(group) > 1:
        first, second = rng.choice(group, 2, replace=False)
        table.cells[:, [first, second]] = table.cells[:, [second, first]]


def _header_exchanged(rng: Rng, table: Columns) -> None:
    first, second = rng.integers(len(table.header), size=2)
    table.header[first], table.header[second] = table.header[second], table.header[first]


def _sign_changed(rng: Rng, table: Columns) -> None:
    column = [one_of(rng, [*table.joints, *table.measured])]
    table.put(column, -table.numbers(column))


def _a_joint_offset(rng: Rng, table: Columns) -> None:
    column = [one_of(rng, table.joints)]
    table.put(column, table.numbers(column) + one_of(rng, (90.0, 180.0, 360.0, -90.0, np.pi / 2, 5.0)))


def _rows_shifted(rng: Rng, table: Columns) -> None:
    if table.measured:
        table.cells[:, table.measured] = np.roll(
            table.cells[:, table.measured], one_of(rng, (1, -1, 2, 10)), axis=0
        )


def _a_column_shuffled(rng: Rng, table: Columns) -> None:
    column = one_of(rng, [*table.joints, *table.measured])
    table.cells[:, column] = rng.permutation(table.cells[:, column])


def _a_constant_column(rng: Rng, table: Columns) -> None:
    table.cells[:, one_of(rng, [*table.joints, *table.measured])] = one_of(
        rng, (table.cells[0, 0], "0", "", "1")
    )


def _one_joint_moves(rng: Rng, table: Columns) -> None:
    for column in table.joints[1:]:
        table.cells[:, column] = table.cells[0, column]


def _the_same_pose(rng: Rng, table: Columns) -> None:
    table.cells[:] = table.cells[0]
    if rng.random() < 0.5 and table.lengths:
        table.put(
            table.lengths,
            table.numbers(table.lengths) + rng.normal(size=(len(table.cells), len(table.lengths))) * 0.01,
        )


def _unrelated_numbers(rng: Rng, table: Columns) -> None:
    columns = one_of(rng, (table.lengths, table.joints))
    table.put(columns, rng.uniform(-100, 100, (len(table.cells), len(columns))))


def _rows_twice(rng: Rng, table: Columns) -> None:
    table.cells = np.concatenate([table.cells, table.cells[: int(rng.integers(1, len(table.cells)))]])
    if rng.random() < 0.5 and table.lengths:
        table.put(
            table.lengths,
            table.numbers(table.lengths) + rng.normal(size=(len(table.cells), len(table.lengths))),
        )


def _frame_moved_half_way(rng: Rng, table: Columns) -> None:
    columns = table.lengths
    later = (np.arange(len(table.cells)) >= len(table.cells) * rng.uniform(0.2, 0.8))[:, None]
    table.put(
        columns,
        table.numbers(columns) + later * rng.normal(size=len(columns)) * one_of(rng, (1.0, 5.0, 300.0)),
    )


def _drift(rng: Rng, table: Columns) -> None:
    columns = table.lengths
    table.put(
        columns,
        table.numbers(columns)
        + np.linspace(0, 1, len(table.cells))[:, None] * rng.normal(size=len(columns)) * 5,
    )


def _outliers(rng: Rng, table: Columns) -> None:
    columns, share = table.lengths, one_of(rng, (0.02, 0.2, 0.4, 0.9))
    hit = rng.random((len(table.cells), 1)) < share
    table.put(
        columns,
        table.numbers(columns)
        + hit * rng.normal(size=(len(table.cells), len(columns))) * one_of(rng, (3.0, 50.0, 1e5)),
    )


def _few_rows(rng: Rng, table: Columns) -> None:
    table.cells = table.cells[: int(rng.integers(1, 12))]


def _rounded(rng: Rng, table: Columns) -> None:
    columns = one_of(rng, (table.joints, table.lengths, [*table.joints, *table.lengths]))
    table.put(columns, table.numbers(columns), digits=int(rng.integers(3)))


def _strange_cells(rng: Rng, table: Columns) -> None:
    column, cell = int(rng.integers(len(table.header))), one_of(rng, (*NUMBERS, *TEXTS)).replace(",", ".")
    for row in rng.integers(len(table.cells), size=int(rng.integers(1, 8))):
        table.cells[row, column] = cell


def _emptied_cells(rng: Rng, table: Columns) -> None:
    table.cells[rng.random(table.cells.shape) < one_of(rng, (0.01, 0.2, 0.9))] = ""


def _another_column(rng: Rng, table: Columns) -> None:
    name, cells = one_of(rng, _COLUMNS)
    table.header.append(name)
    column = np.array([one_of(rng, cells) for _ in range(len(table.cells))], dtype=object)
    table.cells = np.concatenate([table.cells, column[:, None]], axis=1)


def _turned_orientations(rng: Rng, table: Columns) -> None:
    four = table.named("qx", "qy", "qz", "qw")
    if len(four) == 4:
        values = table.numbers(four)
        table.put(
            four,
            one_of(
                rng,
                (values[:, [3, 0, 1, 2]], values * [-1, -1, -1, 1], values * 2, values * 0, values[:, ::-1]),
            ),
        )


def _mirrored(rng: Rng, table: Columns) -> None:
    columns = one_of(rng, (table.lengths, table.joints))
    table.put(columns, -table.numbers(columns))


def _sorted_rows(rng: Rng, table: Columns) -> None:
    table.cells = table.cells[np.argsort(table.cells[:, int(rng.integers(len(table.header)))].astype(str))]


_COLUMNS = (
    ("sigma_mm", ("0",)), ("sigma_mm", ("100",)), ("sigma_mm", ("1e-12", "1e9")), ("sigma_mm", ("-1",)),
    ("sigma_deg", ("90",)), ("temperature_c", ("-400",)), ("temperature_c", ("293.15", "294")),
    ("temperature_c", ("70", "71")), ("payload_kg", ("-1",)), ("payload_kg", ("1e9",)), ("payload_kg", ("5", "")),
    ("target", ("A", "B")), ("target", ("a" * 3000,)), ("frame", ("left", "right")),
    ("frame", tuple(map(str, range(500)))), ("set", ("train",)), ("set", ("test",)), ("set", ("train", "test")),
    ("set", ("TRAIN",)), ("approach1", ("1", "-1")), ("approach99", ("1",)), ("approach1", ("0",)),
    ("socket", ("a", "b")), ("pair", ("p",)), ("anchor", ("wire",)), ("touch_axis", ("x",)), ("q9_deg", ("0",)),
    ("remark", ("ok", "=cmd()")), ("x_mm", ("1",)), ("roll_deg", ("0",)), ("", ("0",)),
    ("distance_mm", ("-5", "100")), ("frame", ("\x1b[31m", "b")), ("target", ("../x", "<b>")),
)  # fmt: skip
_CHANGES: tuple[Change, ...] = (
    _scaled, _another_unit_in_the_header, _columns_exchanged, _header_exchanged, _sign_changed, _a_joint_offset,
    _rows_shifted, _a_column_shuffled, _a_constant_column, _one_joint_moves, _the_same_pose, _unrelated_numbers,
    _rows_twice, _frame_moved_half_way, _drift, _outliers, _few_rows, _rounded, _strange_cells, _emptied_cells,
    _another_column, _another_column, _turned_orientations, _mirrored, _sorted_rows,
)  # fmt: skip


def damaged_measurements(rng: Rng, clean: Clean, folder: Path) -> Case:
    """Write a measurement file with damaged text, for any command that reads one."""
    name = one_of(rng, list(clean.rows))
    rows, (model, explained) = clean.rows[name], one_of(rng, list(clean.models.items()))
    commands = {
        rows.path: calibrate(rows.robot, "rows.csv"),
        explained: one_of(
            rng,
            (
                ("evaluate", str(model), "rows.csv", "--set", "resamples=20"),
                ("verify", str(model), "rows.csv", "--json"),
            ),
        ),
    }
    path = one_of(rng, (rows.path, rows.path, explained))
    what, content = damaged(rng, path.read_bytes())
    (folder / "rows.csv").write_bytes(content)
    return Case(f"{path.stem}: {what}", commands[path], rows if path == rows.path else None)


def wrong_measurements(rng: Rng, clean: Clean, folder: Path) -> Case:
    """Write a well-formed measurement file with wrong content."""
    name = one_of(rng, list(clean.rows))
    rows = clean.rows[name]
    table, done = Columns.read(rows.path), []
    for _ in range(one_of(rng, (1, 1, 1, 2))):
        change = one_of(rng, _CHANGES)
        done.append(change.__name__.strip("_").replace("_", " "))
        with np.errstate(all="ignore"):
            change(rng, table)
    table.write(folder / "rows.csv")
    return Case(f"{name}: {', '.join(done)}", calibrate(rows.robot, "rows.csv", *_option(rng)), rows)


def _option(rng: Rng) -> tuple[str, ...]:
    return one_of(
        rng,
        (
            (),
            (),
            (),
            ("--json",),
            ("--set", "free=joint_offsets"),
            ("--set", "prior_mm=0", "--set", "prior_mrad=0"),
        ),
    )


def another_robot(rng: Rng, clean: Clean, folder: Path) -> Case:
    """Write the measurements of one robot, to be calibrated as another."""
    names = list(clean.rows)
    robot, data = clean.rows[one_of(rng, names)], one_of(rng, names)
    shutil.copy(clean.rows[data].path, folder / "rows.csv")
    return Case(f"{data} as {Path(robot.robot).name}", calibrate(robot.robot, "rows.csv"), clean.rows[data])


def wrong_poses(rng: Rng, clean: Clean, folder: Path) -> Case:
    """Write a wrong file of poses."""
    if rng.random() < 0.5:
        what, content = damaged(rng, clean.poses.read_bytes())
        (folder / "poses.csv").write_bytes(content)
    else:
        table, change = Columns.read(clean.poses), one_of(rng, _POSE_CHANGES)
        what = change.__name__.strip("_").replace("_", " ")
        change(rng, table)
        table.write(folder / "poses.csv")
    more = one_of(rng, ((), (), ("--path",), ("--json",), ("--accuracy",), ("--branch", "none")))
    model = str(next(iter(clean.models)))
    return Case(what, ("ik", model, "--poses", "poses.csv", "--out", "joints.csv", *more))


_POSE_CHANGES: tuple[Change, ...] = (
    _another_unit_in_the_header, _header_exchanged, _strange_cells, _emptied_cells, _few_rows, _rows_twice,
    _another_column, _turned_orientations, _sorted_rows, _rounded,
)  # fmt: skip
