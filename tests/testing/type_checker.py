"""The type checker of the tests: the checks of `jaxtyping.jaxtyped` with beartype, at half of its cost."""

import inspect
from collections.abc import Callable
from dataclasses import is_dataclass
from functools import partial, wraps
from types import FunctionType
from typing import Any, get_type_hints

import jaxtyping
from beartype import beartype

SHAPES = jaxtyping.jaxtyped("context")
"""Within it, an axis has one size wherever its name stands."""


def type_checked(checked: Any = None, *, typechecker: Any = None) -> Any:
    """Check the arguments and the result of a function, or what a dataclass is made of, against the annotations.

    It stands in for `jaxtyping.jaxtyped`, which the import hook applies to all of pisigma. That one checks arguments
    twice a call and prepares its checks at import; this one checks them once, and prepares at the first call.
    """
    if checked is None:
        return partial(type_checked, typechecker=typechecker)
    if inspect.isclass(checked):
        if is_dataclass(checked) and not hasattr(checked.__init__, "__wrapped__"):
            checked.__init__ = type_checked(checked.__init__)
        return checked
    verified: Callable[..., Any] | None = None

    @wraps(checked)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal verified
        if jaxtyping.config.jaxtyping_disable:
            return checked(*args, **kwargs)
        if verified is None:
            verified = beartype(_with_resolved_annotations(checked))
        with SHAPES:
            return verified(*args, **kwargs)

    return call


def _with_resolved_annotations(function: FunctionType) -> FunctionType:
    """Copy a function with types for annotations; a name that is imported for mypy alone is any type."""
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


jaxtyping.jaxtyped = type_checked
