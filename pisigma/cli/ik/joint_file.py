"""Compute the joint values of a file of poses, and write them some rows at a time."""

import csv
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pisigma.files.output_file import open_atomically
from pisigma.measurement.csv.poses import CHUNK_ROWS, PoseChunk, read_pose_chunks
from pisigma.measurement.fields import UnusableRow
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.inverse.path import PathSwitch
from pisigma.model.inverse.solution import Solution
from pisigma.reporting.solution_text import FAILURES, file_units
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.status import Status

_BAD_ROW = "bad_row"
"""Status of a row that is not a pose."""

FAR = 50.0
"""Multiple of the reach beyond which a position is refused; with a wrong length unit, positions are 1,000 times too
large."""

_LISTED = 10
"""Largest number of failed rows that are listed."""

_MEASURES = ("position_residual_mm", "rotation_residual_deg", "domain_measure")
_ACCURACY = "accuracy_mm"


@dataclass(frozen=True)
class FailedRow:
    """A row without joint values that can be commanded.

    Attributes:
        line: line in the file of poses.
        status: `bad_row`, or the name of a `Status` in lower case.
        reason: what is wrong with the row, and how to correct it.
    """

    line: int
    status: str
    reason: str


@dataclass
class PoseFileResult:
    """Outcome of solving the poses of a file.

    Attributes:
        rows: number of rows.
        statuses: numbers of rows by status.
        first_failed: the first `_LISTED` rows that failed, in the order of the file.
        failed: number of rows that failed.
        switches: lines at which a path changes its branch or is interrupted, with a description.
    """

    rows: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    first_failed: list[FailedRow] = field(default_factory=list)
    failed: int = 0
    switches: list[tuple[int, PathSwitch]] = field(default_factory=list)

    def to_json(self, path: bool) -> dict[str, object]:
        """Return the counts and the first failures as plain values, with the switches of a path."""
        values: dict[str, object] = {
            "rows": self.rows,
            "statuses": dict(self.statuses.most_common()),
            "failed": self.failed,
            "first_failures": [asdict(row) for row in self.first_failed],
        }
        switches = [{"line": line, "kind": at.kind, "sentence": at.sentence} for line, at in self.switches]
        return values | ({"switches": switches} if path else {})

    def problem(self, source: Path) -> str | None:
        """Return a sentence about rows that failed and the reasons; None if no row failed."""
        if not self.failed:
            return None
        first, *others = self.first_failed
        more = [
            f"line {row.line} {row.status}" + (f" ({row.reason})" if row.status == _BAD_ROW else "")
            for row in others
        ]
        if self.failed > len(self.first_failed):
            more.append(f"and {self.failed - len(self.first_failed)} more")
        also = f" (Also: {'; '.join(more)}.)" if more else ""
        return f"{source}, line {first.line}: {first.status}. {first.reason.rstrip('.')}.{also}"


def write_joint_file(
    solver: CorrectedIK,
    poses: Path,
    out: Path,
    branch: str | None,
    report_progress: Callable[[str], None],
    accuracy: bool = False,
    is_path: bool = False,
) -> PoseFileResult:
    """Write one row per pose of a file of any length, completely or not at all.

    A row contains the line of the pose, status, branch, corrected and nominal joint values, the residuals of the
    calibrated model, the domain measure and, with `accuracy`, the predicted standard deviation of the tool's position.
    Unknown values are empty. A row that is not a pose gets the status `bad_row` and does not stop the command.

    Args:
        solver: the corrected inverse kinematics.
        poses: the file of poses.
        out: the file of joint values.
        branch: name of the branch to use instead of the default.
        report_progress: callback for progress, such as "40,000 rows, 4%, 9,000 rows/s".
        accuracy: whether to predict the standard deviations, which takes most of the time with a hybrid.
        is_path: whether the poses are a path, which is solved as a whole and in memory; see `CorrectedIK.path`.

    Raises:
        MeasurementError: the file of poses or its header cannot be used.
        OutputError: the file cannot be written there.
        PoseError: the branch is unknown.
    """
    outcome, begun = PoseFileResult(), time.monotonic()
    with open_atomically(out) as file:
        writer = csv.writer(file, lineterminator="\n")
        header = _header(solver, accuracy)
        writer.writerow(header)
        for chunk in read_pose_chunks(poses, sys.maxsize if is_path else CHUNK_ROWS):
            chunk_rows = _solved_rows(solver, chunk, branch, accuracy, outcome, is_path)
            writer.writerows(cells + [""] * (len(header) - len(cells)) for cells in chunk_rows)
            rate = outcome.rows / max(time.monotonic() - begun, 1e-3)
            share = "" if math.isnan(chunk.read_fraction) else f", {100 * chunk.read_fraction:.0f} %"
            report_progress(f"{outcome.rows:,} rows{share}, {rate:,.0f} rows/s")
    return outcome


def _header(solver: CorrectedIK, accuracy: bool) -> list[str]:
    units = file_units(solver)
    joints = [f"q{i}_{unit}" for i, unit in enumerate(units, 1)]
    nominal = [f"q{i}_nominal_{unit}" for i, unit in enumerate(units, 1)]
    return ["line", "status", "branch", *joints, *nominal, *_MEASURES, *((_ACCURACY,) if accuracy else ())]


def _solved_rows(
    solver: CorrectedIK,
    chunk: PoseChunk,
    branch: str | None,
    accuracy: bool,
    outcome: PoseFileResult,
    path: bool,
) -> Iterator[list[str]]:
    """Return the first cells of the rows of a chunk, in the order of the file, and count them in the outcome."""
    too_far = _too_far(chunk, solver.model.robot)
    near = [line for line, far in zip(chunk.line, too_far, strict=True) if not far]
    bad = [
        *chunk.invalid_rows,
        *(UnusableRow(line, far) for line, far in zip(chunk.line, too_far, strict=True) if far),
    ]
    rows = [(row.line, [str(row.line), _BAD_ROW]) for row in bad]
    failed = [FailedRow(row.line, _BAD_ROW, row.reason) for row in bad]
    if near:
        kept = torch.tensor([not far for far in too_far])
        solution, switches = _solve(solver, chunk.T[kept], branch, path)
        outcome.switches.extend((near[switch.index], switch) for switch in switches)
        rows.extend(zip(near, _cells(solution, near, solver, accuracy), strict=True))
        statuses = [Status(status) for status in solution.status.tolist()]
        outcome.statuses.update(status.name.lower() for status in statuses)
        failed.extend(
            FailedRow(line, status.name.lower(), status.sentence)
            for line, status in zip(near, statuses, strict=True)
            if status in FAILURES
        )
    outcome.statuses.update([_BAD_ROW] * len(bad))
    outcome.rows += len(rows)
    outcome.failed += len(failed)
    failed.sort(key=lambda row: row.line)
    outcome.first_failed.extend(failed[: _LISTED - len(outcome.first_failed)])
    return (cells for _, cells in sorted(rows, key=lambda row: row[0]))


def _solve(
    solver: CorrectedIK, T: Tensor, branch: str | None, path: bool
) -> tuple[Solution, Sequence[PathSwitch]]:
    """Solve poses of a file, one by one or as a path."""
    if path:
        followed = solver.path(T.numpy(), branch=branch)
        return followed.solution, followed.switches
    return solver(T.numpy(), branch=branch), ()


def _too_far(chunk: PoseChunk, robot: Robot) -> list[str]:
    """Return for every pose the reason why it is too far away for the robot; "" if it is not."""
    distance = (chunk.T[:, :3, 3] - torch.from_numpy(robot.base[:3].copy())).norm(dim=-1)
    reasons = [""] * len(chunk.line)
    for row in (distance > FAR * robot.reach).nonzero()[:, 0].tolist() if robot.reach > 0 else []:
        times = float(distance[row]) / robot.reach
        reasons[row] = (
            f"columns 'x' to 'z': the position is {float(distance[row]):.4g} m from the base, {times:.3g} times the "
            f"reach of robot '{robot.name}'; check the unit (millimetres in a _m column?)"
        )
    return reasons


def _cells(
    solution: Solution, lines: Sequence[int], solver: CorrectedIK, accuracy: bool
) -> Iterator[list[str]]:
    """Return the cells of solved poses; unknown values are empty."""
    file_units_per_si = np.array([180 / math.pi if revolute else 1e3 for revolute in solver.revolute])
    joints = np.concatenate([np.asarray(q) * file_units_per_si for q in (solution.q, solution.q_nominal)], -1)
    measures = [
        np.asarray(solution.position_residual) * 1e3,
        np.rad2deg(np.asarray(solution.rotation_residual)),
        np.asarray(solution.domain_measure),
        *([np.asarray(solution.accuracy) * 1e3] if accuracy else []),
    ]
    exact = (["" if v != v else repr(v) for v in row] for row in joints.tolist())
    short = (["" if v != v else f"{v:.6g}" for v in row] for row in np.stack(measures, -1).tolist())
    names = {int(status): status.name.lower() for status in Status}
    heads = zip(lines, solution.status.tolist(), solution.branch.tolist(), strict=True)
    return (
        [str(line), names[status], solution.branches[branch], *joint_cells, *measure_cells]
        for (line, status, branch), joint_cells, measure_cells in zip(heads, exact, short, strict=True)
    )
