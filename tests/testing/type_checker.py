"""The type checker of the tests: the checks of `jaxtyping.jaxtyped` with beartype, at a fraction of its cost."""

import inspect
from collections.abc import Callable
from dataclasses import is_dataclass
from functools import partial, wraps
from types import FunctionType
from typing import Any, get_type_hints

import jaxtyping
import numpy as np
import torch
from beartype import beartype
from jaxtyping import _array_types as array_types
from jaxtyping import _storage as storage

INNERMOST = "pisigma.robot.kinematics.components"
"""Module whose functions have no arrays and call no others that have some; a calibration calls them a million times."""


def type_checked(checked: Any = None, *, typechecker: Any = None) -> Any:
    """Check the arguments and the result of a function, or the fields of a dataclass, against the annotations.

    It replaces `jaxtyping.jaxtyped`, which the import hook applies to all of pisigma. That one checks arguments
    twice a call and prepares its checks at import; this one checks them once, and prepares at the first call.
    """
    if checked is None:
        return partial(type_checked, typechecker=typechecker)
    if inspect.isclass(checked):
        if is_dataclass(checked) and not hasattr(checked.__init__, "__wrapped__"):
            checked.__init__ = type_checked(checked.__init__)
        return checked
    verified: Callable[..., Any] | None = None
    innermost = checked.__module__ == INNERMOST

    @wraps(checked)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal verified
        if jaxtyping.config.jaxtyping_disable:
            return checked(*args, **kwargs)
        if verified is None:
            verified = beartype(_with_resolved_annotations(checked))
        if innermost:
            return verified(*args, **kwargs)
        # Within one entry an axis has one size wherever its name stands. Functions without arrays have one too, in
        # which the generators that they call check theirs. `jaxtyped("context")` does the same in 0.5 µs.
        try:
            stack = storage._shape_storage.memo_stack
        except AttributeError:
            stack = storage._shape_storage.memo_stack = []
        stack.append(({}, {}, {}, {}))
        try:
            return verified(*args, **kwargs)
        finally:
            stack.pop()

    return call


def _with_resolved_annotations(function: FunctionType) -> FunctionType:
    """Copy a function with resolved annotations; a name that is only imported for mypy becomes Any."""
    copy = FunctionType(
        function.__code__,
        function.__globals__,
        function.__name__,
        function.__defaults__,
        function.__closure__,
    )
    copy.__kwdefaults__, copy.__module__ = function.__kwdefaults__, function.__module__
    copy.__qualname__ = function.__qualname__
    copy.__annotations__ = {
        name: _resolved(annotation, function.__globals__)
        for name, annotation in function.__annotations__.items()
    }
    return copy


def _resolved(annotation: Any, names: dict[str, Any]) -> Any:
    holder = type("Holder", (), {"__annotations__": {"value": annotation}})
    try:
        return get_type_hints(holder, names, include_extras=True)["value"]
    except NameError:
        return Any


ARRAY = array_types._MetaAbstractArray
WHOLE_CHECK = ARRAY.__instancecheck__
"""jaxtyping's check of an array, which takes 15 µs."""
Axes = tuple[tuple[tuple[str, int], ...], tuple[tuple[str, Any], ...]]
AXES: dict[Any, Axes | None] = {}
"""Sizes of an array's axes by annotation, dtype and shape; None where these do not decide."""
ARRAYS = frozenset((torch.Tensor, np.ndarray))


def _axes(annotation: Any, value: Any) -> Axes | None:
    usual = (array_types._NamedDim, array_types._NamedVariadicDim, array_types._FixedDim)
    for axis in annotation.dims:
        if isinstance(axis, usual) and (axis.broadcastable or getattr(axis, "treepath", False)):
            return None
        if isinstance(axis, array_types._SymbolicDim):
            return None
    sizes, batches, *_ = storage.push_shape_memo({})
    try:
        if not WHOLE_CHECK(annotation, value):
            return None
        return tuple(sizes.items()), tuple(batches.items())
    finally:
        storage.pop_shape_memo()


def is_of(annotation: Any, value: Any) -> bool:
    """Like `isinstance` for an array, but cached by shape, and several times as fast."""
    stack = getattr(storage._shape_storage, "memo_stack", None)
    if stack and type(value) in ARRAYS:
        key = (annotation, value.dtype, value.shape)
        try:
            axes = AXES[key]
        except KeyError:
            axes = AXES[key] = _axes(annotation, value)
        if axes is not None and _agree(axes, stack[-1]):
            return True
    return bool(WHOLE_CHECK(annotation, value))


def _agree(axes: Axes, known: tuple[dict[str, int], dict[str, Any], Any, Any]) -> bool:
    """Tell whether axes have the sizes that their names had before in this entry; if so, note them."""
    sizes, batches = known[0], known[1]
    for name, size in axes[0]:
        if sizes.get(name, size) != size:
            return False
    for name, batch in axes[1]:
        if batches.get(name, batch) != batch:
            return False
    sizes.update(axes[0])
    batches.update(axes[1])
    return True


ARRAY.__instancecheck__ = is_of
jaxtyping.jaxtyped = type_checked
