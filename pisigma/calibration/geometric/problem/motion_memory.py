"""Cache of the tool motion at the last point."""

from collections.abc import Callable

from pisigma.robot.kinematics.parameter_jacobian import ToolMotion


class MotionMemory:
    """Cache of the tool motion at the last point, which rank analysis and search both need.

    The inputs of the motion are compared by identity; therefore points must be replaced, not changed in place.
    """

    def __init__(self) -> None:
        self._made_from: tuple[object, ...] = ()
        self._motion: ToolMotion | None = None

    def motion(self, made_from: tuple[object, ...], make: Callable[[], ToolMotion]) -> ToolMotion:
        """Return the cached motion if it was computed from the same objects, otherwise a new motion.

        Args:
            made_from: the objects from which the motion is computed.
            make: function that computes the motion.
        """
        same = len(made_from) == len(self._made_from) and all(
            one is other for one, other in zip(made_from, self._made_from, strict=True)
        )
        if not same or self._motion is None:
            self._made_from, self._motion = made_from, None  # release memory before more is allocated
            self._motion = make()
        return self._motion
