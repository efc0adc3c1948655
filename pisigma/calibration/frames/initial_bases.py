"""Start values of the bases of several arms, from the poses of what they share."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.frames.shared_joints import frame_after_rows
from pisigma.calibration.frames.shared_objects import JOINT, TOUCH, ArmPosterior, SharedObject
from pisigma.calibration.frames.touch_equations import TipPositions
from pisigma.files.errors import IdentificationError, Phrase
from pisigma.robot.frame_fits import MeasuredPoses, best_base
from pisigma.robot.se3 import invert, transform, transform_from_xyz_zyx

_MIN_POINTS = 3
COLLINEAR = 1e-3
"""Ratio of the second to the first singular value of points below which they lie on a line and determine no
rotation."""


def shared_object_in_base(
    arm: ArmPosterior, key: tuple[str, str], values_at: Callable[[Sequence[int]], Tensor]
) -> tuple[Tensor, Tensor]:
    """Return the pose of a shared object in the base of an arm, and the other unknowns of its sensor."""
    frame, rows = arm.shared_objects[key]
    if key[0] == JOINT:
        return frame_after_rows(values_at(rows)), values_at(())
    T_base_frame = invert(transform_from_xyz_zyx(values_at(arm.base_indices(frame))))
    if key[0] == "frame":
        return T_base_frame, values_at(())
    point = transform(torch.eye(3, dtype=torch.float64), values_at(rows[:3]))
    return T_base_frame @ point, values_at(rows[3:])


def fitted_pose(
    arms: Sequence[ArmPosterior],
    arm_index: int,
    shared_object: SharedObject,
    tips: Sequence[TipPositions | None],
) -> Float64[Tensor, "4 4"]:
    """Return the pose of a shared object in the base of an arm, according to the fit of this arm."""
    arm, touched = arms[arm_index], tips[arm_index]
    if shared_object.kind == TOUCH:
        assert arm.touches is not None
        assert touched is not None
        return transform(
            torch.eye(3).to(arm.covariance_root),
            touched.position[arm.touches.names.index(shared_object.name)],
        )
    return shared_object_in_base(arm, shared_object.key, lambda rows: arm.values[list(rows)])[0]


def initial_bases(
    arms: Sequence[ArmPosterior], shared: Sequence[SharedObject], tips: Sequence[TipPositions | None]
) -> list[Float64[Tensor, "4 4"]]:
    """Return a base for every arm, from a frame shared with an earlier arm, or else from shared points."""
    placed = {0: torch.eye(4, dtype=torch.float64)}
    while len(placed) < len(arms):
        for number in range(len(arms)):
            if number in placed:
                continue
            found = _place(arms, shared, tips, placed, number)
            if found is not None:
                placed[number] = found
                break
        else:
            lost = [arm.name for number, arm in enumerate(arms) if number not in placed]
            raise IdentificationError(
                expected=f"a frame, or {_MIN_POINTS} sockets, anchors or touches that are not on one line, that arm "
                f"'{lost[0]}' shares with the other arms",
                value=Phrase(", ".join(f"{one.kind} '{one.name}'" for one in shared) or "none"),
                remedy="name the same board, jig or instrument in the column 'frame' of the rows of both arms, or the "
                "same sockets in the column 'socket', or let the arms touch each other (touches)",
            )
    return [placed[number] for number in range(len(arms))]


def _place(
    arms: Sequence[ArmPosterior],
    shared: Sequence[SharedObject],
    tips: Sequence[TipPositions | None],
    placed: dict[int, Tensor],
    number: int,
) -> Float64[Tensor, "4 4"] | None:
    """Return the base of an arm from what it shares with arms of known bases; None if this does not determine it."""
    wanted, own = [], []
    for one in shared:
        known = [other for other in one.arms if other in placed]
        if number not in one.arms or not known:
            continue
        there = placed[known[0]] @ fitted_pose(arms, known[0], one, tips)
        mine = fitted_pose(arms, number, one, tips)
        if one.kind == JOINT:
            return placed[known[0]]
        if one.kind == "frame":
            return there @ invert(mine)
        wanted.append(there[:3, 3])
        own.append(mine)
    if len(own) < _MIN_POINTS:
        return None
    points = torch.stack(wanted)
    spread = torch.linalg.svdvals(points - points.mean(0))
    if spread[1] <= COLLINEAR * spread[0]:
        return None
    return best_base(torch.stack(own), MeasuredPoses.from_tensors(points, None, 0.0))
