"""How the tool moves with the parameters in the rows of a problem, and the memory of the last such motion."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.robot.kinematics.parameter_jacobian import ToolMotion, tool_motion


class MotionMemory:
    """The motion at the last point, which the rank analysis, the search and its next stage all ask for.

    What the motion was made from is compared by identity; so points are replaced and never changed in place.
    """

    def __init__(self) -> None:
        self._made_from: tuple[object, ...] = ()
        self._motions: dict[tuple[int, int], ToolMotion] = {}
        self._derivatives: Tensor | None = None

    def motion(
        self,
        made_from: tuple[object, ...],
        rows: slice,
        shape: tuple[int, int],
        q: Float64[Tensor, "all_rows dof"],
        make: Callable[[Tensor], ToolMotion],
    ) -> ToolMotion:
        """Return the motion of some rows that was made from the same objects, or else a new one.

        The derivatives of all rows stand in one tensor: memory that is asked for and given back in pieces of some MB
        is taken from the system anew each time, which took a tenth of the time of fits side by side.

        Args:
            made_from: the objects.
            rows: which rows.
            shape: numbers of parameters and components of the derivative.
            q: joint values of all rows.
            make: works the motion of the rows out, with the derivative in the tensor that it is given.
        """
        same = len(made_from) == len(self._made_from) and all(
            one is other for one, other in zip(made_from, self._made_from, strict=True)
        )
        values = math.prod(shape)
        if not same or self._derivatives is None:
            self._made_from, self._motions, self._derivatives = made_from, {}, None  # given back first
            self._derivatives = q.new_empty(values * q.shape[0])
        number = rows.start, rows.stop
        if number not in self._motions:
            place = self._derivatives[values * rows.start : values * rows.stop]
            self._motions[number] = make(place.view(*shape, rows.stop - rows.start))
        return self._motions[number]


def motion_at(
    space: ParameterSpace,
    point: Float64[Tensor, "*robots parameters"],
    q: Float64[Tensor, "rows dof"],
    frame: Int64[Tensor, " rows"],
    target: Int64[Tensor, " rows"],
    turning: bool,
    out: Float64[Tensor, "motions components rows"] | None = None,
) -> ToolMotion:
    """Work out tool poses and their derivative by every kind of parameter.

    Args:
        space: the parameters.
        point: their values, of one robot or of several.
        q: joint values [rad or m]; of several robots one behind the other.
        frame: number of every row's frame among those of its robot.
        target: number of every row's target among those of its robot.
        turning: whether the derivative of the rotation is wanted too.
        out: where the derivative is written; a new tensor where None.
    """
    dh, bases, tools = space.split(point)
    robots, rows = point.shape[:-1].numel(), q.shape[0]
    robot = torch.arange(robots, device=q.device).repeat_interleave(rows // robots) if robots > 1 else 0
    frame_of_all, target_of_all = (
        None if owners.shape[-2] == 1 else number + owners.shape[-2] * robot
        for number, owners in ((frame, bases), (target, tools))
    )
    base, tool = bases.reshape(-1, 6).t(), tools.reshape(-1, 6).t()
    owners_of_rows = frame_of_all, target_of_all
    return tool_motion(space.robot, dh.cpu().numpy(), base, tool, q, turning, *owners_of_rows, out)
