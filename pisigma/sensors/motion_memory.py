"""The last tool motion, for points that are looked at several times."""

from collections.abc import Callable

from pisigma.kinematics.parameter_jacobian import ToolMotion


class MotionMemory:
    """The motion at the last point, which the rank analysis, the search and its next stage all ask for.

    What the motion was made from is compared by identity; so points are replaced and never changed in place.
    """

    def __init__(self) -> None:
        self._made_from: tuple[object, ...] = ()
        self._motion: ToolMotion | None = None

    def motion(self, made_from: tuple[object, ...], make: Callable[[], ToolMotion]) -> ToolMotion:
        """The motion that was made from the same objects, or else a new one."""
        same = len(made_from) == len(self._made_from) and all(
            one is other for one, other in zip(made_from, self._made_from, strict=True)
        )
        if not same or self._motion is None:
            self._made_from, self._motion = made_from, make()
        return self._motion
