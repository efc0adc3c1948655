"""Compiled forms of the features of a joint correction, which the registry of features hands in."""

from collections.abc import Callable
from dataclasses import dataclass

MOST_JOINTS = 8
"""The largest number of joints; weights that are worked on side by side stand in rows of so many."""


@dataclass(frozen=True)
class CompiledForm:
    """What numba compiles of a feature: plain functions, without decorator.

    Both are called as `function(arms, correction, first, memory, q)` with `kernels.arrays.Arms` and `Correction`, the
    index in `correction.values` of the first number that the feature's `pack` gave, `kernels.layout.MEMORY`, and the
    joint values [rad or m]. They may read `memory.turning` (sines and cosines of the joints' angles, see
    `turning_rate`), `memory.phi` (inputs of product units) and `memory.approach` (+1, -1, or 0 where not stated).

    Attributes:
        add: adds corrections of all joints to `memory.delta` [rad or m].
        add_slope: adds the derivatives of every joint's correction by its own value to `memory.slope`; None where
            they are small.
        frames: whether `add` reads `memory.frames`: of every joint axis and origin, axes and origin of its row's
            frame, in the frame of the first row of the arm as drawn.
    """

    add: Callable[..., None]
    add_slope: Callable[..., None] | None = None
    frames: bool = False

    @property
    def fingerprint(self) -> str:
        """What the functions do, as a text that is another one where they change."""
        codes = [function.__code__ for function in (self.add, self.add_slope) if function is not None]
        return repr([(code.co_code, code.co_consts, code.co_names) for code in codes])


MOST_KINDS, MOST_VALUES = 16, 4_096
"""The largest numbers of kinds of features, and of the values of all features of a correction."""

FORMS: dict[str, CompiledForm] = {}
"""By the feature's name, in the order in which they were registered."""


def register_compiled(name: str, form: CompiledForm) -> None:
    """Have the kernels evaluate a feature, from when they are next compiled."""
    FORMS[name] = form
