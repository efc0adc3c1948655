"""Compiled forms that are handed to the kernels as plain functions: of features, and of closed forms of the inverse."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import FunctionType
from typing import Any

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


MOST_KINDS, MOST_VALUES = 16, 4_096
"""The largest numbers of kinds of features, and of the values of all features of a correction."""

FORMS: dict[str, CompiledForm] = {}
"""Those of features by name, in the order in which they were registered."""


def register_compiled(name: str, form: CompiledForm) -> None:
    """Have the kernels evaluate a feature, from when they are next compiled."""
    FORMS[name] = form


def compiled_closed_forms() -> dict[str, Callable[..., None]]:
    """The plain functions of registered closed forms by name, see `AbstractClosedForm.compiled`; imports torch."""
    from pisigma.robot.kinematics.closed_form.registry import CLOSED_FORMS

    return {name: form.compiled for name, form in CLOSED_FORMS.items() if form.compiled is not None}


@dataclass(frozen=True)
class KernelForms:
    """Names of what kernels evaluate, or of what an arm needs of them, in the order of their indices.

    Attributes:
        features: of the joint correction.
        closed_forms: of the inverse of the nominal arm.
    """

    features: tuple[str, ...] = ()
    closed_forms: tuple[str, ...] = ()

    @staticmethod
    def registered() -> "KernelForms":
        """What kernels evaluate that are compiled now."""
        return KernelForms(tuple(FORMS), tuple(compiled_closed_forms()))

    def cover(self, wanted: "KernelForms") -> bool:
        """Whether all that is wanted is among them."""
        return {*wanted.features} <= {*self.features} and {*wanted.closed_forms} <= {*self.closed_forms}

    def fingerprints(self, ready: "KernelForms") -> list[str]:
        """Their names; of those that are not ready texts that are other ones where the plain functions change."""
        names, known = (*self.features, *self.closed_forms), {*ready.features, *ready.closed_forms}
        return [name if name in known else _fingerprint(*_functions(name)) for name in names]


def _functions(name: str) -> tuple[Callable[..., Any] | None, ...]:
    """The plain functions of a feature or of a closed form."""
    return (FORMS[name].add, FORMS[name].add_slope) if name in FORMS else (compiled_closed_forms()[name],)


def compiled_plain(function: Callable[..., Any], kernel: Callable[[Any], Any]) -> Any:
    """What a decorator of `kernels.rows` compiles of a plain function and of the plain functions that it calls."""
    assert isinstance(function, FunctionType)
    calls = {name: compiled_plain(called, kernel) for name, called in _called(function)}
    return kernel(FunctionType(function.__code__, {**function.__globals__, **calls}, function.__name__))


def _called(function: Callable[..., Any]) -> Iterator[tuple[str, FunctionType]]:
    """The plain functions that a plain function calls, and under which names."""
    assert isinstance(function, FunctionType)
    for name in function.__code__.co_names:
        if isinstance(called := function.__globals__.get(name), FunctionType):
            yield name, called


def _fingerprint(*functions: Callable[..., Any] | None) -> str:
    """What plain functions and those that they call do."""
    words = []
    for function in functions:
        if isinstance(function, FunctionType):
            code = function.__code__
            words.append(repr((code.co_code, code.co_consts, code.co_names)))
            words += [_fingerprint(called) for _, called in _called(function)]
    return "".join(words)
