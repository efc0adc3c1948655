"""How large the squares of a board have to be for an arm and the lens of a fixed camera."""

from pisigma.robot.description import Robot

_SQUARE_PX = 25.0
"""Width of a square [px] at which the cells of a marker of 4 x 4 bits are 3 px wide, on boards with margins of 14 %."""


def smallest_square(robot: Robot, height_px: int) -> float:
    """Return the smallest side of a square that a fixed camera sees well all over the workspace of an arm [m].

    A lens that covers a sphere around the base with the reach as its radius shows `height / (2 reach)` pixels per
    metre at its middle, whatever its focal length and distance.

    Args:
        robot: the arm.
        height_px: the smaller side of the image [px].
    """
    return _SQUARE_PX * 2 * robot.reach / height_px
