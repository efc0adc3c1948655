"""Setup faults that show with the robot as drawn, base and tool being fitted under every hypothesis."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import numbers_of_names
from pisigma.robot.description import Robot
from pisigma.robot.frame_fits import (
    LEVER_SHARE,
    MeasuredPoses,
    affine_error,
    best_base_and_tool,
)
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.parameter_jacobian import identification_jacobian
from pisigma.robot.robot_class import HOBBY
from pisigma.validation.setup_faults.cause import Cause, joined
from pisigma.validation.setup_faults.explanations import (
    AS_GOOD,
    hypotheses,
    in_frames,
    largest_explained,
    simplest,
)
from pisigma.validation.setup_faults.hypothesis import (
    MARGIN,
    Hypothesis,
    PredictingArm,
    freed_joints,
    shifted_rows,
)
from pisigma.validation.setup_faults.setup_fault import SetupFault, fault_of

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
SURE = 1e-3
"""Joint values explain positions where chance would explain as much of them with a probability below this."""
MOST_TARGETS = 4
"""Targets that are looked for under one name."""
EXAMPLES = 3
"""Rows that are named, at most."""
TARGET_TURNS = 20
"""Turns of fitting base and targets, at most."""
TARGETS_SETTLED = 1e-2
"""They end where a turn lowers the mean square by less than this share."""
NAMING_ROUNDS = 8
"""Rounds of naming every row after the nearest target and fitting base and targets anew, at most."""


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
    measured = MeasuredPoses.of(some.position, some.rotation, LEVER_SHARE * robot.reach)
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
        faults = simplest(_with_joints(arm, freed, most, values=1) + _labelled(some, raw.T, measured), most)
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
    number, lever = numbers_of_names(rows.target), LEVER_SHARE * robot.reach
    measured, T = MeasuredPoses.of(rows.position, rows.rotation, lever), forward_kinematics(robot, rows.q)
    here = Hypothesis(rows.q, fit_targets(T, measured, number)[1], measured)
    if not here.error > usual:
        return ()
    most = largest_explained(here, robot.reach)
    return tuple(
        fault_of(here, other, float("nan")) for other in simplest(_labelled(rows, T, measured), most)
    )


def _labelled(
    rows: Measurements, T: Float64[Tensor, "rows 4 4"], measured: MeasuredPoses
) -> list[Hypothesis]:
    """Make hypotheses of other names of targets; see `better_labellings`."""
    return [
        Hypothesis(rows.q, one.T, measured, (one.cause,), 3 * one.targets)
        for one in better_labellings(rows, T, measured)
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


@dataclass(frozen=True, eq=False)
class Labelling:
    """Rows named after the targets that they fit.

    Attributes:
        cause: what is wrong with the names of the file.
        T: predicted poses of the targets, base and tools being fitted under the better names.
        targets: number of targets.
    """

    cause: Cause
    T: Float64[Tensor, "rows 4 4"]
    targets: int


def better_labellings(
    rows: Measurements, T: Float64[Tensor, "rows 4 4"], measured: MeasuredPoses
) -> Iterator[Labelling]:
    """Find targets from the measurements alone: points of the tool that the measured positions cluster about.

    As k-means, but base and targets are fitted to all rows in every round. With several names there are as many
    targets, and each keeps the name that most of its rows have; with one name there are 2, then 3, up to
    `MOST_TARGETS`.

    Args:
        rows: with positions, of one frame.
        T: poses that are predicted for them, with any base and tool.
        measured: their poses.
    """
    names = tuple(dict.fromkeys(rows.target))
    for count in range(2, MOST_TARGETS + 1) if len(names) == 1 else (len(names),):
        number, poses = _clustered(T, measured, count)
        cause = _one_name(rows, number) if len(names) == 1 else _other_names(rows, number, names)
        yield Labelling(cause, poses, count)


def fit_targets(
    T: Float64[Tensor, "rows 4 4"], measured: MeasuredPoses, number: Int64[Tensor, " rows"]
) -> tuple[Float64[Tensor, "4 4"], Float64[Tensor, "rows 4 4"]]:
    """Fit base and targets to measured poses by turns: base and the targets' mean, then every target's place.

    Args:
        T: predicted poses, with any base and tool.
        measured: what was measured there.
        number: of every row's target, 0 and up.

    Returns:
        The base, and the poses that are predicted with it.
    """
    places = torch.zeros(int(number.max()) + 1, 3).to(T)
    last = math.inf
    for _ in range(TARGET_TURNS):
        of_rows = T.clone()
        of_rows[:, :3, 3] += (T[:, :3, :3] @ places[number][..., None])[..., 0]
        base, tool = best_base_and_tool(of_rows, measured)
        fitted = base @ of_rows @ tool
        error = float(measured.squares(fitted).mean())
        if error > (1 - TARGETS_SETTLED) * last:
            break
        last = error
        points = _behind(base @ T, measured)
        places = torch.stack([points[number == k].mean(0) for k in range(len(places))])
    return base, fitted


def _behind(T: Float64[Tensor, "rows 4 4"], measured: MeasuredPoses) -> Float64[Tensor, "rows 3"]:
    """Give measured positions as predicted poses see them [m]."""
    return (T[:, :3, :3].mT @ (measured.position - T[:, :3, 3])[..., None])[..., 0]


def _one_name(rows: Measurements, number: Int64[Tensor, " rows"]) -> Cause:
    used, sizes = torch.unique(number, return_counts=True)
    first = [_where(rows, int((number == k).nonzero()[0, 0])) for k in used]
    shares = joined(f"{100 * size / len(number):.0f} %" for size in sizes.tolist())
    clause = (
        f"the targets look mixed up: the rows are of {len(used)} targets under one name ({shares} of them)"
    )
    return Cause(
        "target",
        clause,
        f"name the targets in a column 'target'; they begin in {joined(first)}",
        float(len(used)),
    )


def _other_names(rows: Measurements, number: Int64[Tensor, " rows"], names: tuple[str, ...]) -> Cause:
    shared = torch.zeros(int(number.max()) + 1, len(names))
    named = torch.tensor([names.index(name) for name in rows.target])
    shared.index_put_((number, named), torch.tensor(1.0), accumulate=True)
    better = [names[k] for k in shared.argmax(1)[number].tolist()]
    wrong = [row for row, (name, other) in enumerate(zip(rows.target, better, strict=True)) if name != other]
    examples = [
        f"{_where(rows, row)} fits '{better[row]}' instead of '{rows.target[row]}'"
        for row in wrong[:EXAMPLES]
    ]
    clause = f"the targets look mixed up: {len(wrong)} of {rows.rows} rows fit another target than the one they name"
    return Cause("target", clause, f"check the column 'target': {joined(examples)}", 2.0)


def _where(rows: Measurements, row: int) -> str:
    """Name a row in short: the file stands before it."""
    return f"line {rows.line[row]}" if rows.line[row] else f"row {row}"


def _clustered(
    T: Float64[Tensor, "rows 4 4"], measured: MeasuredPoses, count: int
) -> tuple[Int64[Tensor, " rows"], Float64[Tensor, "rows 4 4"]]:
    """Cluster the points of the tool that were measured; returns their numbers and the predicted poses."""
    number = torch.zeros(len(T), dtype=torch.int64)
    base, tool = best_base_and_tool(T, measured)
    points, fitted = _behind(base @ T, measured), base @ T @ tool
    centres = points.median(0).values[None]
    for _ in range(count):
        far = torch.cdist(points, centres).amin(1).topk(max(1, len(T) // (4 * count))).indices
        centres = torch.cat([centres, points[far].median(0).values[None]])
    centres = centres[1:]
    for _ in range(NAMING_ROUNDS):
        nearest = torch.cdist(points, centres).argmin(1)
        if bool((nearest == number).all()):
            break
        number = torch.unique(nearest, return_inverse=True)[1]
        base, fitted = fit_targets(T, measured, number)
        points = _behind(base @ T, measured)
        centres = torch.stack([points[number == k].median(0).values for k in range(int(number.max()) + 1)])
    return number, fitted
