"""Solutions of the corrected inverse kinematics as text."""

import math
from collections.abc import Sequence
from typing import Any

from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.inverse.solution import Solution
from pisigma.reporting.result_text import Block, ResultText, sentence_block, table_block
from pisigma.reporting.verdict import Verdict, uncapitalised
from pisigma.robot.kinematics.status import Status

QUANTITIES = ("q", "q_nominal", "correction")
"""Joint values of a solution."""

FAILURES = tuple(status for status in Status if status not in (Status.REACHED, Status.OUTSIDE_DOMAIN))
"""Statuses that end a command with exit status 2."""

_TRUST = {Status.REACHED: "yes", Status.OUTSIDE_DOMAIN: "with caution"}
"""Whether to trust joint values with a status; no for all others."""


def solution_text(solution: Solution, solver: CorrectedIK) -> ResultText:
    """Return joint values with meanings of statuses and warnings as text; several solutions form one table."""
    statuses = statuses_of(solution)
    names = [solution.branches[int(branch)] for branch in solution.branch.tolist()]
    reached = sum(status not in FAILURES for status in statuses)
    found = (
        f"{reached} of {len(statuses)} solutions reach" if len(statuses) > 1 else f"branch {names[0]} reaches"
    )
    trust = " ".join(f"{status.name.lower()}: {status.sentence}" for status in dict.fromkeys(statuses))
    if len(set(statuses)) == 1:
        trust = f"{_TRUST.get(statuses[0], 'no')}: {uncapitalised(statuses[0].sentence)}"
    verdict = Verdict(
        f"{found} the pose." if reached else "the pose is not reached.",
        trust,
        "command the corrected values, not the nominal ones." if reached else "",
        "Solution",
    )
    axes = ", ".join(solution.ignored_axes)
    remarks = sentence_block("ignored axes", [f"Ignored axes of the tool: {axes}."] if axes else [])
    tables = _one(solution, solver, names[0]) if len(statuses) == 1 else _several(solution, solver, names)
    return ResultText(verdict, tuple(solver.warnings), (remarks, tables) if reached else ())


def _one(solution: Solution, solver: CorrectedIK, branch: str) -> Block:
    """Lay out the joint values of a solution."""
    values = [in_file_units(getattr(solution, name)[0].tolist(), solver) for name in QUANTITIES]
    rows = [
        (joint, unit, *(f"{value:.4f}" for value in figures))
        for joint, unit, *figures in zip(solver.joints, file_units(solver), *values, strict=True)
    ]
    return table_block(
        f"joint values, branch {branch}", ("joint", "unit", "corrected", "nominal", "correction"), rows
    )


def _several(solution: Solution, solver: CorrectedIK, branches: Sequence[str]) -> Block:
    """Lay out the corrected joint values of several solutions."""
    units = dict.fromkeys(file_units(solver))
    rows = [
        (name, *(f"{value:.3f}" for value in in_file_units(q, solver)))
        for name, q in zip(branches, solution.q.tolist(), strict=True)
    ]
    title = f"corrected joint values [{' or '.join(units)}]; --json has nominal values and corrections too"
    return table_block(title, ("branch", *solver.joints), rows)


def statuses_of(solution: Solution) -> list[Status]:
    """Return the status of every solution."""
    return [Status(status) for status in solution.status.tolist()]


def file_units(solver: CorrectedIK) -> list[str]:
    """Return the unit of every joint in files: "deg" or "mm"."""
    return ["deg" if revolute else "mm" for revolute in solver.revolute]


def in_file_units(values: Sequence[float], solver: CorrectedIK) -> list[float]:
    """Return joint values in the units of `file_units`."""
    return [
        math.degrees(v) if revolute else v * 1e3 for v, revolute in zip(values, solver.revolute, strict=True)
    ]


_LISTED = 10


def solution_records(solution: Solution, solver: CorrectedIK) -> list[dict[str, Any]]:
    """Return one record per solution: status, joint values, branch.

    For a robot with revolute joints only, `q_deg`, `q_nominal_deg`, `correction_deg` are lists; with a prismatic
    joint `q`, `q_nominal`, `correction` are lists of `{"joint", "value", "unit"}`. Unknown values are None.
    """
    records = []
    measures = solution.domain_measure.tolist()
    for row, status in enumerate(statuses_of(solution)):
        record: dict[str, Any] = {"status": status.name.lower(), "sentence": status.sentence}
        for name in QUANTITIES:
            values = [_or_none(v) for v in in_file_units(getattr(solution, name)[row].tolist(), solver)]
            if all(solver.revolute):
                record[f"{name}_deg"] = values
            else:
                record[name] = [
                    {"joint": joint, "value": value, "unit": unit}
                    for joint, value, unit in zip(solver.joints, values, file_units(solver), strict=True)
                ]
        record["branch"] = solution.branches[int(solution.branch[row])]
        record["domain_measure"] = _or_none(measures[row])
        record["position_residual_mm"] = _or_none(float(solution.position_residual[row]) * 1e3)
        record["rotation_residual_deg"] = _or_none(math.degrees(solution.rotation_residual[row]))
        record["ignored_axes"] = list(solution.ignored_axes)
        records.append(record)
    return records


def failure_sentence(solution: Solution, places: Sequence[str], one_suffices: bool) -> str | None:
    """Return a sentence about poses that the robot cannot reach as requested; None if it reaches all.

    Args:
        solution: the solutions.
        places: name of the pose of every solution.
        one_suffices: whether one solution that reaches the pose is enough (all branches of one pose).
    """
    statuses = statuses_of(solution)
    failed = [row for row, status in enumerate(statuses) if status in FAILURES]
    if not failed or (one_suffices and len(failed) < len(statuses)):
        return None
    others = failed[1:]
    more = "; ".join(
        f"{places[row].rsplit(', ', 1)[-1]} {statuses[row].name.lower()}" for row in others[:_LISTED]
    )
    rest = f"; and {len(others) - _LISTED} more" if len(others) > _LISTED else ""
    also = f" (Also: {more}{rest}.)" if others else ""
    status = statuses[failed[0]]
    return f"{places[failed[0]]}: {status.name.lower()}. {status.sentence}{also}"


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
