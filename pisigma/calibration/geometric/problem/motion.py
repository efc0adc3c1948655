"""How the tool moves with the parameters in the rows of a problem, and the memory of the last such motion."""

from collections.abc import Callable

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
        self._motion: ToolMotion | None = None

    def motion(self, made_from: tuple[object, ...], make: Callable[[], ToolMotion]) -> ToolMotion:
        """Return the motion of all rows that was made from the same objects, or else a new one.

        Args:
            made_from: the objects.
            make: works the motion out.
        """
        same = len(made_from) == len(self._made_from) and all(
            one is other for one, other in zip(made_from, self._made_from, strict=True)
        )
        if not same or self._motion is None:
            self._made_from, self._motion = made_from, None  # given back before more memory is asked for
            self._motion = make()
        return self._motion


def motion_at(
    space: ParameterSpace,
    point: Float64[Tensor, " parameters"],
    q: Float64[Tensor, "rows dof"],
    frame: Int64[Tensor, " rows"],
    target: Int64[Tensor, " rows"],
    turning: bool,
) -> ToolMotion:
    """Work out tool poses and their derivative by every kind of parameter.

    Args:
        space: the parameters.
        point: their values.
        q: joint values [rad or m].
        frame: number of every row's frame.
        target: number of every row's target.
        turning: whether the derivative of the rotation is wanted too.
    """
    dh, bases, tools = space.split(point)
    owners = (None if len(bases) == 1 else frame), (None if len(tools) == 1 else target)
    return tool_motion(space.robot, dh.cpu().numpy(), bases.t(), tools.t(), q, turning, *owners)
