"""The usual setup faults behind large errors, recognised by trying each on the data."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.judging.frame_fits import LEVER_SHARE, MeasuredPoses, best_base, best_base_and_tool, best_tool
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import numbers_of_names
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.row_poses import nominal_poses_of_rows, poses_of_rows
from pisigma.se3 import rotation_vector
from pisigma.verification.joint_faults import NOTICED, Cause, joint_causes, likely_maps

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
FEWEST_SPARE = 6
"""Measured numbers that must be left over beyond what is fitted."""
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
        kinds: of "frame", "tool", "position_unit", "joint_unit", "joint_order", "joint_sign", "joint_zero" and
            "correction" those that it is about.
        clause: what is wrong, such as "the sign of joint 3 is reversed".
        advice: what to check.
        before: root mean square of the position errors [m].
        after: what it falls to [m].
        after_nominal: what that of the nominal robot falls to [m]; NaN where the explanation is about the correction.
        before_rotation: as `before`, of the rotation errors [rad]; NaN where none was measured.
        after_rotation: what it falls to [rad].
    """

    kinds: tuple[str, ...]
    clause: str
    advice: str
    before: float
    after: float
    after_nominal: float
    before_rotation: float
    after_rotation: float

    @property
    def sentence(self) -> str:
        """What is wrong, what the errors fall to without it, and what to check."""
        fall = f"from {length_text(self.before)} to {length_text(self.after)} RMS"
        if np.isfinite(self.before_rotation):
            degrees = np.rad2deg([self.before_rotation, self.after_rotation])
            fall += f" and from {degrees[0]:.3g} deg to {degrees[1]:.3g} deg"
        if np.isfinite(self.after_nominal):
            fall += f" (those of the nominal robot to {length_text(self.after_nominal)})"
        clause = self.clause[:1].upper() + self.clause[1:]
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


def find_setup_faults(
    model: CalibratedModel, nominal: CalibratedModel, measurements: Measurements
) -> tuple[SetupFault, ...]:
    """Find what makes the errors of a model collapse to a quarter or less, the simplest first.

    Tried are: another frame and another tool (rigid transforms that fit best), positions off by 1000 either way,
    degrees for radians, millimetres for metres and the reverse in joint columns, all orders and all signs of the
    joints, zeros moved by quarter turns or one zero moved by anything, and a correction that was applied once more
    or once less than logged; the joints' faults also together with another frame and tool, which a new set-up of
    the sensor has. Several are returned where they explain equally well.

    Args:
        model: the model.
        nominal: the nominal robot with the base and tool that suit it best; only shows what its errors fall to.
        measurements: rows with positions in frames and of targets that the model has; limits do not matter.

    Returns:
        Nothing where errors are below 0.02 mm, or where nothing explains them.
    """
    some = _spread(measurements)
    T = poses_of_rows(model, some)
    predicted = torch.isfinite(T).flatten(1).all(-1)
    if not bool(predicted.any()):
        return ()
    some = some.select(predicted)
    here = _Hypothesis(some.q, T[predicted], MeasuredPoses.of(some, LEVER_SHARE * model.robot.reach))
    if not here.error > NOTICED:
        return ()
    least = min(COLLAPSED * here.error, PLAUSIBLE_SHARE * model.robot.reach)
    explaining = [other for other in _hypotheses(model, some, here) if other.error <= least]
    best = min((other.error for other in explaining), default=0.0)
    explaining = [other for other in explaining if other.error <= AS_GOOD * best]
    simplest = min((other.size for other in explaining), default=0.0)
    chosen: dict[object, _Hypothesis] = {}
    for other in sorted((o for o in explaining if o.size <= simplest), key=lambda other: other.error):
        chosen.setdefault(tuple((cause.kind, cause.joints) for cause in other.causes), other)
    return tuple(_fault(here, other, _nominal_error(nominal, some, other)) for other in chosen.values())


def _spread(measurements: Measurements) -> Measurements:
    """Choose rows with a position, at most `MOST_ROWS` of them."""
    assert measurements.position is not None
    rows = torch.isfinite(measurements.position).all(-1).nonzero()[:, 0]
    count = min(len(rows), MOST_ROWS)
    return measurements.select(rows[torch.linspace(0, len(rows) - 1, count).round().long()])


def _hypotheses(model: CalibratedModel, some: Measurements, here: _Hypothesis) -> Iterator[_Hypothesis]:
    """Go through everything that may explain the errors; first that nothing is wrong, which explains none."""
    yield from _all_frames(model, some, here)
    for factor, are, named in ((1e-3, "millimetres", "metres"), (1e3, "metres", "millimetres")):
        clause = f"x, y and z are {are} that are named {named}"
        unit = Cause("position_unit", clause, "correct the unit in the column names", 1.0)
        scaled = replace(here, measured=here.measured.scaled(factor), causes=(unit,))
        yield from _all_frames(model, some, scaled)
    for T, clause, advice in _other_corrections(model, some, here.T):
        cause = Cause("correction", clause, advice, 1.0)
        yield from _all_frames(model, some, here.with_cause(cause, T, fitted=0))
    if here.error > SMALL_SHARE * model.robot.reach:
        maps = likely_maps(model, some, here.measured)
        for number, q in enumerate(maps.of(some.q)):
            T = poses_of_rows(model, replace(some, q=q))
            if bool(torch.isfinite(T).all()):
                causes = joint_causes(maps, number, model.robot)
                yield from _all_frames(model, some, _Hypothesis(q, T, here.measured, causes, 1))


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


def _all_frames(model: CalibratedModel, some: Measurements, here: _Hypothesis) -> Iterator[_Hypothesis]:
    """Go on to the same hypothesis with another frame, another tool, and both."""
    yield here
    frames, targets = numbers_of_names(some.frame), numbers_of_names(some.target)
    per_tool = 6 if bool(here.measured.has_rotation.any()) else 3
    count, tools = int(frames.max()) + 1, int(targets.max()) + 1
    X, Y = _per_group(best_base, frames, here), _per_group(best_tool, targets, here)
    yield here.with_cause(_moved("frame", X), X @ here.T, 6 * count)
    yield here.with_cause(_moved("tool", Y), here.T @ Y, per_tool * tools)
    if count == 1 and tools == 1:
        base, tool = best_base_and_tool(here.T, here.measured, model.robot.reach)
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
    tried = _all_frames(nominal, some, _Hypothesis(other.q, T, other.measured))
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
    )


def length_text(length: float) -> str:
    """Write a length [m] in millimetres, with three digits or all whole ones."""
    return f"{length * 1e3:.3g} mm" if abs(length) < 1 else f"{length * 1e3:,.0f} mm"
