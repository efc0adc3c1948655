"""Redundant parameters of the RB5 and the Panda compared with Park et al. 2022, Tables 1 to 10."""

import math
from typing import Any

import numpy as np

from markdown_text import command_block, folded, picture, plain, scientific
from pisigma.reporting.tables import markdown_table
from pisigma.robot.description import Robot
from published import CorrelationTriangle, DhTable, Published
from stored_results import Result, StoredResults

RMSE_BY_ITERATION = "rmse_by_iteration.png"

ROBOTS = {"rb5": "RB5", "panda": "Panda"}

_REDUNDANT = 1 - 1e-6
_SUMMARY = (
    "parameters",
    "remaining after pairwise elimination",
    "exact rank",
    "without effect",
    "iterations to convergence (ours: steps tried)",
    "RMSE after [mm]",
)
_COLUMNS = ("theta_deg", "d_mm", "a_mm", "alpha_deg", "beta_deg")


def redundancy_sections(published: Published, results: StoredResults) -> list[str]:
    """Return the sections of both recipes."""
    text = [
        command_block(*(f"{robot}_redundancy" for robot in ROBOTS)),
        _summary(published, results),
        *(published.notes[f"{robot}_redundancy"] for robot in ROBOTS),
        "### DH parameters of the RB5 and the Panda",
        *(line for robot in ROBOTS for line in dh_lines(robot, ROBOTS[robot], published.dh_tables[robot])),
    ]
    for robot, title in ROBOTS.items():
        found = results[f"{robot}_redundancy"]
        text += [f"### Correlations of the {title}", *_correlations(robot, title, published, found)]
    text.append(
        picture(RMSE_BY_ITERATION, "RMSE over iterations of the RB5 and the Panda, ours and the paper's")
    )
    for robot, title in ROBOTS.items():
        found = results[f"{robot}_redundancy"]
        text += [f"### Convergence of the {title}", *_convergence(robot, published, found)]
        text += [f"### Redundant sums of the {title}", *_sums(robot, published, found)]
    return text


def _summary(published: Published, results: StoredResults) -> str:
    """Return a table of redundancy and convergence of both robots, ours and the paper's."""
    columns = []
    for robot in ROBOTS:
        found, sums = results[f"{robot}_redundancy"], published.redundant_sums[robot]
        paper = found["paper"]
        columns.append(
            (
                found["elimination_cases"][-1]["parameters"],
                found["pairwise_parameters"],
                found["rank"],
                ", ".join(found["no_effect"]),
                found["iterations"],
                scientific(found["rmse_mm"][-1]),
            )
        )
        columns.append(
            (
                sums.parameters[-1],
                paper["pairwise_parameters"],
                "not stated",
                ", ".join(paper["no_effect"]),
                paper["iterations_to_converge"],
                scientific(paper["rmse_after_mm"]),
            )
        )
    head = ["quantity", *(f"{title}, {whose}" for title in ROBOTS.values() for whose in ("ours", "paper"))]
    rows = [(what, *map(str, cells)) for what, *cells in zip(_SUMMARY, *columns, strict=True)]
    return markdown_table(head, rows)


def _sets(sets: list[list[str]]) -> str:
    return "; ".join(", ".join(members) for members in sets)


def dh_lines(robot: str, title: str, table: DhTable) -> list[str]:
    """Return a published DH table compared with the catalogue's: one value per cell if both are equal."""
    found = Robot.load(robot)
    factors = [1e3 if column.endswith("_mm") else math.degrees(1.0) for column in _COLUMNS]
    ours = found.dh * np.array(factors)
    rows, different = [], 0
    for index, row in enumerate(found.rows):
        cells = [row.name]
        for place, column in enumerate(_COLUMNS):
            paper, own = getattr(table, column)[index], float(ours[index][place])
            same = abs(own - paper) < 1e-9
            different += not same
            cells.append(plain(paper) if same else f"{plain(paper)} / {plain(own)}")
        rows.append(tuple(cells))
    verdict = "all values agree" if different == 0 else f"{different} values differ (paper / ours)"
    head = ["row", *(column.replace("_deg", " [deg]").replace("_mm", " [mm]") for column in _COLUMNS)]
    return [
        f"The following table compares Table {table.table} ({title}) with `pisigma/robot/catalogue/{robot}.yaml`: "
        f"{verdict}.",
        markdown_table(head, rows),
    ]


def _correlations(robot: str, title: str, published: Published, result: Result) -> list[str]:
    lines = [
        f"Our redundant sets are {_sets(result['redundant_sets'])}; those of the paper are "
        f"{_sets(result['paper']['redundant_sets'])}."
    ]
    stated = published.correlations[robot]
    for kind, table in (("lengths", stated.lengths), ("angles", stated.angles)):
        ours = result["correlations"][kind]
        lines.append(_compared(table, ours, kind))
        summary = f"Table {table.table}, {title}, {kind}: the paper's above the diagonal, ours below"
        lines.append(folded(summary, _both_triangles(table, ours)))
    return lines


def _compared(table: CorrelationTriangle, ours: dict[str, Any], kind: str) -> str:
    """Return sentences on which correlations agree and how far the others differ."""
    assert list(table.names) == ours["names"]
    paper = np.full((len(table.names),) * 2, np.nan)
    for index, row in enumerate(table.lower):
        paper[index, : index + 1] = [np.nan if value is None else value for value in row]
    own = np.array(ours["values"], dtype=np.float64)
    below = np.tril_indices(len(own), -1)
    theirs, values = paper[below], own[below]
    known = np.isfinite(theirs) & np.isfinite(values)
    pairs = np.abs(theirs[known]) == 1, np.abs(values[known]) >= _REDUNDANT
    other = ~(pairs[0] | pairs[1])
    same_pairs = bool((pairs[0] == pairs[1]).all()) and bool(
        (np.sign(theirs[known][pairs[0]]) == np.sign(values[known][pairs[0]])).all()
    )
    same_none = bool((np.isfinite(theirs) == np.isfinite(values)).all())
    apart = np.abs(theirs[known] - values[known])[other]
    largest = [float(np.abs(part[known][other]).max()) for part in (theirs, values)]
    return (
        f"In Table {table.table} ({kind}), {int(pairs[0].sum())} pairs are at ±1 in the paper and "
        f"{int(pairs[1].sum())} here, "
        f"{'which are the same, with the same signs' if same_pairs else 'which are not the same'}, and the parameters "
        f"without effect are {'the same' if same_none else 'not the same'}. The correlations of the other "
        f"{int(other.sum())} pairs depend on the poses; ours differ from the paper's by {np.median(apart):.3f} "
        f"(median) and by at most {apart.max():.3f}. The largest absolute correlation among these pairs is "
        f"{largest[0]:.3f} in the paper and {largest[1]:.3f} here."
    )


def _both_triangles(table: CorrelationTriangle, ours: dict[str, Any]) -> str:
    rows = []
    for index, name in enumerate(table.names):
        paper = [table.lower[column][index] for column in range(index + 1, len(table.names))]
        cells = [*ours["values"][index][:index], *paper]
        texts = ["NaN" if value is None else f"{value:.3f}" for value in cells]
        rows.append((name, *texts[:index], "·", *texts[index:]))
    return markdown_table(["", *table.names], rows)


def _convergence(robot: str, published: Published, result: Result) -> list[str]:
    table = published.convergence[robot]
    cases = result["elimination_cases"]
    paper = dict(zip(table.iterations, table.rmse_mm, strict=True))
    steps = max(len(case["rmse_mm"]) for case in cases)
    rows = []
    for iteration in sorted({*paper, *range(steps)}):
        theirs = (
            [scientific(value) for value in paper[iteration]] if iteration in paper else [""] * len(cases)
        )
        own = [scientific(c["rmse_mm"][iteration]) if iteration < len(c["rmse_mm"]) else "" for c in cases]
        rows.append((str(iteration), *theirs, *own))
    names = [*(f"case {number}" for number in range(1, len(cases))), "none"]
    head = ["iteration", *(f"paper: {name}" for name in names), *(f"ours: {name}" for name in names)]
    held_out = max(case["held_out_rms_mm"] for case in cases)
    return [
        f"As in Table {table.table}, the following table shows the RMSE [mm] at the 40 poses by the number of accepted "
        f"steps; our fits stop at convergence. The cases are those of Table {published.redundant_sums[robot].table} "
        f"below. At 2000 other poses our errors are at most {scientific(held_out)} mm RMS in all cases.",
        markdown_table(head, rows),
    ]


def _sums(robot: str, published: Published, result: Result) -> list[str]:
    table = published.redundant_sums[robot]
    factor = 1.0 if table.unit == "mm" else math.radians(1.0)
    digits = ".3f" if table.unit == "mm" else ".6f"
    rows = []
    for index, case in enumerate(result["elimination_cases"]):
        own = [case["values"][name] * factor for name in table.members]
        rows.append(
            (
                ", ".join(case["removed"]) or "none",
                str(table.parameters[index]),
                *(plain(value) for value in (*table.values[index], table.sums[index])),
                str(case["parameters"]),
                *(f"{value:{digits}}" for value in (*own, sum(own))),
            )
        )
    names = ["parameters", *(f"{name}" for name in table.members), "sum"]
    head = ["eliminated", *(f"paper: {name}" for name in names), *(f"ours: {name}" for name in names)]
    true = sum(result["true_values"][name] for name in table.members) * factor
    return [
        f"As in Table {table.table}, the following table shows values after calibration [{table.unit}]; the sum does "
        f"not depend on which parameter is kept. In our true robot it is {true:{digits}}; the paper's true robot has "
        f"another value.",
        markdown_table(head, rows),
    ]
