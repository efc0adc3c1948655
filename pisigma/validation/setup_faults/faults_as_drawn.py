"""Setup faults that show with the robot as drawn, base and tool being fitted under every hypothesis."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import numbers_of_names
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.parameter_jacobian import identification_jacobian
from pisigma.robot.robot_class import HOBBY
from pisigma.validation.held_out.frames.frame_fits import (
    LEVER_SHARE,
    MeasuredPoses,
    affine_error,
    best_base_and_tool,
)
from pisigma.validation.setup_faults.arm import PredictingArm
from pisigma.validation.setup_faults.cause import Cause
from pisigma.validation.setup_faults.explanations import (
    AS_GOOD,
    hypotheses,
    in_frames,
    largest_explained,
    simplest,
)
from pisigma.validation.setup_faults.free_joint import freed_joints
from pisigma.validation.setup_faults.hypothesis import Hypothesis
from pisigma.validation.setup_faults.setup_fault import SetupFault, fault_of
from pisigma.validation.setup_faults.target_faults import better_labellings, fit_targets

MOST_ROWS = 1_000
"""Rows that explanations are tried on, spread over all of them."""
MOST_ROWS_AS_DRAWN = 150
"""The same of the robot as drawn, where base and tool are fitted to them under every hypothesis."""
FEWEST_ROWS_AS_DRAWN = 24
"""Base and tool, as 39 unknowns of an affine fit, leave too few of the values of fewer rows."""
LARGEST_ZERO = 3 * HOBBY.largest.joint_offset
"""[rad] Zeros of joints are not further off."""
LARGEST_SLIDE = 3 * HOBBY.largest.length
"""[m] The same of joints that slide."""
USUAL = 1e-3
"""Usual prior standard deviation of geometric errors [m and rad]."""
SHIFTS = (1, -1, 2, -2)
"""Rows by which joint values may be shifted against what was measured."""
MARGIN = max(SHIFTS)
ENDS = 3
"""Base and tool are fitted to the first and to the last third of the rows where a row may have been lost between."""
SURE = 1e-3
"""Joint values explain positions where chance would explain as much of them with a probability below this."""
_ADVICE = "look for a row that was lost or written twice on one side, and put both sides together again"


def find_faults_as_drawn(robot: Robot, measurements: Measurements) -> tuple[SetupFault, ...]:
    """Find what makes the errors of the robot as drawn collapse to a quarter or less, the simplest first.

    Base and tool are fitted to the rows as they are and under every hypothesis: those of `find_setup_faults`, rows
    shifted from one row on, several targets under one name, and a joint whose logged values are not those that it
    had. They are tried where the errors are larger than geometric errors of the usual prior (1 mm, 1 mrad) make those
    of the robot as drawn. There a true explanation leaves these usual errors, a tenth or less of what faults make.

    Args:
        robot: as drawn.
        measurements: rows; those with positions in the frame and of the target that most are of are judged.

    Returns:
        Nothing where the errors are usual, or where nothing explains them.
    """
    rows = largest_group(measurements)
    if rows.rows < FEWEST_ROWS_AS_DRAWN:
        return ()
    chosen = spread(torch.arange(MARGIN, rows.rows - MARGIN), MOST_ROWS_AS_DRAWN)
    some, arm = rows.select(chosen), PredictingArm(robot)
    measured = MeasuredPoses.of(some, LEVER_SHARE * robot.reach)
    raw = Hypothesis(some.q, arm.poses(some), measured)
    here, usual = next(in_frames(arm, some, raw)), usual_error(robot, some.q)
    if len(set(measurements.target)) > 1:
        named = _named_otherwise(robot, measurements, usual)
        if named or not here.error > usual:
            return named
    if not here.error > usual:
        return ()
    most = largest_explained(here, robot.reach)
    tried = [
        *hypotheses(arm, some, raw, most),
        *_with_joints(arm, shifted_rows(arm, rows, chosen, measured), most),
    ]
    faults = simplest(tried, most)
    if not faults and not are_unrelated(robot, rows):
        freed = ((q, measured, cause) for q, cause in freed_joints(arm, some, measured))
        faults = simplest(_with_joints(arm, freed, most, values=1) + _labelled(robot, some, measured), most)
    if faults:
        faults = _better_than_zeros(faults, _error_with_zeros(robot, some, measured), usual)
    return tuple(fault_of(here, other, float("nan")) for other in faults)


def _better_than_zeros(faults: Sequence[Hypothesis], error: float, usual: float) -> list[Hypothesis]:
    """Keep the faults that explain the rows better than other zeros of all joints do, which a calibration finds.

    Zeros of single joints are kept too where they leave no more than usual errors.

    Args:
        faults: that were found.
        error: what is left with other zeros [m].
        usual: errors of a healthy robot as drawn [m].
    """
    return [
        fault
        for fault in faults
        if AS_GOOD * fault.error < error
        or (all(cause.kind == "joint_zero" for cause in fault.causes) and fault.error <= max(usual, error))
    ]


def _error_with_zeros(robot: Robot, rows: Measurements, measured: MeasuredPoses) -> float:
    """Root mean square of the errors [m] with the zeros of all joints fitted; infinite where they move too far."""
    try:
        fitted = GeometricCalibrator(robot, free="joint_offsets", prior=None).fit(rows).robot
    except IdentificationError:
        return math.inf
    moved = (fitted.dh - robot.dh)[:, :2]
    if np.abs(moved[:, 0]).max() > LARGEST_ZERO or np.abs(moved[:, 1]).max() > LARGEST_SLIDE:
        return math.inf
    arm = PredictingArm(robot.with_geometry(dh=fitted.dh))
    here = next(in_frames(arm, rows, Hypothesis(rows.q, arm.poses(rows), measured)))
    return replace(here, fitted=here.fitted + robot.dof).error


def _named_otherwise(robot: Robot, measurements: Measurements, usual: float) -> tuple[SetupFault, ...]:
    """Find better names for the targets of the frame that most rows are of, where errors are larger than usual [m]."""
    rows = largest_group(measurements, by_target=False)
    rows = rows.select(spread(torch.arange(rows.rows), MOST_ROWS))
    measured, T = MeasuredPoses.of(rows, LEVER_SHARE * robot.reach), forward_kinematics(robot, rows.q)
    here = Hypothesis(rows.q, fit_targets(T, measured, numbers_of_names(rows.target))[1], measured)
    if not here.error > usual:
        return ()
    most = largest_explained(here, robot.reach)
    return tuple(
        fault_of(here, other, float("nan")) for other in simplest(_labelled(robot, rows, measured), most)
    )


def _labelled(robot: Robot, rows: Measurements, measured: MeasuredPoses) -> list[Hypothesis]:
    """Make hypotheses of other names of targets."""
    return [
        Hypothesis(rows.q, one.T, measured, (one.cause,), 3 * one.targets)
        for one in better_labellings(robot, rows, measured)
    ]


def _with_joints(
    arm: PredictingArm,
    tried: Iterable[tuple[Float64[Tensor, "rows dof"], MeasuredPoses, Cause]],
    most: float,
    values: int = 0,
) -> list[Hypothesis]:
    """Make hypotheses of joint values of the robot as drawn, of which every row has some values of its own."""
    return [
        other
        for q, measured, cause in tried
        for rows in [Measurements(q=q)]
        for other in in_frames(
            arm, rows, Hypothesis(q, arm.poses(rows), measured, (cause,), values * len(q)), most
        )
    ]


def are_unrelated(robot: Robot, measurements: Measurements) -> bool:
    """Say whether positions have nothing to do with the joint values of their rows, as where one side was sorted."""
    rows = largest_group(measurements)
    if rows.rows < FEWEST_ROWS_AS_DRAWN:
        return False
    rows = rows.select(spread(torch.arange(rows.rows), MOST_ROWS_AS_DRAWN))
    assert rows.position is not None
    spread_out = float((rows.position - rows.position.mean(0)).square().sum(1).mean().sqrt())
    return spread_out > usual_error(robot, rows.q) and explains_nothing(
        forward_kinematics(robot, rows.q), rows.position
    )


def usual_error(robot: Robot, q: Float64[Tensor, "rows dof"]) -> float:
    """Compute the root mean square of the position errors [m] that geometric errors of 1 mm and 1 mrad make.

    Their covariance is `J P J^T` for the derivative `J` of the position by the parameters of all rows and the prior
    covariance `P`; that base and tool take a part of it is left out.
    """
    J = identification_jacobian(robot, q)[1][:, :3, : 5 * len(robot.rows)]
    return USUAL * float(J.square().sum((1, 2)).mean().sqrt())


def measured_rows(measurements: Measurements) -> Int64[Tensor, " rows"]:
    """List the rows with a position."""
    assert measurements.position is not None
    return torch.isfinite(measurements.position).all(-1).nonzero()[:, 0]


def largest_group(measurements: Measurements, by_target: bool = True) -> Measurements:
    """Select the rows with positions of the frame (and target) that most are of; none where none was measured."""
    if measurements.position is None:
        return measurements.select(torch.arange(0))
    rows = measured_rows(measurements)
    names = [
        (measurements.frame[row], measurements.target[row] if by_target else "") for row in rows.tolist()
    ]
    most = Counter(names).most_common(1)[:1]
    group = measurements.select(rows[torch.tensor([name == most[0][0] for name in names], dtype=torch.bool)])
    return replace(group, pair=None, distance=None)


def spread(rows: Int64[Tensor, " rows"], most: int) -> Int64[Tensor, " chosen"]:
    """Choose some of the rows, spread over them."""
    count = min(len(rows), most)
    return rows[torch.linspace(0, len(rows) - 1, count).round().long()]


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
