"""Registry of compiled forms: plain functions of features and closed-form inverses that kernels evaluate."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import FunctionType
from typing import Any

MAX_JOINTS = 8
"""The largest number of joints, and the row length of weights that are vectorised over joints."""


@dataclass(frozen=True)
class CompiledForm:
    """The functions of a feature that numba compiles: plain functions without a decorator.

    Both functions are called as `function(arms, correction, first, memory, q)` with `kernels.arrays.Arms` and
    `Correction`, the index in `correction.values` of the first number that the feature's `pack` returned,
    `kernels.layout.MEMORY`, and the joint values [rad or m]. They may read `memory.turning` (sines and cosines of
    the joints' angles, see `angle_per_joint_value`), `memory.phi` (inputs of product units) and `memory.approach`
    (+1, -1, or 0 where not stated).

    Attributes:
        add: adds corrections of all joints to `memory.delta` [rad or m].
        add_slope: adds the derivatives of every joint's correction with respect to its own value to `memory.slope`;
            None if they are small.
        frames: whether `add` reads `memory.frames`: axis and origin of every joint, and axes and origin of its row's
            frame, in the frame of the first row of the nominal arm.
    """

    add: Callable[..., None]
    add_slope: Callable[..., None] | None = None
    frames: bool = False


MAX_KINDS, MAX_VALUES = 16, 4_096
"""The largest numbers of kinds of features, and of the values of all features of a correction."""

FORMS: dict[str, CompiledForm] = {}
"""Compiled forms of features by name, in the order of registration."""


def register_compiled(name: str, form: CompiledForm) -> None:
    """Register the compiled form of a feature, which the kernels evaluate when they are next compiled."""
    FORMS[name] = form


def compiled_closed_forms() -> dict[str, Callable[..., None]]:
    """Return the `AbstractClosedForm.compiled` functions of registered closed forms by name; imports torch."""
    from pisigma.robot.kinematics.closed_form.registry import CLOSED_FORMS

    return {name: form.compiled for name, form in CLOSED_FORMS.items() if form.compiled is not None}


@dataclass(frozen=True)
class KernelForms:
    """Names of the forms that kernels evaluate or that an arm needs, in the order of their indices.

    Attributes:
        features: features of the joint correction.
        closed_forms: closed-form inverses of the nominal arm.
    """

    features: tuple[str, ...] = ()
    closed_forms: tuple[str, ...] = ()

    @staticmethod
    def registered() -> "KernelForms":
        """Return all registered forms, which kernels that are compiled now evaluate."""
        return KernelForms(tuple(FORMS), tuple(compiled_closed_forms()))

    def cover(self, wanted: "KernelForms") -> bool:
        """Return whether all wanted forms are among these."""
        return {*wanted.features} <= {*self.features} and {*wanted.closed_forms} <= {*self.closed_forms}

    def fingerprints(self, ready: "KernelForms") -> list[str]:
        """Return names of the forms in `ready`, and for other forms texts that change with their functions."""
        names, known = (*self.features, *self.closed_forms), {*ready.features, *ready.closed_forms}
        return [name if name in known else _fingerprint(*_functions(name)) for name in names]


def _functions(name: str) -> tuple[Callable[..., Any] | None, ...]:
    """Return the plain functions of a feature or a closed form with the given name."""
    return (FORMS[name].add, FORMS[name].add_slope) if name in FORMS else (compiled_closed_forms()[name],)


def compiled_plain(function: Callable[..., Any], kernel: Callable[[Any], Any]) -> Any:
    """Compile a plain function and those that it calls with a decorator of `kernels.rows`."""
    assert isinstance(function, FunctionType)
    calls = {name: compiled_plain(called, kernel) for name, called in _called(function)}
    return kernel(FunctionType(function.__code__, {**function.__globals__, **calls}, function.__name__))


def _called(function: Callable[..., Any]) -> Iterator[tuple[str, FunctionType]]:
    """Yield the plain functions that a plain function calls, with their names."""
    assert isinstance(function, FunctionType)
    for name in function.__code__.co_names:
        if isinstance(called := function.__globals__.get(name), FunctionType):
            yield name, called


def _fingerprint(*functions: Callable[..., Any] | None) -> str:
    """Return a text that identifies the code of plain functions and of those that they call."""
    words = []
    for function in functions:
        if isinstance(function, FunctionType):
            code = function.__code__
            words.append(repr((code.co_code, code.co_consts, code.co_names)))
            words += [_fingerprint(called) for _, called in _called(function)]
    return "".join(words)
