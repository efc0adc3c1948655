"""Solutions of the corrected inverse kinematics as records, tables and files."""

import csv
import io
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pisigma.correction.solution import Solution
from pisigma.export.output_file import write_whole
from pisigma.kinematics.status import Status
from pisigma.robot.description import Robot

_QUANTITIES = ("q", "q_nominal", "correction")
_FAILURES = (Status.UNREACHABLE, Status.OUTSIDE_JOINT_LIMITS, Status.SINGULAR)
_LISTED = 10


def solution_records(solution: Solution, robot: Robot) -> list[dict[str, Any]]:
    """One record per solution: status, joint values, branch.

    A robot whose joints all turn gets `q_deg`, `q_nominal_deg`, `correction_deg` as lists; with a prismatic
    joint `q`, `q_nominal`, `correction` are lists of `{"joint", "value", "unit"}`. What is not known is None.
    """
    records = []
    measures = solution.domain_measure.tolist()
    for row, status in enumerate(_statuses(solution)):
        record: dict[str, Any] = {"status": status.name.lower(), "sentence": status.sentence}
        for name in _QUANTITIES:
            values = [_or_none(v) for v in _in_file_units(getattr(solution, name)[row].tolist(), robot)]
            if all(robot.revolute):
                record[f"{name}_deg"] = values
            else:
                record[name] = [
                    {"joint": joint.name, "value": value, "unit": unit}
                    for joint, value, unit in zip(robot.joints, values, _units(robot), strict=True)
                ]
        record["branch"] = solution.branches[int(solution.branch[row])]
        record["domain_measure"] = _or_none(measures[row])
        records.append(record)
    return records


def print_solutions(solution: Solution, robot: Robot) -> None:
    """Print a table per solution."""
    from pisigma.cli.output import print_table

    for row, status in enumerate(_statuses(solution)):
        values = [_in_file_units(getattr(solution, name)[row].tolist(), robot) for name in _QUANTITIES]
        lines = [
            (joint.name, *(f"{value:.6f}" for value in figures), unit)
            for joint, unit, *figures in zip(robot.joints, _units(robot), *values, strict=True)
        ]
        title = f"{status.name.lower()}, branch {solution.branches[int(solution.branch[row])]}"
        print_table(title, ("joint", "corrected", "nominal", "correction", "unit"), lines)
        print(status.sentence)


def count_statuses(solution: Solution) -> dict[str, int]:
    """How many solutions have which status, most frequent first."""
    return dict(Counter(status.name.lower() for status in _statuses(solution)).most_common())


def write_joints(solution: Solution, robot: Robot, path: Path) -> None:
    """Write one row per pose, whole or not at all: status, branch, corrected and nominal joint values.

    Raises:
        OutputError: the file cannot be written there.
    """
    units = _units(robot)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    commanded = [f"q{i}_{unit}" for i, unit in enumerate(units, 1)]
    writer.writerow(
        ["status", "branch", *commanded, *(f"q{i}_nominal_{unit}" for i, unit in enumerate(units, 1))]
    )
    joints = zip(solution.q.tolist(), solution.q_nominal.tolist(), strict=True)
    for status, branch, both in zip(_statuses(solution), solution.branch.tolist(), joints, strict=True):
        cells = ["" if math.isnan(v) else repr(v) for part in both for v in _in_file_units(part, robot)]
        writer.writerow([status.name.lower(), solution.branches[branch], *cells])
    write_whole(path, text.getvalue())


def failure(solution: Solution, places: Sequence[str], any_will_do: bool) -> str | None:
    """Say which poses the robot cannot take as asked; None where it can take all.

    Args:
        solution: the solutions.
        places: what to call each of them.
        any_will_do: one that reaches is enough (all branches of one pose).
    """
    statuses = _statuses(solution)
    failed = [row for row, status in enumerate(statuses) if status in _FAILURES]
    if not failed or (any_will_do and len(failed) < len(statuses)):
        return None
    others = failed[1:]
    more = "; ".join(
        f"{places[row].rsplit(', ', 1)[-1]} {statuses[row].name.lower()}" for row in others[:_LISTED]
    )
    rest = f"; and {len(others) - _LISTED} more" if len(others) > _LISTED else ""
    also = f" (Also: {more}{rest}.)" if others else ""
    status = statuses[failed[0]]
    return f"{places[failed[0]]}: {status.name.lower()}. {status.sentence}{also}"


def _statuses(solution: Solution) -> list[Status]:
    return [Status(status) for status in solution.status.tolist()]


def _units(robot: Robot) -> list[str]:
    return ["deg" if revolute else "mm" for revolute in robot.revolute]


def _in_file_units(values: Sequence[float], robot: Robot) -> list[float]:
    return [
        math.degrees(v) if revolute else v * 1e3 for v, revolute in zip(values, robot.revolute, strict=True)
    ]


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
