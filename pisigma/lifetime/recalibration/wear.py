"""Check of movements against what wear or a collision can change."""

import math
from collections.abc import Sequence

from pisigma.lifetime.monitoring.session import is_frame
from pisigma.lifetime.recalibration.movement import Movement
from pisigma.robot.description import Robot
from pisigma.robot.robot_class import ChangeLimits, RobotClass
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.cause import joined


def beyond_wear(robot: Robot, moved: Sequence[Movement]) -> tuple[Diagnostic, ...]:
    """Return a diagnostic of changes larger than wear or a collision causes.

    Bases, tools and the zero of a single joint may move by any amount.

    Args:
        robot: robot, whose class has the limits; see `RobotClass.change`.
        moved: movements that were found.
    """
    of_class = RobotClass.from_robot(robot)
    far = [one for one in moved if not is_frame(one.what) and _is_beyond(one, of_class.change)]
    if not far or (len(far) == 1 and far[0].what.startswith("joint ")):
        return ()
    changes = joined(f"{one.what} by {one.size}" for one in far)
    return (
        Diagnostic(
            kind="beyond_wear",
            severity="implausible",
            sentence=f"The rows imply changes that neither wear nor a collision causes in a robot of class "
            f"'{of_class.name}': {changes}. Check units and scale, the order and signs of the columns, and whether "
            "this robot was measured.",
        ),
    )


def _is_beyond(one: Movement, limits: ChangeLimits) -> bool:
    if one.unit == "mm":
        return abs(one.shift) > limits.length * 1e3
    return abs(one.shift) > math.degrees(limits.joint_zero if one.what.startswith("joint ") else limits.angle)
