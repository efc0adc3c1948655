"""Mistakes in exports are refused or warned of with line and column, and every row is accounted for."""

from collections.abc import Callable
from pathlib import Path

import pytest
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.workflow.import_rows import ImportedRows, import_rows
from pisigma.workflow.settings.importing import ImportSettings

NAMES = ["J1", "J2", "J3", "J4", "J5", "J6", "X", "Y", "Z"]
STATED = ImportSettings(units="mm,deg")
Rows = list[list[str]]


def measured(count: int = 12) -> Rows:
    """Rows of six joints and a position, with four decimals and no order in any column."""
    value = [
        [((i * 7919 + k * 104729 + i * i * 31) % 3600) / 10 - 180 for k in range(9)] for i in range(count)
    ]
    return [[f"{v * (1 if k < 6 else 9) + 0.1234:.4f}" for k, v in enumerate(row)] for row in value]


def imported(
    tmp_path: Path, rows: Rows, names: list[str] | None, settings: ImportSettings = STATED
) -> ImportedRows:
    path = tmp_path / "export.csv"
    path.write_text("\n".join(",".join(row) for row in ([names] if names else []) + rows) + "\n")
    result = import_rows([path], settings)
    for file in result.accounts:
        assert file.rows_read == file.rows_used + len(file.left_out)
    return result


def column(values: list[str], at: int = 0) -> Callable[[Rows], Rows]:
    return lambda rows: [[*row[:at], value, *row[at:]] for row, value in zip(rows, values, strict=True)]


def means(rows: Rows) -> list[str]:
    return [f"{sum(float(row[k]) for row in rows) / len(rows):.4f}" for k in range(len(rows[0]))]


RADIANS = [f"{0.26 * i - 1.5:.4f}" for i in range(12)]
TIMES = [f"{100 + 0.7 * i:.2f}" for i in range(12)]
# name: (headings, change of the rows, (line, column, value))
REFUSED: dict[str, tuple[list[str] | None, Callable[[Rows], Rows], tuple[int, int | str | None, object]]] = {
    "gradians or degrees": (
        [f"{n} [grad]" for n in NAMES[:6]] + NAMES[6:],
        lambda rows: rows,
        (1, "J1 [grad]", "deg"),
    ),
    "gradians or degrees of a maker": (
        [f"A{i} [grad]" for i in range(1, 7)] + NAMES[6:],
        lambda rows: rows,
        (1, "A1 [grad]", "deg"),
    ),
    "gradians or degrees below the names": (
        [f"A{i}" for i in range(1, 7)] + NAMES[6:],
        lambda rows: [["grad"] * 6 + ["mm"] * 3, *rows],
        (1, "A1", "deg"),
    ),
    "gradians or degrees in a comment": (
        ["# angles in grad"],
        lambda rows: [[f"A{i}" for i in range(1, 7)] + NAMES[6:], *rows],
        (2, "A1", "deg"),
    ),
    "first row has few cells": (NAMES, lambda rows: [rows[0][:3], *rows[1:]], (2, None, 3)),
    "first row lacks a joint": (NAMES, lambda rows: [["", *rows[0][1:]], *rows[1:]], (2, "q1_deg", "")),
    "first row lacks a cell": (None, lambda rows: [rows[0][:8], *rows[1:]], (1, None, 8)),
    "first row lacks a cell below headings": (NAMES, lambda rows: [rows[0][:8], *rows[1:]], (2, None, 8)),
    "first row holds words": (NAMES, lambda rows: [["error"] * 9, *rows[1:]], (2, "J1", "error")),
    "thousands": (
        NAMES,
        lambda rows: [
            [str(10 + 7 * i)] * 6 + [f"{2 + i % 3}.{104 + i}" for _ in range(3)] for i in range(12)
        ],
        (2, 7, "2.104"),
    ),
    "times in front": (None, column(TIMES), (1, 1, "100 to 107.7")),
    "times instead of a joint": (
        None,
        lambda rows: column(TIMES)([row[1:] for row in rows]),
        (1, 1, "100 to 107.7"),
    ),
    "times that fall": (None, column(TIMES[::-1]), (1, 1, "107.7 to 100")),
    "times that stand still": (None, column([TIMES[i // 2] for i in range(12)]), (1, 1, "100 to 103.5")),
    "times behind the joints": (None, column(TIMES, 6), (1, 7, "100 to 107.7")),
    "times behind the position": (None, column(TIMES, 9), (1, 10, "100 to 107.7")),
    "times of a clock that was set": (
        None,
        lambda rows: column([f"{0.7 * i - 5 * (i > 11):.1f}" for i in range(24)])(measured(24)),
        (1, 1, "0 to 11.1"),
    ),
    "two of three angles and a note between": (
        [*NAMES, "A", "Note", "B"],
        lambda rows: column(RADIANS, 9)(column(["ok"] * 12, 9)(column(RADIANS, 9)(rows))),
        (1, None, "A, B"),
    ),
    "two of three angles": (
        [*NAMES, "A", "B"],
        lambda rows: column(RADIANS, 9)(column(RADIANS, 9)(rows)),
        (1, None, "A, B"),
    ),
    "three of a quaternion": (
        [*NAMES, "Q0", "Q1", "Q2"],
        lambda rows: [[*row, "1", "0", "0"] for row in rows],
        (1, None, "Q0, Q1, Q2"),
    ),
}


@pytest.mark.parametrize("mistake", REFUSED)
def test_refused_with_line_and_column(tmp_path: Path, mistake: str):
    names, change, (line, column, value) = REFUSED[mistake]
    settings = ImportSettings(units="mm" if "grad" in mistake else "mm,deg")
    with refused(MeasurementError, file="export.csv", line=line, column=column, value=value):
        imported(tmp_path, change(measured()), names, settings)


WARNED: dict[str, tuple[list[str], Callable[[Rows], Rows], str]] = {
    "angles of a rotation in rad": (
        [*NAMES, "W", "P", "R"],
        lambda rows: column(RADIANS, 9)(column(RADIANS, 9)(column(RADIANS, 9)(rows))),
        "line 2, column 'W'",
    ),
    "small angles of a rotation in rad": (
        [*NAMES, "W", "P", "R"],
        lambda rows: [[*row, "0.31", "-0.05", f"{0.02 * i:.2f}"] for i, row in enumerate(rows)],
        "line 2, column 'W'",
    ),
    "rows called means": (
        [*NAMES, "Mode"],
        lambda rows: [[*row, "single" if i % 2 else "mean"] for i, row in enumerate(rows)],
        "line 2, column 'Mode': 6 ",
    ),
    "no position": (
        NAMES,
        lambda rows: [*rows[:4], [*rows[4][:6], "0", "0", "0"], *rows[5:]],
        "line 6, column 'X'",
    ),
    "joints in rad": (
        NAMES,
        lambda rows: [[str(float(c) / 58) for c in row[:6]] + row[6:] for row in rows],
        "line ",
    ),
}


@pytest.mark.parametrize("mistake", WARNED)
def test_warned_of_with_line_and_column(tmp_path: Path, mistake: str):
    names, change, said = WARNED[mistake]
    (warning,) = imported(tmp_path, change(measured()), names).warnings
    assert said in warning
    assert ", column '" in warning


SUMMARIES: dict[str, tuple[list[str], Callable[[Rows], Rows], list[int]]] = {
    "named in front": (
        ["Point", *NAMES],
        lambda rows: [
            *([f"p{i}", *row] for i, row in enumerate(rows)),
            *([name, *means(rows)] for name in ("Mean", "Std. Dev.")),
        ],
        [14, 15],
    ),
    "named behind": (
        [*NAMES, "Note"],
        lambda rows: [*([*row, ""] for row in rows), [*means(rows), "Mittelwert"]],
        [14],
    ),
    "of the positions alone": (
        ["Point", *NAMES],
        lambda rows: [
            *([f"p{i}", *row] for i, row in enumerate(rows)),
            ["Average", *[""] * 6, *means(rows)[6:]],
        ],
        [14],
    ),
    "after every second row": (
        ["Point", *NAMES],
        lambda rows: [
            line
            for i in range(0, 12, 2)
            for line in (["a", *rows[i]], ["b", *rows[i + 1]], ["Mean", *means(rows[i : i + 2])])
        ],
        [4, 7, 10, 13, 16, 19],
    ),
    "of several kinds after every second row": (
        ["Point", *NAMES],
        lambda rows: [
            line
            for i in range(0, 12, 2)
            for line in (["a", *rows[i]], ["b", *rows[i + 1]], *([n, *rows[i]] for n in ("Avg.", "3 sigma")))
        ],
        [line for i in range(6) for line in (4 + 4 * i, 5 + 4 * i)],
    ),
    "in front without a name": (NAMES, lambda rows: [means(rows), *rows], [2]),
    "without a name": (NAMES, lambda rows: [*rows, means(rows)], [14]),
    "mean and largest without a name": (
        NAMES,
        lambda rows: [*rows, means(rows), [f"{max(float(row[k]) for row in rows):.4f}" for k in range(9)]],
        [14, 15],
    ),
}


@pytest.mark.parametrize("case", SUMMARIES)
def test_summaries_are_left_out_and_listed(tmp_path: Path, case: str):
    names, change, lines = SUMMARIES[case]
    result = imported(tmp_path, change(measured()), names)
    assert [row.line for row in result.left_out] == lines
    assert result.row_count == 12
    assert "line" in " ".join(result.sentences)


def test_a_commanded_centre_is_not_a_mean(tmp_path: Path):
    """For example, a robot moves by the same amounts to both sides of a pose at which it starts."""
    rows = [
        ["0.0"] * 9,
        *([f"{sign * (10 + i + k)}.0" for k in range(9)] for i in range(3) for sign in (1, -1)),
    ]
    assert imported(tmp_path, rows, NAMES).row_count == 7


def test_unambiguous_dates_are_read_in_any_order(tmp_path: Path):
    for first, second in (("13/02/2026", "1/2/2026"), ("13.02.2026 10:31", "01.02.26"), ("2026-02-13", "")):
        rows = column([first] * 11 + [second], 9)(measured())
        days = [row[9] for row in imported(tmp_path, rows, [*NAMES, "Date"]).measurement_table.table.records]
        assert days == ["2026-02-13"] * 11 + (["2026-02-01"] if second else [""])
    with refused(MeasurementError, line=2, column="Date", value="02/03/2026"):
        imported(tmp_path, column(["02/03/2026"] * 12, 9)(measured()), [*NAMES, "Date"])


def test_measurements_named_like_a_statistic_in_every_row_are_kept(tmp_path: Path):
    rows = [[*row, "mean"] for row in measured()]
    assert imported(tmp_path, rows, [*NAMES, "mode"]).row_count == 12


def test_lines_of_numbers_around_the_table_are_listed(tmp_path: Path):
    path = tmp_path / "export.csv"
    table = "\n".join(",".join(row) for row in [NAMES, *measured()])
    path.write_text(
        f"station,1.5,2.5,3.5\ntracker of cell 7\n{table}\n#{','.join(measured()[0])}\n24,points\n"
    )
    result = import_rows([path], STATED)
    assert [row.line for row in result.left_out] == [1, 16, 17]
    assert result.to_json()["files"] == [
        {"file": str(path), "rows_read": 15, "rows_used": 12, "rows_left_out": 3}
    ]
    path.write_text(f"{','.join(NAMES)}\n12.5\n" + "\n".join(",".join(row) for row in measured()))
    assert [row.line for row in import_rows([path], STATED).left_out] == [2]


def test_a_stated_first_column_does_not_change_the_order_of_others(tmp_path: Path):
    settings = ImportSettings(units="mm,deg", maps=({"1": "time_s"},))
    result = imported(tmp_path, column(TIMES)(measured()), None, settings)
    assert result.measurement_table.table.header[0] == "q1_deg"
    assert result.measurement_table.table.records == measured()
    last = ImportSettings(units="mm,deg", maps=({"10": "time_s"},))
    assert (
        imported(tmp_path, column(TIMES, 9)(measured()), None, last).measurement_table.table.records
        == measured()
    )
    seven = imported(
        tmp_path, column(TIMES)(measured()), None, ImportSettings(units="mm,deg", maps=({"1": "q1_deg"},))
    )
    assert seven.measurement_table.table.header[6] == "q7_deg"


def test_a_joint_that_moves_in_steps_is_not_a_time(tmp_path: Path):
    rows = [[str(-10 * (i // 8)), *row[1:]] for i, row in enumerate(measured(40))]
    assert imported(tmp_path, rows, None).row_count == 40


def test_a_file_that_is_given_twice_is_refused(tmp_path: Path):
    path = tmp_path / "export.csv"
    path.write_text("\n".join(",".join(row) for row in [NAMES, *measured()]))
    with refused(MeasurementError, file="export.csv", line=None):
        import_rows([path, tmp_path / "." / "export.csv"], STATED)
