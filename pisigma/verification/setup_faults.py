"""The usual setup faults behind large errors, recognised by trying each on the data."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.judging.frame_fits import LEVER_SHARE, MeasuredPoses, best_base, best_base_and_tool, best_tool
from pisigma.kinematics.forward import forward_kinematics
from pisigma.kinematics.parameter_jacobian import identification_jacobian
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import numbers_of_names
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.row_poses import nominal_poses_of_rows, poses_of_rows
from pisigma.robot.description import Robot
from pisigma.se3 import rotation_vector
from pisigma.verification.arm import PredictingArm
from pisigma.verification.cause import Cause, length_text
from pisigma.verification.free_joint import freed_joints
from pisigma.verification.joint_faults import NEAR_BEST, NOTICED, joint_causes, likely_maps
from pisigma.verification.pose_faults import other_conventions, units_and_frames
from pisigma.verification.row_faults import MARGIN, explains_nothing, shifted_rows
from pisigma.verification.target_faults import better_labellings, fitted_poses

SMALL_SHARE = 2e-4
"""Share of the reach below which errors come from no fault of a joint column."""
COLLAPSED = 0.25
"""Share of the errors that is left, at most, where a setup fault explains them."""
PLAUSIBLE_SHARE = 0.01
"""Share of the reach that the errors which are left may have, at most."""
AS_GOOD = 1.5
"""A simpler explanation is believed where its errors are not larger than the best by this factor."""
MOST_ROWS = 1_000
"""Rows that explanations are tried on, spread over all of them."""
MOST_ROWS_AS_DRAWN = 150
"""The same of the robot as drawn, where base and tool are fitted to them under every hypothesis."""
FEWEST_ROWS_AS_DRAWN = 24
"""Base and tool, as 39 unknowns of an affine fit, leave too few of the values of fewer rows."""
USUAL = 1e-3
"""Usual prior standard deviation of geometric errors [m and rad]."""
MOST_CONVENTIONS = 4
"""Conventions of orientations that are looked at again, at most."""
FEWEST_SPARE = 6
"""Measured numbers that must be left over beyond what is fitted."""
UNRELATED = (
    "The measured positions have nothing to do with the joint values of their rows, so that rows of one side belong to "
    "other rows of the other; look for a side that was sorted, or that is of another program."
)
_MOVED = {
    "frame": (
        "the measuring frame has moved",
        "the sensor or what it measures from stands elsewhere than when the model was fitted (if it was moved, verify "
        "with --fit-frame)",
    ),
    "tool": (
        "another tool or target is mounted",
        "another point of the tool was measured than when the model was fitted",
    ),
}


@dataclass(frozen=True)
class SetupFault:
    """An explanation under which the errors collapse.

    Attributes:
        kinds: those that it is about, see `Cause.kind`.
        clause: what is wrong, such as "the sign of joint 3 is reversed".
        advice: what to check.
        before: root mean square of the position errors [m].
        after: what it falls to [m].
        after_nominal: what that of the nominal robot falls to [m]; NaN where the explanation is about the correction.
        before_rotation: as `before`, of the rotation errors [rad]; NaN where none was measured.
        after_rotation: what it falls to [rad].
        moved: how far the zeros of joints have moved at most [rad or m]; infinite where it is about something else.
    """

    kinds: tuple[str, ...]
    clause: str
    advice: str
    before: float
    after: float
    after_nominal: float
    before_rotation: float
    after_rotation: float
    moved: float = math.inf

    @property
    def sentence(self) -> str:
        """What is wrong, what the errors fall to without it, and what to check."""
        clause = self.clause[:1].upper() + self.clause[1:]
        if not np.isfinite(self.after):
            return f"{clause}; {self.advice}."
        fall = f"from {length_text(self.before)} to {length_text(self.after)} RMS"
        if np.isfinite(self.before_rotation):
            degrees = np.rad2deg([self.before_rotation, self.after_rotation])
            fall += f" and from {degrees[0]:.3g} deg to {degrees[1]:.3g} deg"
        if np.isfinite(self.after_nominal):
            fall += f" (those of the nominal robot to {length_text(self.after_nominal)})"
        return f"{clause}: with this set right, the errors fall {fall}; {self.advice}."

    def to_json(self) -> dict[str, object]:
        """Return kinds, sentence and figures in mm and, where measured, in deg."""
        figures = {
            "before_rms_mm": self.before * 1e3,
            "after_rms_mm": self.after * 1e3,
            "after_nominal_rms_mm": self.after_nominal * 1e3,
            "before_rms_deg": float(np.rad2deg(self.before_rotation)),
            "after_rms_deg": float(np.rad2deg(self.after_rotation)),
        }
        measured = {name: value for name, value in figures.items() if np.isfinite(value)}
        return {"kinds": list(self.kinds), "sentence": self.sentence, **measured}


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """Predicted poses where something is taken to be wrong.

    Attributes:
        q: the joint values that the robot then had [rad or m].
        T: the poses.
        measured: measured poses, in the units that they then have.
        causes: what is wrong.
        fitted: numbers that were fitted.
    """

    q: Float64[Tensor, "rows dof"]
    T: Float64[Tensor, "rows 4 4"]
    measured: MeasuredPoses
    causes: tuple[Cause, ...] = ()
    fitted: int = 0

    @property
    def size(self) -> float:
        """How much is assumed; a frame and a tool together less than both alone, as a new set-up has both."""
        kinds = {cause.kind for cause in self.causes}
        return sum(cause.size for cause in self.causes) - (1 if {"frame", "tool"} <= kinds else 0)

    @property
    def error(self) -> float:
        """Root mean square of the errors [m], as if nothing had been fitted."""
        spare = self.measured.values - self.fitted
        if spare < FEWEST_SPARE:
            return float("inf")
        mean = float(self.measured.squares(self.T).mean()) * self.measured.values / spare
        return float(np.sqrt(mean)) if np.isfinite(mean) else float("inf")

    def rms(self) -> tuple[float, float]:
        """Root mean squares of positions [m] and, NaN where none was measured, of rotations [rad]."""
        position = float((self.measured.position - self.T[:, :3, 3]).square().sum(-1).mean().sqrt())
        R = (self.measured.rotation @ self.T[:, :3, :3].mT)[self.measured.has_rotation]
        return position, float(rotation_vector(R).square().sum(-1).mean().sqrt())

    def with_cause(self, cause: Cause, T: Float64[Tensor, "rows 4 4"], fitted: int) -> "_Hypothesis":
        """Add a cause, under which the predicted poses are others."""
        return replace(self, T=T, causes=(*self.causes, cause), fitted=self.fitted + fitted)


def either(faults: Sequence[SetupFault]) -> SetupFault:
    """Join faults that explain the errors about equally well, the best first, as alternatives."""
    clauses = dict.fromkeys(fault.clause for fault in faults)
    advice = dict.fromkeys(fault.advice for fault in faults)
    return replace(
        faults[0], clause=", or ".join(clauses), advice="; ".join(advice), moved=max(f.moved for f in faults)
    )


def find_setup_faults(
    model: CalibratedModel, nominal: CalibratedModel, measurements: Measurements
) -> tuple[SetupFault, ...]:
    """Find what makes the errors of a model collapse to a quarter or less, the simplest first.

    Tried are: another frame and another tool (rigid transforms that fit best), positions in other units or mirrored,
    orientations in another convention, rows shifted against each other, degrees for radians, millimetres for metres and
    the reverse in joint columns, all orders and all signs of the joints, pairs of coupled joints, zeros moved by
    quarter turns or one zero moved by anything, and a correction that was applied once more or once less than logged;
    each also together with another frame and tool, which a new set-up of the sensor has. Several are returned where
    they explain equally well. Where nothing explains the errors, the robot as drawn is tried: see
    `find_faults_as_drawn`.

    Args:
        model: the model.
        nominal: the nominal robot with the base and tool that suit it best; only shows what its errors fall to.
        measurements: rows with positions in frames and of targets that the model has; limits do not matter.

    Returns:
        Nothing where errors are below 0.02 mm, or where nothing explains them.
    """
    some = measurements.select(_spread(_measured_rows(measurements), MOST_ROWS))
    T = poses_of_rows(model, some)
    predicted = torch.isfinite(T).flatten(1).all(-1)
    if not bool(predicted.any()):
        return ()
    some = some.select(predicted)
    here = _Hypothesis(some.q, T[predicted], MeasuredPoses.of(some, LEVER_SHARE * model.robot.reach))
    if not here.error > NOTICED:
        return ()
    arm = PredictingArm(model.robot, model)
    chosen = _simplest(here, list(_hypotheses(arm, some, here)), model.robot.reach)
    faults = tuple(_fault(here, other, _nominal_error(nominal, some, other)) for other in chosen)
    return faults or find_faults_as_drawn(model.robot, measurements)


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
    rows = _largest_group(measurements)
    if rows.rows < FEWEST_ROWS_AS_DRAWN:
        return ()
    chosen = _spread(torch.arange(MARGIN, rows.rows - MARGIN), MOST_ROWS_AS_DRAWN)
    some, arm = rows.select(chosen), PredictingArm(robot)
    measured = MeasuredPoses.of(some, LEVER_SHARE * robot.reach)
    raw = _Hypothesis(some.q, arm.poses(some), measured)
    here, usual = next(_in_frames(arm, some, raw)), usual_error(robot, some.q)
    if len(set(measurements.target)) > 1:
        named = _named_otherwise(robot, measurements, usual)
        if named or not here.error > usual:
            return named
    if not here.error > usual:
        return ()
    hypotheses = [*_hypotheses(arm, some, raw), *_with_joints(arm, shifted_rows(arm, rows, chosen, measured))]
    faults = _simplest(here, hypotheses, robot.reach)
    if not faults:
        freed = ((q, measured, cause) for q, cause in freed_joints(arm, some, measured))
        faults = _simplest(here, _with_joints(arm, freed, values=1) + _labelled(robot, rows), robot.reach)
    return tuple(_fault(here, other, float("nan")) for other in faults)


def _named_otherwise(robot: Robot, measurements: Measurements, usual: float) -> tuple[SetupFault, ...]:
    """Find better names for the targets of the frame that most rows are of, where errors are larger than usual [m]."""
    rows = _largest_group(measurements, by_target=False)
    here = _Hypothesis(rows.q, fitted_poses(robot, rows), MeasuredPoses.of(rows, LEVER_SHARE * robot.reach))
    if not here.error > usual:
        return ()
    return tuple(
        _fault(here, other, float("nan")) for other in _simplest(here, _labelled(robot, rows), robot.reach)
    )


def _labelled(robot: Robot, rows: Measurements) -> list[_Hypothesis]:
    """Make hypotheses of other names of targets."""
    some = rows.select(_spread(torch.arange(rows.rows), MOST_ROWS))
    measured = MeasuredPoses.of(some, LEVER_SHARE * robot.reach)
    return [
        _Hypothesis(some.q, one.T, measured, (one.cause,), 3 * one.targets)
        for one in better_labellings(robot, some)
    ]


def _with_joints(
    arm: PredictingArm,
    tried: Iterable[tuple[Float64[Tensor, "rows dof"], MeasuredPoses, Cause]],
    values: int = 0,
) -> list[_Hypothesis]:
    """Make hypotheses of joint values of the robot as drawn, of which every row has some values of its own."""
    return [
        other
        for q, measured, cause in tried
        for rows in [Measurements(q=q)]
        for other in _in_frames(
            arm, rows, _Hypothesis(q, arm.poses(rows), measured, (cause,), values * len(q))
        )
    ]


def are_unrelated(robot: Robot, measurements: Measurements) -> bool:
    """Say whether positions have nothing to do with the joint values of their rows, as where one side was sorted."""
    rows = _largest_group(measurements)
    if rows.rows < FEWEST_ROWS_AS_DRAWN:
        return False
    assert rows.position is not None
    return explains_nothing(forward_kinematics(robot, rows.q), rows.position)


def usual_error(robot: Robot, q: Float64[Tensor, "rows dof"]) -> float:
    """Compute the root mean square of the position errors [m] that geometric errors of 1 mm and 1 mrad make.

    Their covariance is `J P J^T` for the derivative `J` of the position by the parameters of all rows and the prior
    covariance `P`; that base and tool take a part of it is left out.
    """
    J = identification_jacobian(robot, q)[1][:, :3, : 5 * len(robot.rows)]
    return USUAL * float(J.square().sum((1, 2)).mean().sqrt())


def _measured_rows(measurements: Measurements) -> Int64[Tensor, " rows"]:
    """List the rows with a position."""
    assert measurements.position is not None
    return torch.isfinite(measurements.position).all(-1).nonzero()[:, 0]


def _largest_group(measurements: Measurements, by_target: bool = True) -> Measurements:
    """Select the rows with positions of the frame (and target) that most are of; none where none was measured."""
    if measurements.position is None:
        return measurements.select(torch.arange(0))
    rows = _measured_rows(measurements)
    names = [
        (measurements.frame[row], measurements.target[row] if by_target else "") for row in rows.tolist()
    ]
    most = Counter(names).most_common(1)[:1]
    group = measurements.select(rows[torch.tensor([name == most[0][0] for name in names], dtype=torch.bool)])
    return replace(group, pair=None, distance=None)


def _spread(rows: Int64[Tensor, " rows"], most: int) -> Int64[Tensor, " chosen"]:
    """Choose some of the rows, spread over them."""
    count = min(len(rows), most)
    return rows[torch.linspace(0, len(rows) - 1, count).round().long()]


def _simplest(here: _Hypothesis, hypotheses: Sequence[_Hypothesis], reach: float) -> list[_Hypothesis]:
    """Choose the simplest of the hypotheses that explain the errors about equally well."""
    least = min(COLLAPSED * here.error, PLAUSIBLE_SHARE * reach)
    explaining = [other for other in hypotheses if other.error <= least]
    best = min((other.error for other in explaining), default=0.0)
    explaining = [other for other in explaining if other.error <= AS_GOOD * best]
    simplest = min((other.size for other in explaining), default=0.0)
    chosen: dict[object, _Hypothesis] = {}
    for other in sorted((o for o in explaining if o.size <= simplest), key=lambda other: other.error):
        chosen.setdefault(tuple((cause.kind, cause.joints) for cause in other.causes), other)
    return list(chosen.values())


def _hypotheses(arm: PredictingArm, some: Measurements, here: _Hypothesis) -> Iterator[_Hypothesis]:
    """Go through everything that may explain the errors; first that nothing is wrong, which explains none."""
    yield from _in_frames(arm, some, here)
    for measured, cause in units_and_frames(here.measured):
        yield from _in_frames(arm, some, replace(here, measured=measured, causes=(cause,)))
    if arm.model is not None:
        for T, clause, advice in _other_corrections(arm.model, some, here.T):
            cause = Cause("correction", clause, advice, 1.0)
            yield from _in_frames(arm, some, here.with_cause(cause, T, fitted=0))
    if not here.error > SMALL_SHARE * arm.robot.reach:
        return
    for measured, cause in _likely_conventions(arm, here):
        yield from _in_frames(arm, some, replace(here, measured=measured, causes=(cause,)))
    maps = likely_maps(arm, some, here.measured)
    for number, q in enumerate(maps.of(some.q)):
        T = arm.poses(replace(some, q=q))
        if bool(torch.isfinite(T).all()):
            causes = joint_causes(maps, number, arm.robot)
            yield from _in_frames(arm, some, _Hypothesis(q, T, here.measured, causes, 1))


def _likely_conventions(arm: PredictingArm, here: _Hypothesis) -> Iterator[tuple[MeasuredPoses, Cause]]:
    """Find conventions of orientations that may explain the errors."""
    turned = here.measured.has_rotation
    if not bool(turned.any()):
        return
    eye = torch.eye(3).to(here.T)
    tried = list(other_conventions(here.measured.rotation))
    R = torch.where(turned[:, None, None], torch.stack([rotation for rotation, _ in tried]), eye)
    for errors in arm.errors_in_frames(here.T, replace(here.measured, rotation=R)):
        limit = max(NEAR_BEST**2 * float(errors.min()), NOTICED**2)
        for number in errors.argsort()[:MOST_CONVENTIONS].tolist():
            if float(errors[number]) <= limit:
                advice = "write orientations as the documentation of measurement files says"
                cause = Cause("rotation", tried[number][1], advice, 1.0)
                yield replace(here.measured, rotation=R[number]), cause


def _other_corrections(
    model: CalibratedModel, some: Measurements, T: Float64[Tensor, "rows 4 4"]
) -> Iterator[tuple[Float64[Tensor, "rows 4 4"], str, str]]:
    """Predict poses with the correction once more than logged, and once less (first order: its square is small)."""
    T_nominal = nominal_poses_of_rows(model, some)
    yield (
        T_nominal,
        "the rows fit the nominal robot at the joint values of the file",
        "either the log holds joint values from before the correction, or they were corrected once more on the way to "
        "the robot, or the model is of another robot",
    )
    T_less = T.clone()
    T_less[:, :3, 3] = 2 * T[:, :3, 3] - T_nominal[:, :3, 3]
    T_less[:, :3, :3] = T[:, :3, :3] @ T_nominal[:, :3, :3].mT @ T[:, :3, :3]
    yield (
        T_less,
        "the robot ran without the correction that the joint values of the file hold",
        "the log holds corrected joint values, but the robot was sent to the uncorrected ones",
    )


def _in_frames(arm: PredictingArm, some: Measurements, here: _Hypothesis) -> Iterator[_Hypothesis]:
    """Go on to the same hypothesis with another frame, another tool, and both; as drawn, both are fitted anyway."""
    if arm.model is None:
        base, tool = best_base_and_tool(here.T, here.measured)
        yield replace(here, T=base @ here.T @ tool)
        return
    yield here
    frames, targets = numbers_of_names(some.frame), numbers_of_names(some.target)
    per_tool = 6 if bool(here.measured.has_rotation.any()) else 3
    count, tools = int(frames.max()) + 1, int(targets.max()) + 1
    X, Y = _per_group(best_base, frames, here), _per_group(best_tool, targets, here)
    yield here.with_cause(_moved("frame", X), X @ here.T, 6 * count)
    yield here.with_cause(_moved("tool", Y), here.T @ Y, per_tool * tools)
    if count == 1 and tools == 1:
        base, tool = best_base_and_tool(here.T, here.measured)
        moved = here.with_cause(_moved("frame", base[None]), base @ here.T, 6)
        yield moved.with_cause(_moved("tool", tool[None]), base @ here.T @ tool, per_tool)


def _per_group(
    fit: Callable[[Tensor, MeasuredPoses], Tensor], group: Int64[Tensor, " rows"], here: _Hypothesis
) -> Float64[Tensor, "rows 4 4"]:
    """Fit the transform of every row's frame or target."""
    X = torch.empty_like(here.T)
    for number in range(int(group.max()) + 1):
        rows = group == number
        X[rows] = fit(here.T[rows], here.measured.select(rows))
    return X


def _moved(kind: str, X: Float64[Tensor, "rows 4 4"]) -> Cause:
    """Say that the "frame" or the "tool" has moved, and how far the farthest of some transforms shifts and turns."""
    clause, advice = _MOVED[kind]
    motion = f"shifted by {length_text(float(X[:, :3, 3].norm(dim=-1).max()))}"
    turn = float(torch.rad2deg(rotation_vector(X[:, :3, :3]).norm(dim=-1)).max())
    motion += f", turned by {turn:.3g} deg" if turn > 1e-9 else ""
    return Cause(kind, f"{clause} ({motion})", advice, 2.0)


def _nominal_error(nominal: CalibratedModel, some: Measurements, other: _Hypothesis) -> float:
    """Compute the root mean square of the position errors [m] of the nominal robot under a hypothesis."""
    kinds = {cause.kind for cause in other.causes}
    if "correction" in kinds:
        return float("nan")
    T = poses_of_rows(nominal, replace(some, q=other.q))
    tried = _in_frames(PredictingArm(nominal.robot, nominal), some, _Hypothesis(other.q, T, other.measured))
    wanted = kinds & {"frame", "tool"}
    return next(one.rms()[0] for one in tried if {cause.kind for cause in one.causes} == wanted)


def _fault(here: _Hypothesis, other: _Hypothesis, after_nominal: float) -> SetupFault:
    (before, before_rotation), (after, after_rotation) = here.rms(), other.rms()
    return SetupFault(
        kinds=tuple(cause.kind for cause in other.causes),
        clause=" and ".join(cause.clause for cause in other.causes),
        advice="; ".join(cause.advice for cause in other.causes),
        before=before,
        after=after,
        after_nominal=after_nominal,
        before_rotation=before_rotation,
        after_rotation=after_rotation,
        moved=max(cause.moved for cause in other.causes),
    )
