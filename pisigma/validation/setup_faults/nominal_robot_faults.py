"""Setup faults that are found with the nominal robot, with base and tool fitted under every hypothesis."""

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
from pisigma.robot.frame_fits import LEVER_SHARE, MeasuredPoses, affine_squared_error, best_base_and_tool
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.parameter_jacobian import identification_jacobian
from pisigma.robot.robot_class import HOBBY, RobotClass
from pisigma.validation.setup_faults.cause import Cause, join_words
from pisigma.validation.setup_faults.explanations import (
    AS_GOOD,
    choose_simplest,
    fault_hypotheses,
    frame_hypotheses,
    max_explained_error,
)
from pisigma.validation.setup_faults.hypothesis import (
    MARGIN,
    Hypothesis,
    PredictingArm,
    estimate_joint_values,
    shifted_rows,
)
from pisigma.validation.setup_faults.setup_fault import SetupFault, fault_from_hypothesis

MAX_ROWS = 1_000
"""Largest number of rows on which hypotheses are tried, spread evenly over all rows."""
_MAX_ROWS_NOMINAL = 150
"""Largest number of rows on which hypotheses are tried with the nominal robot, for which base and tool are fitted
each time."""
MIN_ROWS_NOMINAL = 24
"""Minimum number of rows; with fewer, an affine fit (39 unknowns) leaves too few degrees of freedom."""
_LARGEST_ZERO = 0.1
"""Largest standard deviation of the zeros of revolute joints of industrial arms and cobots after a repair [rad]."""
_MAX_ZEROS = 3.0
"""Ratio of the largest plausible error of a single zero to `largest_zero_sigma`."""
_MAX_SLIDE = 3 * HOBBY.max_error_sigmas.length
"""Largest plausible error of the zero of a prismatic joint [m]."""
_USUAL = 1e-3
"""Usual prior standard deviation of geometric errors [m and rad]."""
_SURE = 1e-3
"""Probability of the F test below which joint values explain positions."""
_MAX_TARGETS = 4
"""Largest number of targets with the same name that are searched for."""
_MAX_EXAMPLES = 3
"""Largest number of rows that a sentence lists."""
_MAX_TARGET_ITERATIONS = 20
"""Largest number of alternating fits of base and targets."""
_TARGET_TOLERANCE = 1e-2
"""Relative decrease of the mean square per iteration at convergence."""
_MAX_CLUSTERINGS = 8
"""Largest number of iterations, each of which assigns rows to the nearest target and refits base and targets."""


def largest_zero_sigma(robot: Robot) -> float:
    """Return the largest standard deviation [rad] of revolute joint zeros in this manufacturer's class of robots."""
    return max(_LARGEST_ZERO, RobotClass.from_robot(robot).max_error_sigmas.joint_offset)


def find_nominal_robot_faults(robot: Robot, measurements: Measurements) -> tuple[SetupFault, ...]:
    """Find setup faults that reduce the errors of the nominal robot to a quarter or less, simplest first.

    Base and tool are fitted to the unchanged rows and under every hypothesis: the hypotheses of `find_setup_faults`,
    rows shifted before or after a row, several targets under one name, and a joint whose logged values are wrong.
    Hypotheses are tried if the errors are larger than those caused by geometric errors of the usual prior (1 mm, 1
    mrad). A correct explanation then leaves these usual errors, which are a tenth or less of those caused by faults.

    Args:
        robot: the nominal robot.
        measurements: rows; only rows with positions of the most frequent frame and target are evaluated.

    Returns:
        The faults; empty if the errors are of usual size, or if nothing explains them.
    """
    rows = rows_of_most_frequent_frame(measurements)
    if rows.rows < MIN_ROWS_NOMINAL:
        return ()
    chosen = evenly_spaced_rows(torch.arange(MARGIN, rows.rows - MARGIN), _MAX_ROWS_NOMINAL)
    some, arm = rows.select(chosen), PredictingArm(robot)
    measured = MeasuredPoses.from_tensors(some.position, some.rotation, LEVER_SHARE * robot.reach)
    raw = Hypothesis(some.q, arm.poses(some), measured)
    here, usual = next(frame_hypotheses(arm, some, [raw])), prior_rms_position_error(robot, some.q)
    if len(set(measurements.target)) > 1:
        named = _named_otherwise(robot, measurements, usual)
        if named or not here.error > usual:
            return named
    if not here.error > usual:
        return ()
    most = max_explained_error(here, robot)
    tried = [
        *fault_hypotheses(arm, some, raw, most),
        *_with_joints(arm, some, shifted_rows(robot, rows, chosen, measured), most),
    ]
    faults = choose_simplest(tried, most)
    if not faults and not are_positions_unrelated(robot, rows):
        freed = ((q, measured, cause) for q, cause in estimate_joint_values(robot, some, measured))
        faults = choose_simplest(
            _with_joints(arm, some, freed, most, values=1) + _labelled(some, raw.T, measured), most
        )
    if faults:
        faults = _better_than_zeros(faults, _error_with_zeros(robot, some, measured), usual)
    return tuple(fault_from_hypothesis(here, other, float("nan")) for other in faults)


def _better_than_zeros(faults: Sequence[Hypothesis], error: float, usual: float) -> list[Hypothesis]:
    """Return the faults that explain the rows better than moved zeros of all joints, which a calibration estimates.

    Moved zeros of single joints are also kept if the remaining errors are of usual size.

    Args:
        faults: the faults found.
        error: RMS error with the zeros of all joints fitted [m].
        usual: RMS error of a healthy nominal robot [m].
    """
    return [
        fault
        for fault in faults
        if AS_GOOD * fault.error < error
        or (all(cause.kind == "joint_zero" for cause in fault.causes) and fault.error <= max(usual, error))
    ]


def _error_with_zeros(robot: Robot, rows: Measurements, measured: MeasuredPoses) -> float:
    """Compute the RMS error [m] with the zeros of all joints fitted; infinite if they move too far."""
    try:
        fitted = GeometricCalibrator(robot, free="joint_offsets", prior=None).fit(rows).robot
    except IdentificationError:
        return math.inf
    moved = (fitted.dh - robot.dh)[:, :2]
    if (
        np.abs(moved[:, 0]).max() > _MAX_ZEROS * largest_zero_sigma(robot)
        or np.abs(moved[:, 1]).max() > _MAX_SLIDE
    ):
        return math.inf
    arm = PredictingArm(robot.with_geometry(dh=fitted.dh))
    here = next(frame_hypotheses(arm, rows, [Hypothesis(rows.q, arm.poses(rows), measured)]))
    return replace(here, fitted_parameters=here.fitted_parameters + robot.dof).error


def _named_otherwise(robot: Robot, measurements: Measurements, usual: float) -> tuple[SetupFault, ...]:
    """Return faults in the names of targets in the most frequent frame, if errors are larger than usual [m]."""
    rows = rows_of_most_frequent_frame(measurements, by_target=False)
    rows = rows.select(evenly_spaced_rows(torch.arange(rows.rows), MAX_ROWS))
    number, lever = numbers_of_names(rows.target), LEVER_SHARE * robot.reach
    measured, T = (
        MeasuredPoses.from_tensors(rows.position, rows.rotation, lever),
        forward_kinematics(robot, rows.q),
    )
    here = Hypothesis(rows.q, fit_targets(T, measured, number)[1], measured)
    if not here.error > usual:
        return ()
    most = max_explained_error(here, robot)
    return tuple(
        fault_from_hypothesis(here, other, float("nan"))
        for other in choose_simplest(_labelled(rows, T, measured), most)
    )


def _labelled(
    rows: Measurements, T: Float64[Tensor, "rows 4 4"], measured: MeasuredPoses
) -> list[Hypothesis]:
    """Return hypotheses with other target names; see `target_labellings`."""
    return [
        Hypothesis(rows.q, one.T, measured, (one.cause,), 3 * one.targets)
        for one in target_labellings(rows, T, measured)
    ]


def _with_joints(
    arm: PredictingArm,
    some: Measurements,
    tried: Iterable[tuple[Float64[Tensor, "rows dof"], MeasuredPoses, Cause]],
    most: float,
    values: int = 0,
) -> list[Hypothesis]:
    """Return hypotheses with other joint values or poses, for the nominal robot.

    Args:
        arm: the predicting arm.
        some: the rows.
        tried: joint values, measured poses and cause of each hypothesis.
        most: largest error that an explanation may leave [m].
        values: number of unknowns per row.
    """
    hypotheses = [
        Hypothesis(q, arm.poses(Measurements(q=q)), measured, (cause,), values * len(q))
        for q, measured, cause in tried
    ]
    return list(frame_hypotheses(arm, some, hypotheses, most))


def are_positions_unrelated(robot: Robot, measurements: Measurements) -> bool:
    """Return whether positions are unrelated to the joint values of their rows, for example after sorting a column."""
    rows = rows_of_most_frequent_frame(measurements)
    if rows.rows < MIN_ROWS_NOMINAL:
        return False
    rows = rows.select(evenly_spaced_rows(torch.arange(rows.rows), _MAX_ROWS_NOMINAL))
    assert rows.position is not None
    spread_out = float((rows.position - rows.position.mean(0)).square().sum(1).mean().sqrt())
    return spread_out > prior_rms_position_error(robot, rows.q) and fits_by_chance(
        forward_kinematics(robot, rows.q), rows.position
    )


def prior_rms_position_error(robot: Robot, q: Float64[Tensor, "rows dof"]) -> float:
    """Compute the RMS position error [m] caused by geometric errors of 1 mm and 1 mrad.

    Its covariance is `J P J^T` for the derivative `J` of the position with respect to the DH parameters and their prior
    covariance `P`. The part that base and tool absorb is neglected.
    """
    J = identification_jacobian(robot, q)[1][:, :3, : 5 * len(robot.rows)]
    return _USUAL * float(J.square().sum((1, 2)).mean().sqrt())


def rows_with_position(measurements: Measurements) -> Int64[Tensor, " rows"]:
    """Return the indices of the rows with a position."""
    assert measurements.position is not None
    return torch.isfinite(measurements.position).all(-1).nonzero()[:, 0]


def rows_of_most_frequent_frame(measurements: Measurements, by_target: bool = True) -> Measurements:
    """Return the rows with positions of the most frequent frame (and target); empty if none was measured."""
    if measurements.position is None:
        return measurements.select(torch.arange(0))
    rows = rows_with_position(measurements)
    names = [
        (measurements.frame[row], measurements.target[row] if by_target else "") for row in rows.tolist()
    ]
    most = Counter(names).most_common(1)[:1]
    group = measurements.select(rows[torch.tensor([name == most[0][0] for name in names], dtype=torch.bool)])
    return replace(group, pair=None, distance=None)


def evenly_spaced_rows(rows: Int64[Tensor, " rows"], max_rows: int) -> Int64[Tensor, " chosen"]:
    """Return at most `max_rows` of the rows, evenly spaced."""
    count = min(len(rows), max_rows)
    return rows[torch.linspace(0, len(rows) - 1, count).round().long()]


def fits_by_chance(T: Float64[Tensor, "rows 4 4"], position: Float64[Tensor, "rows 3"]) -> bool:
    """Return whether predicted poses explain measured positions no better than chance, by an F test of the affine fit.

    Args:
        T: predicted poses.
        position: measured positions [m], at least 14.
    """
    from scipy.special import fdtrc  # imported here, because scipy.stats takes a second to import

    none = torch.zeros(len(T), dtype=torch.bool)
    free, left = 36, 3 * (len(T) - 13)
    unexplained = float(affine_squared_error(T, MeasuredPoses(position, T[:, :3, :3], none, 0.0))) * left / 3
    total = float((position - position.mean(0)).square().sum())
    return float(fdtrc(free, left, (total - unexplained) / free / (unexplained / left))) > _SURE


@dataclass(frozen=True, eq=False)
class Labelling:
    """Assignment of the rows to the targets that they fit best.

    Attributes:
        cause: what is wrong with the names in the file.
        T: predicted poses of the targets, with base and tools fitted under this assignment.
        targets: number of targets.
    """

    cause: Cause
    T: Float64[Tensor, "rows 4 4"]
    targets: int


def target_labellings(
    rows: Measurements, T: Float64[Tensor, "rows 4 4"], measured: MeasuredPoses
) -> Iterator[Labelling]:
    """Find targets from the measurements alone, as clusters of measured points on the tool.

    The method is k-means, with base and targets fitted to all rows in every iteration. The number of targets is the
    number of names, and every target gets the most frequent name of its rows; with one name, 2 to `_MAX_TARGETS`
    targets are tried.

    Args:
        rows: rows with positions in one frame.
        T: predicted poses of the rows, with any base and tool.
        measured: their measured poses.
    """
    names = tuple(dict.fromkeys(rows.target))
    for count in range(2, _MAX_TARGETS + 1) if len(names) == 1 else (len(names),):
        number, poses = _clustered(T, measured, count)
        cause = _one_name(rows, number) if len(names) == 1 else _other_names(rows, number, names)
        yield Labelling(cause, poses, count)


def fit_targets(
    T: Float64[Tensor, "rows 4 4"], measured: MeasuredPoses, target_index: Int64[Tensor, " rows"]
) -> tuple[Float64[Tensor, "4 4"], Float64[Tensor, "rows 4 4"]]:
    """Fit base and targets to measured poses alternately: the base with the mean target, then every target.

    Args:
        T: predicted poses, with any base and tool.
        measured: the measured poses.
        target_index: index of every row's target.

    Returns:
        The base, and the poses predicted with it.
    """
    places = torch.zeros(int(target_index.max()) + 1, 3).to(T)
    last = math.inf
    for _ in range(_MAX_TARGET_ITERATIONS):
        of_rows = T.clone()
        of_rows[:, :3, 3] += (T[:, :3, :3] @ places[target_index][..., None])[..., 0]
        base, tool = best_base_and_tool(of_rows, measured)
        fitted = base @ of_rows @ tool
        error = float(measured.squared_errors(fitted).mean())
        if error > (1 - _TARGET_TOLERANCE) * last:
            break
        last = error
        points = _in_tool_frame(base @ T, measured)
        places = torch.stack([points[target_index == k].mean(0) for k in range(len(places))])
    return base, fitted


def _in_tool_frame(T: Float64[Tensor, "rows 4 4"], measured: MeasuredPoses) -> Float64[Tensor, "rows 3"]:
    """Transform measured positions to the frames of predicted poses [m]."""
    return (T[:, :3, :3].mT @ (measured.position - T[:, :3, 3])[..., None])[..., 0]


def _one_name(rows: Measurements, number: Int64[Tensor, " rows"]) -> Cause:
    used, sizes = torch.unique(number, return_counts=True)
    first = [_where(rows, int((number == k).nonzero()[0, 0])) for k in used]
    shares = join_words(f"{100 * size / len(number):.0f} %" for size in sizes.tolist())
    clause = f"the targets seem to be mixed up: {len(used)} targets have one name ({shares} of the rows)"
    return Cause(
        "target",
        clause,
        f"name the targets in a column 'target'; their first rows are {join_words(first)}",
        float(len(used)),
        amount=float(len(used)),
    )


def _other_names(rows: Measurements, number: Int64[Tensor, " rows"], names: tuple[str, ...]) -> Cause:
    shared = torch.zeros(int(number.max()) + 1, len(names))
    named = torch.tensor([names.index(name) for name in rows.target])
    shared.index_put_((number, named), torch.tensor(1.0), accumulate=True)
    better = [names[k] for k in shared.argmax(1)[number].tolist()]
    wrong = [row for row, (name, other) in enumerate(zip(rows.target, better, strict=True)) if name != other]
    examples = [
        f"{_where(rows, row)} fits '{better[row]}' instead of '{rows.target[row]}'"
        for row in wrong[:_MAX_EXAMPLES]
    ]
    clause = f"the targets seem to be mixed up: {len(wrong)} of {rows.rows} rows fit a target that they do not name"
    return Cause("target", clause, f"check the column 'target': {join_words(examples)}", 2.0)


def _where(rows: Measurements, row: int) -> str:
    """Return a text that locates a row without naming its file."""
    return f"line {rows.line[row]}" if rows.line[row] else f"row {row}"


def _clustered(
    T: Float64[Tensor, "rows 4 4"], measured: MeasuredPoses, count: int
) -> tuple[Int64[Tensor, " rows"], Float64[Tensor, "rows 4 4"]]:
    """Cluster the measured points on the tool; return their cluster indices and the predicted poses."""
    number = torch.zeros(len(T), dtype=torch.int64)
    base, tool = best_base_and_tool(T, measured)
    points, fitted = _in_tool_frame(base @ T, measured), base @ T @ tool
    # Farthest-point initialisation: each new centre is the median of the points farthest from the previous centres.
    centres = points.median(0).values[None]
    for _ in range(count):
        far = torch.cdist(points, centres).amin(1).topk(max(1, len(T) // (4 * count))).indices
        centres = torch.cat([centres, points[far].median(0).values[None]])
    centres = centres[1:]
    for _ in range(_MAX_CLUSTERINGS):
        nearest = torch.cdist(points, centres).argmin(1)
        if bool((nearest == number).all()):
            break
        number = torch.unique(nearest, return_inverse=True)[1]
        base, fitted = fit_targets(T, measured, number)
        points = _in_tool_frame(base @ T, measured)
        centres = torch.stack([points[number == k].median(0).values for k in range(int(number.max()) + 1)])
    return number, fitted
