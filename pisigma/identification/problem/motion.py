"""How the tool moves with the parameters in the rows of a problem, and the memory of the last such motion."""

import operator
from collections.abc import Callable

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.identification.problem.parameters import ParameterSpace
from pisigma.kinematics.parameter_jacobian import ToolMotion, tool_motion


class MotionMemory:
    """The last motion in every chunk of rows, which the rank analysis, the search and its next stage ask for.

    What a motion was made from besides the point is compared by identity.
    """

    def __init__(self) -> None:
        self._motions: dict[int, tuple[Tensor, tuple[object, ...], ToolMotion]] = {}

    def motion(
        self, chunk: int, point: Tensor, made_from: tuple[object, ...], make: Callable[[], ToolMotion]
    ) -> ToolMotion:
        """Return the motion of the chunk that was made from the same, or else a new one."""
        before = self._motions.get(chunk)
        if (
            before is not None
            and all(map(operator.is_, made_from, before[1]))
            and torch.equal(point, before[0])
        ):
            return before[2]
        motion = make()
        self._motions[chunk] = point, made_from, motion
        return motion


def motion_at(
    space: ParameterSpace,
    point: Float64[Tensor, "*robots parameters"],
    q: Float64[Tensor, "rows dof"],
    frame: Int64[Tensor, " rows"],
    target: Int64[Tensor, " rows"],
    turning: bool,
) -> ToolMotion:
    """Work out tool poses and their derivative by every kind of parameter.

    Args:
        space: the parameters.
        point: their values, of one robot or of several.
        q: joint values [rad or m]; of several robots one behind the other.
        frame: number of every row's frame among those of its robot.
        target: number of every row's target among those of its robot.
        turning: whether the derivative of the rotation is wanted too.
    """
    dh, bases, tools = space.split(point)
    robots, rows = point.shape[:-1].numel(), len(q)
    robot = torch.arange(robots, device=q.device).repeat_interleave(rows // robots) if robots > 1 else 0
    frame_of_all, target_of_all = (
        None if owners.shape[-2] == 1 else number + owners.shape[-2] * robot
        for number, owners in ((frame, bases), (target, tools))
    )
    base, tool = bases.reshape(-1, 6).t(), tools.reshape(-1, 6).t()
    return tool_motion(space.robot, dh.cpu().numpy(), base, tool, q, turning, frame_of_all, target_of_all)
