"""At which values of the joints a robot was measured."""

from jaxtyping import Float64
from torch import Tensor

from pisigma.planning.session.state import JointSpan
from pisigma.robot.description import Robot


def coverage(
    robot: Robot, measured: Float64[Tensor, "rows dof"], planned: Float64[Tensor, "poses dof"]
) -> tuple[JointSpan, ...]:
    """Compare the range in which every joint was measured with that of the plan; nothing of no rows.

    Args:
        robot: as drawn.
        measured: joint values of the rows that count [rad or m].
        planned: joint values of all poses that were planned [rad or m].
    """
    if not len(measured):
        return ()
    lower, upper = robot.to_controller(measured).aminmax(dim=0)
    every = robot.to_controller(planned)
    width = every.amax(0) - every.amin(0)
    return tuple(
        JointSpan(joint.name, low, high, min(1.0, (high - low) / max(most, 1e-9)))
        for joint, low, high, most in zip(
            robot.axes, lower.tolist(), upper.tolist(), width.tolist(), strict=True
        )
    )
