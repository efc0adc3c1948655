"""Setup faults of rows: joint values that stand beside what was measured at others."""

from collections.abc import Iterator
from dataclasses import replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.validation.held_out.frames.frame_fits import (
    LEVER_SHARE,
    MeasuredPoses,
    affine_error,
    best_base_and_tool,
)
from pisigma.validation.setup_faults.arm import PredictingArm
from pisigma.validation.setup_faults.cause import Cause

SHIFTS = (1, -1, 2, -2)
"""Rows by which joint values may be shifted against what was measured."""
MARGIN = max(SHIFTS)
ENDS = 3
"""Base and tool are fitted to the first and to the last third of the rows where a row may have been lost between."""
SURE = 1e-3
"""Joint values explain positions where chance would explain as much of them with a probability below this."""
_ADVICE = "look for a row that was lost or written twice on one side, and put both sides together again"


def shifted_rows(
    arm: PredictingArm, rows: Measurements, chosen: Int64[Tensor, " chosen"], measured: MeasuredPoses
) -> Iterator[tuple[Float64[Tensor, "chosen dof"], MeasuredPoses, Cause]]:
    """Go through joint values or orientations of a row before or behind, in all rows or from one on.

    Args:
        arm: with which is predicted.
        rows: in the order of the file.
        chosen: those to judge, `MARGIN` or more from both ends.
        measured: their poses.
    """
    q = rows.q[chosen]
    for shift in SHIFTS:
        cause = Cause(
            "rows", f"the joint values are shifted by {_count(shift)} against the measurements", _ADVICE, 1.0
        )
        yield rows.q[chosen + shift], measured, cause
        if bool(measured.has_rotation.any()):
            assert rows.rotation is not None
            other = rows.rotation[chosen + shift]
            there = torch.isfinite(other).flatten(1).all(1)
            rotations = replace(measured, rotation=torch.where(there[:, None, None], other, 0.0))
            rotations = replace(rotations, has_rotation=there & measured.has_rotation)
            clause = f"the orientations are shifted by {_count(shift)} against the positions"
            yield q, rotations, Cause("rows", clause, _ADVICE, 1.0)
    yield from _shifted_from_a_row(arm, rows, chosen)


def _shifted_from_a_row(
    arm: PredictingArm, rows: Measurements, chosen: Int64[Tensor, " chosen"]
) -> Iterator[tuple[Float64[Tensor, "chosen dof"], MeasuredPoses, Cause]]:
    """Find the row from which on, or up to which, a shift explains most; base and tool are fitted beyond it.

    The rows about it are left out, as what was lost there stands nowhere.
    """
    inner = torch.arange(MARGIN, rows.rows - MARGIN)
    measured = MeasuredPoses.of(rows.select(inner), LEVER_SHARE * arm.robot.reach)
    T = {shift: arm.poses(replace(rows, q=rows.q.roll(-shift, 0)))[inner] for shift in (0, *SHIFTS)}
    third = len(chosen) // ENDS
    for at_start, end in ((True, chosen[:third] - MARGIN), (False, chosen[-third:] - MARGIN)):
        base, tool = best_base_and_tool(T[0][end], measured.select(end))
        errors = {shift: measured.squares(base @ poses @ tool) for shift, poses in T.items()}
        for shift in SHIFTS:
            gain = errors[0] - errors[shift] if at_start else errors[shift] - errors[0]
            change = int(gain.flip(0).cumsum(0).flip(0).argmax())
            place = rows.place(int(inner[change]))
            where = f"from about {place} on" if at_start else f"up to about {place}"
            clause = f"{where} the joint values are shifted by {_count(shift)} against the measurements"
            kept = chosen[(chosen - inner[change] + 0.5).abs() > abs(shift)]
            behind = kept >= inner[change]
            q = torch.where((behind == at_start)[:, None], rows.q[kept + shift], rows.q[kept])
            yield q, measured.select(kept - MARGIN), Cause("rows", clause, _ADVICE, 1.5)


def explains_nothing(T: Float64[Tensor, "rows 4 4"], position: Float64[Tensor, "rows 3"]) -> bool:
    """Say whether predicted poses explain no more of measured positions than chance, by an F test of the affine fit.

    Args:
        T: predicted poses.
        position: measured positions [m], more than 13.
    """
    from scipy.special import fdtrc  # scipy.stats takes a second to import

    none = torch.zeros(len(T), dtype=torch.bool)
    free, left = 36, 3 * (len(T) - 13)
    unexplained = float(affine_error(T, MeasuredPoses(position, T[:, :3, :3], none, 0.0))) * left / 3
    total = float((position - position.mean(0)).square().sum())
    return float(fdtrc(free, left, (total - unexplained) / free / (unexplained / left))) > SURE


def _count(shift: int) -> str:
    """Write by how many rows joint values are shifted."""
    return "one row" if abs(shift) == 1 else f"{abs(shift)} rows"
