"""The usual setup faults behind large errors, recognised by trying each on the data."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.judging.frame_fits import LEVER_SHARE, Seen, best_base, best_base_and_tool, best_tool
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.row_poses import nominal_poses_of_rows, poses_of_rows
from pisigma.se3 import rotation_vector
from pisigma.verification.joint_faults import Part, joint_parts
from pisigma.verification.joint_search import NOTICED, likely_maps

SMALL_SHARE = 2e-4
"""Share of the reach below which errors come from no mixed-up joint column."""
COLLAPSED = 0.25
"""What is left of the errors, at most, where a setup fault explains them."""
PLAUSIBLE_SHARE = 0.01
"""Share of the reach that the errors which are left may have, at most."""
AS_GOOD = 1.5
"""A simpler explanation is believed where its errors are not larger than the best by this factor."""
MOST_ROWS = 1_000
"""Rows that explanations are tried on, spread over all of them."""
FEWEST_SPARE = 6
"""Measured numbers that must be left over beyond what is fitted."""


@dataclass(frozen=True)
class SetupFault:
    """An explanation under which the errors collapse.

    Attributes:
        kinds: what was mixed up: of "frame", "tool", "position_unit", "joint_unit", "joint_order", "joint_sign",
            "joint_zero", "correction".
        sentence: what it is, with figures, and what to check.
        before: root mean square of the position errors [m].
        after: what it falls to [m].
        after_nominal: what that of the nominal robot falls to [m]; NaN where the explanation is about the correction.
        before_rotation: as `before`, of the rotation errors [rad]; NaN where none was measured.
        after_rotation: what it falls to [rad].
    """

    kinds: tuple[str, ...]
    sentence: str
    before: float
    after: float
    after_nominal: float
    before_rotation: float
    after_rotation: float

    def in_file_units(self) -> dict[str, object]:
        """Kinds, sentence and figures in mm and, where measured, in deg."""
        found: dict[str, object] = {
            "kinds": list(self.kinds),
            "sentence": self.sentence,
            "before_rms_mm": self.before * 1e3,
            "after_rms_mm": self.after * 1e3,
        }
        if np.isfinite(self.after_nominal):
            found["after_nominal_rms_mm"] = self.after_nominal * 1e3
        if np.isfinite(self.before_rotation):
            found["before_rms_deg"] = float(np.rad2deg(self.before_rotation))
            found["after_rms_deg"] = float(np.rad2deg(self.after_rotation))
        return found


@dataclass(frozen=True, eq=False)
class _Explained:
    """Predicted poses under a hypothesis.

    Attributes:
        q: the joint values of the hypothesis [rad or m].
        T: the poses.
        seen: what was measured, in the units of the hypothesis.
        parts: what it assumes.
        fitted: numbers that were fitted.
    """

    q: Float64[Tensor, "rows dof"]
    T: Float64[Tensor, "rows 4 4"]
    seen: Seen
    parts: tuple[Part, ...]
    fitted: int

    @property
    def size(self) -> float:
        """How much is assumed; a frame and a tool together less than both alone, as a new set-up has both."""
        kinds = {part.kind for part in self.parts}
        return sum(part.size for part in self.parts) - (1 if {"frame", "tool"} <= kinds else 0)

    @property
    def error(self) -> float:
        """Root mean square of the errors [m], as if nothing had been fitted."""
        spare = self.seen.values - self.fitted
        if spare < FEWEST_SPARE:
            return float("inf")
        mean = float(self.seen.squares(self.T).mean()) * self.seen.values / spare
        return float(np.sqrt(mean)) if np.isfinite(mean) else float("inf")

    def rms(self) -> tuple[float, float]:
        """Of positions [m] and, NaN where none was measured, of rotations [rad]."""
        position = float((self.seen.position - self.T[:, :3, 3]).square().sum(-1).mean().sqrt())
        R = (self.seen.rotation @ self.T[:, :3, :3].mT)[self.seen.turned]
        return position, float(rotation_vector(R).square().sum(-1).mean().sqrt())


def find_mix_ups(
    model: CalibratedModel, nominal: CalibratedModel, measurements: Measurements
) -> tuple[SetupFault, ...]:
    """Look for what makes the errors of a model collapse to a quarter or less, the simplest first.

    Tried are: another frame and another tool (rigid transforms that fit best), positions off by 1000 either way,
    degrees for radians, millimetres for metres and the reverse in joint columns, all orders and all signs of the
    joints, zeros moved by quarter turns or one zero moved by anything, and a correction that was applied once more
    or once less than logged; the joints' setup faults also together with another frame and tool, which a new set-up of
    the sensor has. Several are given where they explain equally well.

    Args:
        model: the model.
        nominal: the nominal robot with the base and tool that suit it best; only tells what its errors fall to.
        measurements: rows with positions in frames and of targets that the model knows; limits do not matter.

    Returns:
        Nothing where errors are below 0.02 mm, or where nothing explains them.
    """
    some = _spread(measurements)
    seen = Seen.of(some, LEVER_SHARE * model.robot.reach)
    T = poses_of_rows(model, some)
    known = torch.isfinite(T).flatten(1).all(-1)
    if not bool(known.any()):
        return ()
    some, seen, T = some.select(known), seen.select(known), T[known]
    here = _Explained(some.q, T, seen, (), 0)
    if not here.error > NOTICED:
        return ()
    least = min(COLLAPSED * here.error, PLAUSIBLE_SHARE * model.robot.reach)
    found = [other for other in _hypotheses(model, some, here) if other.error <= least]
    best = min((other.error for other in found), default=0.0)
    found = [other for other in found if other.error <= AS_GOOD * best]
    simplest = min((other.size for other in found), default=0.0)
    chosen: dict[object, _Explained] = {}
    for other in sorted((o for o in found if o.size <= simplest), key=lambda other: other.error):
        chosen.setdefault(tuple((part.kind, part.joints) for part in other.parts), other)
    return tuple(_mix_up(here, other, _nominal_error(nominal, some, other)) for other in chosen.values())


def _spread(measurements: Measurements) -> Measurements:
    """Rows with a position, at most `MOST_ROWS` of them."""
    assert measurements.position is not None
    rows = torch.isfinite(measurements.position).all(-1).nonzero()[:, 0]
    count = min(len(rows), MOST_ROWS)
    return measurements.select(rows[torch.linspace(0, len(rows) - 1, count).round().long()])


def _hypotheses(model: CalibratedModel, some: Measurements, here: _Explained) -> Iterator[_Explained]:
    """Everything that may explain the errors."""
    seen, T = here.seen, here.T
    yield from _elsewhere(model, some, here)
    for factor, done, are, named in (
        (1e-3, "divided", "millimetres", "metres"),
        (1e3, "multiplied", "metres", "millimetres"),
    ):
        what = f"x, y and z {done} by 1000 ({are} that are named {named})"
        unit = Part("position_unit", what, "correct the unit in the column names", 1)
        yield from _all_frames(model, some, _Explained(some.q, T, seen.scaled(factor), (unit,), 0))
    for T_other, what, advice in _other_corrections(model, some, T):
        part = Part("correction", what, advice, 1)
        yield from _all_frames(model, some, _Explained(some.q, T_other, seen, (part,), 0))
    if here.error > SMALL_SHARE * model.robot.reach:
        maps = likely_maps(model, some, seen)
        for number in range(len(maps.order)):
            chosen = maps.select(torch.tensor([number]))
            q = chosen.of(some.q)[0]
            T_other = poses_of_rows(model, replace(some, q=q))
            parts = tuple(joint_parts(chosen, 0, model.robot))
            if bool(torch.isfinite(T_other).all()):
                yield from _all_frames(model, some, _Explained(q, T_other, seen, parts, 1))


def _other_corrections(
    model: CalibratedModel, some: Measurements, T: Float64[Tensor, "rows 4 4"]
) -> Iterator[tuple[Float64[Tensor, "rows 4 4"], str, str]]:
    """Poses with the correction once more than logged, and once less (first order: its square is far below)."""
    T_nominal = nominal_poses_of_rows(model, some)
    yield (
        T_nominal,
        "the nominal robot at the joint values of the file",
        "either the log holds joint values from before the correction, or they were corrected once more on the way to "
        "the robot, or the model is of another robot",
    )
    T_less = T.clone()
    T_less[:, :3, 3] = 2 * T[:, :3, 3] - T_nominal[:, :3, 3]
    T_less[:, :3, :3] = T[:, :3, :3] @ T_nominal[:, :3, :3].mT @ T[:, :3, :3]
    yield (
        T_less,
        "the correction taken off the joint values of the file",
        "the log holds corrected joint values, but the robot was sent to the uncorrected ones",
    )


def _all_frames(model: CalibratedModel, some: Measurements, found: _Explained) -> Iterator[_Explained]:
    yield found
    yield from _elsewhere(model, some, found)


def _elsewhere(model: CalibratedModel, some: Measurements, found: _Explained) -> Iterator[_Explained]:
    """The same with another frame, another tool, or both."""
    frames, targets = _numbered(some.frame), _numbered(some.target)
    per_tool = 6 if bool(found.seen.turned.any()) else 3
    count, tools = int(frames.max()) + 1, int(targets.max()) + 1
    X, Y = _per_group(best_base, frames, found), _per_group(best_tool, targets, found)
    frame, tool = (_moved(kind, at) for kind, at in (("frame", X), ("tool", Y)))
    yield replace(found, T=X @ found.T, parts=(*found.parts, frame), fitted=found.fitted + 6 * count)
    yield replace(found, T=found.T @ Y, parts=(*found.parts, tool), fitted=found.fitted + per_tool * tools)
    if count == 1 and tools == 1:
        base, behind = best_base_and_tool(found.T, found.seen, model.robot.reach)
        both = (*found.parts, _moved("frame", base[None]), _moved("tool", behind[None]))
        yield replace(found, T=base @ found.T @ behind, parts=both, fitted=found.fitted + 6 + per_tool)


def _numbered(names: tuple[str, ...]) -> Int64[Tensor, " rows"]:
    places = {name: number for number, name in enumerate(dict.fromkeys(names))}
    return torch.tensor([places[name] for name in names], dtype=torch.int64)


def _per_group(
    fit: Callable[[Tensor, Seen], Tensor], group: Int64[Tensor, " rows"], found: _Explained
) -> Float64[Tensor, "rows 4 4"]:
    """The transform of every row's frame or target."""
    result = torch.empty_like(found.T)
    for number in range(int(group.max()) + 1):
        rows = group == number
        result[rows] = fit(found.T[rows], found.seen.select(rows))
    return result


def _moved(kind: str, X: Float64[Tensor, "rows 4 4"]) -> Part:
    """Another frame or tool, with how far the farthest one is moved."""
    shift = length_text(float(X[:, :3, 3].norm(dim=-1).max()))
    turn = float(torch.rad2deg(rotation_vector(X[:, :3, :3]).norm(dim=-1)).max())
    turned = f", turned by {turn:.3g} deg" if turn > 1e-9 else ""
    if kind == "frame":
        what = f"another measuring frame (shifted by {shift}{turned})"
        advice = (
            "the sensor or what it measures from stands elsewhere than when the model was fitted (if it was moved, "
            "verify with --fit-frame)"
        )
    else:
        what = f"another tool (shifted by {shift}{turned})"
        advice = "another point of the tool was measured than when the model was fitted"
    return Part(kind, what, advice, 2)


def _nominal_error(nominal: CalibratedModel, some: Measurements, found: _Explained) -> float:
    """Root mean square of the position errors [m] of the nominal robot under an explanation."""
    kinds = {part.kind for part in found.parts}
    if "correction" in kinds:
        return float("nan")
    T = poses_of_rows(nominal, replace(some, q=found.q))
    tried = _all_frames(nominal, some, _Explained(found.q, T, found.seen, (), 0))
    wanted = kinds & {"frame", "tool"}
    return next(other.rms()[0] for other in tried if {part.kind for part in other.parts} == wanted)


def _mix_up(here: _Explained, found: _Explained, after_nominal: float) -> SetupFault:
    (before, before_turn), (after, after_turn) = here.rms(), found.rms()
    what = " and ".join(part.what for part in found.parts)
    advice = "; ".join(part.advice for part in found.parts)
    fall = f"from {length_text(before)} to {length_text(after)} RMS"
    if np.isfinite(before_turn):
        fall += f" and from {np.rad2deg(before_turn):.3g} deg to {np.rad2deg(after_turn):.3g} deg"
    if np.isfinite(after_nominal):
        fall += f" (those of the nominal robot to {length_text(after_nominal)})"
    kinds = tuple(part.kind for part in found.parts)
    sentence = f"With {what}, the errors fall {fall}; {advice}."
    return SetupFault(kinds, sentence, before, after, after_nominal, before_turn, after_turn)


def length_text(length: float) -> str:
    """A length [m] in millimetres, with three digits or all whole ones."""
    return f"{length * 1e3:.3g} mm" if abs(length) < 1 else f"{length * 1e3:,.0f} mm"
