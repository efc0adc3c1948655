"""Solutions of the corrected inverse kinematics as records and tables."""

import math
from collections.abc import Sequence
from typing import Any

from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.inverse.solution import Solution
from pisigma.reporting.solution_text import FAILURES, QUANTITIES, file_units, in_file_units, statuses_of

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


def failure(solution: Solution, places: Sequence[str], one_suffices: bool) -> str | None:
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
