"""Tables 2 to 10 of the paper compared with ours, as rows of text."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Table:
    """A table ready to print.

    Attributes:
        title: What it shows, and the tables of the paper that it reproduces.
        columns: Headings.
        rows: Cells.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def all_tables(report: Mapping[str, Any]) -> tuple[Table, ...]:
    """Return all tables of a report from `report_jigs`."""
    tables = [parameter_table(report), error_table(report), component_table(report), seed_table(report)]
    if any(report["lines"].values()):
        tables.append(line_table(report))
    return tuple(tables)


def parameter_table(report: Mapping[str, Any]) -> Table:
    """Return Table 2: estimated parameters."""
    rows = report["parameters"]
    ours = [name for name in rows[0] if name not in ("name", "unit", "paper")]
    published = list(rows[0]["paper"])
    counts = report["parameters_estimated"]
    heads = [f"{name} ({counts[name]})" if name in counts else name for name in ours]
    cells = tuple(
        (
            row["name"],
            row["unit"],
            *(_cell(row[name]) for name in ours),
            *(_cell(row["paper"][name]) for name in published),
        )
        for row in rows
    )
    columns = ("parameter", "unit", *heads, *(f"paper, {name}" for name in published))
    return Table("Estimated parameters (Table 2; number of estimated parameters in brackets)", columns, cells)


def error_table(report: Mapping[str, Any]) -> Table:
    """Return Tables 3 to 7: RMS and deviation at the test points, and over the workspace."""
    published = report["paper"].get("absolute_error_mm", {})
    rows = []
    for name, figures in report["accuracy"].items():
        seen = {"robot frame": figures["robot_frame"]}
        seen |= {f"seen from {jig}": value for jig, value in figures["seen_from"].items()}
        for where, value in seen.items():
            key = name if where == "robot frame" else f"{name}_{where.replace(' ', '_')}"
            paper = published.get(key, {})
            workspace = figures["workspace"] if where == "robot frame" else {}
            rows.append(
                (
                    name,
                    where,
                    _cell(value["rms_mm"]),
                    _cell(value["deviation_mm"]),
                    _cell(paper.get("rms")),
                    _cell(paper.get("deviation")),
                    *(_cell(workspace.get(f"{part}_mm")) for part in ("median", "p95", "max")),
                )
            )
    columns = (
        "parameters",
        "seen in",
        "RMS",
        "deviation",
        "paper: RMS",
        "paper: deviation",
        "workspace: median",
        "95 %",
        "maximum",
    )
    return Table("Absolute error [mm] (Tables 3 to 7)", columns, tuple(rows))


def component_table(report: Mapping[str, Any]) -> Table:
    """Return Tables 3 to 7 in full: x, y and z errors at every test point."""
    published = report["paper"].get("absolute_error_mm", {})
    rows, points = [], 0
    for name, figures in report["accuracy"].items():
        seen = {name: figures["robot_frame"]}
        seen |= {f"{name}_seen_from_{jig}": value for jig, value in figures["seen_from"].items()}
        for key, value in seen.items():
            points = len(value["points_mm"])
            for axis, label in enumerate("xyz"):
                if key in published:
                    ours = [_cell(point[axis]) for point in value["points_mm"]]
                    theirs = [_cell(number) for number in published[key].get(label, [None] * points)]
                    rows.append((key.replace("_", " "), label, *ours, *theirs))
    heads = [f"P{place + 1}" for place in range(points)]
    columns = ("parameters", "error", *heads, *(f"paper: {head}" for head in heads))
    return Table("Errors at the test points [mm] (Tables 3 to 7)", columns, tuple(rows))


def seed_table(report: Mapping[str, Any]) -> Table:
    """Return Table 8: averages over the seeds, and their ratios."""
    seeds = report["seeds"]
    figures = ("rms", "deviation", "mean", "workspace_median", "workspace_rms")
    rows = [
        (name, *(_cell(values[f"{figure}_mm"]) for figure in figures), "")
        for name, values in seeds["averages"].items()
    ]
    rows += [
        (
            name.replace("_", " "),
            *(_cell(values[figure]) for figure in figures),
            _published_ratio(report, name),
        )
        for name, values in seeds["ratios"].items()
    ]
    columns = (
        "parameters",
        "RMS",
        "deviation",
        "mean distance",
        "workspace: median",
        "workspace: RMS",
        "paper",
    )
    title = f"Averages over {seeds['count']} seeds [mm], robot frame, and their ratios (Table 8)"
    return Table(title, columns, tuple(rows))


def line_table(report: Mapping[str, Any]) -> Table:
    """Return Tables 9 and 10: straight lines."""
    published = report["paper"].get("lines_mm", {})
    rows = []
    for setup, lines in report["lines"].items():
        for name, line in lines.items():
            off, paper = line["move_l"]["deviation_mm"], published.get(setup, {}).get(name, {})
            rows.append(
                (
                    setup,
                    name,
                    _cell(line["i_move"]["length_error_mm"]),
                    *(_cell(off[axis]) for axis in "xyz"),
                    _cell(line["move_l"]["largest_across_mm"]),
                    *(_cell(paper.get(key)) for key in ("length", "x", "y")),
                )
            )
    columns = (
        "parameters",
        "line",
        "I-Move dL",
        "Move-L dX",
        "dY",
        "dZ",
        "across",
        "paper: dL",
        "paper: dX",
        "paper: dY",
    )
    return Table("Straight lines [mm] (Tables 9 and 10)", columns, tuple(rows))


def _published_ratio(report: Mapping[str, Any], name: str) -> str:
    table = report["paper"].get("table_8_mm", {})
    if name != "both_over_single" or not table:
        return ""
    mean, spread = (table["both"][key] / table["one_jig"][key] for key in ("mean", "deviation"))
    return f"RMS {mean:.2f}, deviation {spread:.2f}"


def _cell(value: float | int | None) -> str:
    return "" if value is None else f"{value:.3f}" if value else "0"
