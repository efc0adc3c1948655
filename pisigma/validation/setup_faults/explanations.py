"""Everything that is tried to explain large errors, and which of it is believed."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import numbers_of_names
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.row_poses import bases_of_rows, nominal_poses_of_rows, poses_of_rows
from pisigma.robot.se3 import rotation_vector
from pisigma.validation.held_out.frames.frame_fits import (
    LEVER_SHARE,
    MeasuredPoses,
    affine_error,
    best_base,
    best_base_and_tool,
    best_tool,
)
from pisigma.validation.setup_faults.arm import PredictingArm
from pisigma.validation.setup_faults.cause import Cause, length_text
from pisigma.validation.setup_faults.hypothesis import COLLAPSED, Hypothesis
from pisigma.validation.setup_faults.joint_faults import NEAR_BEST, NOTICED, joint_causes, likely_maps
from pisigma.validation.setup_faults.pose_faults import other_conventions, units_and_frames

SMALL_SHARE = 2e-4
"""Share of the reach below which errors come from no fault of a joint column."""
PLAUSIBLE_SHARE = 0.01
"""Share of the reach that the errors which are left may have, at most."""
PLAUSIBLE_TURN = PLAUSIBLE_SHARE / LEVER_SHARE
"""The same of errors of orientations [rad], which count like position errors at `LEVER_SHARE` of the reach."""
AS_GOOD = 1.5
"""A simpler explanation is believed where its errors are not larger than the best by this factor."""
MOST_CONVENTIONS = 8
"""Conventions of orientations that are looked at again, at most."""
SMALLEST_TURN = 0.01
"""[deg] A base or a tool that has turned by less has not turned."""
_MOVED = {
    "frame": (
        "base",
        "the robot or the sensor stands elsewhere than when the model was made; run again with --fit-frame, or "
        "recalibrate with --moved base",
    ),
    "tool": (
        "tool",
        "another tool or target is mounted, or another point of it was measured; run again with --fit-tool, or "
        "recalibrate with --moved tool",
    ),
}


def largest_explained(here: Hypothesis, reach: float) -> float:
    """Give the largest error [m] that an explanation of the errors may leave, of a robot of such a reach [m]."""
    return min(COLLAPSED * here.error, PLAUSIBLE_SHARE * reach)


def simplest(hypotheses: Sequence[Hypothesis], most: float) -> list[Hypothesis]:
    """Choose the simplest of the hypotheses that explain the errors, to `most` [m] at least, about equally well.

    What is left must be small beside the spread of the poses too, which millimetres that are taken for metres shrink.
    """
    explaining = [
        other for other in hypotheses if other.error <= min(most, COLLAPSED * other.measured.spread)
    ]
    best = min((other.error for other in explaining), default=0.0)
    explaining = [other for other in explaining if other.error <= AS_GOOD * best]
    simplest = min((other.size for other in explaining), default=0.0)
    chosen: dict[object, Hypothesis] = {}
    for other in sorted((o for o in explaining if o.size <= simplest), key=lambda other: other.error):
        chosen.setdefault(tuple((cause.kind, cause.joints) for cause in other.causes), other)
    return list(chosen.values())


def hypotheses(arm: PredictingArm, some: Measurements, here: Hypothesis, most: float) -> Iterator[Hypothesis]:
    """Go through everything that may explain the errors to `most` [m]; first that nothing is wrong."""
    yield from in_frames(arm, some, here, most)
    for measured, cause in units_and_frames(here.measured, here.T[:, :3, 3], "corner" in some.kinds):
        yield from in_frames(arm, some, replace(here, measured=measured, causes=(cause,)), most)
    if arm.model is not None:
        for T, clause, advice in _other_corrections(arm.model, some):
            cause = Cause("correction", clause, advice, 1.0)
            yield from in_frames(arm, some, here.with_cause(cause, T, fitted=0), most)
    if not here.error > SMALL_SHARE * arm.robot.reach:
        return
    for measured, cause in _likely_conventions(arm, here):
        yield from in_frames(arm, some, replace(here, measured=measured, causes=(cause,)), most)
    maps = likely_maps(arm, some, here.measured)
    for number, q in enumerate(maps.of(some.q)):
        T = arm.poses(replace(some, q=q))
        if bool(torch.isfinite(T).all()):
            causes = joint_causes(maps, number, arm.robot)
            yield from in_frames(arm, some, Hypothesis(q, T, here.measured, causes, 1), most)


def _likely_conventions(arm: PredictingArm, here: Hypothesis) -> Iterator[tuple[MeasuredPoses, Cause]]:
    """Find conventions of orientations that may explain the errors."""
    turned = here.measured.has_rotation
    if not bool(turned.any()):
        return
    eye = torch.eye(3).to(here.T)
    tried = list(other_conventions(here.measured.rotation))
    R = torch.where(turned[:, None, None], torch.stack([rotation for rotation, _, _ in tried]), eye)
    for errors in arm.errors_in_frames(here.T, replace(here.measured, rotation=R)):
        limit = max(NEAR_BEST**2 * float(errors.min()), NOTICED**2)
        for number in errors.argsort()[:MOST_CONVENTIONS].tolist():
            if float(errors[number]) <= limit:
                advice = "write orientations as the documentation of measurement files says"
                _, clause, size = tried[number]
                yield replace(here.measured, rotation=R[number]), Cause("rotation", clause, advice, size)


def _other_corrections(
    model: CalibratedModel, some: Measurements
) -> Iterator[tuple[Float64[Tensor, "rows 4 4"], str, str]]:
    """Predict poses with the correction once more than logged, and once less (first order: its square is small)."""
    T, T_nominal = poses_of_rows(model, some), nominal_poses_of_rows(model, some)
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


def in_frames(
    arm: PredictingArm, some: Measurements, here: Hypothesis, most: float = math.inf
) -> Iterator[Hypothesis]:
    """Go on to the same hypothesis with another frame, another tool, and both; as drawn, both are fitted anyway.

    Both are fitted only where an affine fit, which leaves less, does not leave more than `most` [m].
    """
    rows = len(here.T)
    bound = float(affine_error(here.T, here.measured)) * (1 - 13 / rows) if rows > 13 else 0.0
    if arm.model is None:
        if bound <= most**2:
            base, tool = best_base_and_tool(here.T, here.measured)
            yield replace(here, T=base @ here.T @ tool)
        return
    yield here
    frames, targets = numbers_of_names(some.frame), numbers_of_names(some.target)
    per_tool = 6 if bool(here.measured.has_rotation.any()) else 3
    count, tools = int(frames.max()) + 1, int(targets.max()) + 1
    X, Y = _per_group(best_base, frames, here), _per_group(best_tool, targets, here)
    bases = bases_of_rows(arm.model, some)
    yield here.with_cause(_moved("frame", X, bases), X @ here.T, 6 * count)
    yield here.with_cause(_moved("tool", Y), here.T @ Y, per_tool * tools)
    if count == 1 and tools == 1 and bound <= most**2:
        base, tool = best_base_and_tool(here.T, here.measured)
        moved = here.with_cause(_moved("frame", base[None], bases), base @ here.T, 6)
        yield moved.with_cause(_moved("tool", tool[None]), base @ here.T @ tool, per_tool)


def _per_group(
    fit: Callable[[Tensor, MeasuredPoses], Tensor], group: Int64[Tensor, " rows"], here: Hypothesis
) -> Float64[Tensor, "rows 4 4"]:
    """Fit the transform of every row's frame or target."""
    X = torch.empty_like(here.T)
    for number in range(int(group.max()) + 1):
        rows = group == number
        X[rows] = fit(here.T[rows], here.measured.select(rows))
    return X


def _moved(
    kind: str, X: Float64[Tensor, "#rows 4 4"], frames: Float64[Tensor, "#rows 4 4"] | None = None
) -> Cause:
    """Say that the "frame" or the "tool" has moved, and how far the farthest of some transforms takes its origin.

    Args:
        kind: which.
        X: transforms of it.
        frames: where it was, in the coordinates of the transforms; None at their origin.
    """
    what, advice = _MOVED[kind]
    origin = torch.zeros(3, 1).to(X) if frames is None else frames[:, :3, 3:]
    shift = (X[:, :3, :3] @ origin + X[:, :3, 3:] - origin).norm(dim=1).max()
    turn = float(torch.rad2deg(rotation_vector(X[:, :3, :3]).norm(dim=-1)).max())
    motion = length_text(float(shift)) + (f" and {turn:.3g} deg" if turn > SMALLEST_TURN else "")
    return Cause(kind, f"the {what} has moved by about {motion} against the model", advice, 2.0)
