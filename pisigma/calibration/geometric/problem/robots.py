"""Values of several robots side by side: some of them, and theirs put in the place of others."""

from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Int64
from torch import Tensor

Values = TypeVar("Values")


def of_robots(values: Values, robots: Int64[Tensor, " chosen"] | int) -> Values:
    """Return the values of some robots, or of one without the axis of robots.

    Args:
        values: a tensor whose first axis is the robots, or a tuple or dataclass of such; all else is common to them.
        robots: their numbers.
    """
    chosen: Values = _mapped(lambda value: value[robots], values)
    return chosen


def each_robot(values: Values, robots: int) -> list[Values]:
    """Return the values of every robot without the axis of robots; see `of_robots`."""
    result: list[Values] = _each(values, robots)
    return result


def _each(values: Any, robots: int) -> list[Any]:
    if isinstance(values, Tensor):
        return list(values.unbind(0))
    if isinstance(values, tuple):
        return list(zip(*(_each(item, robots) for item in values), strict=True))
    if is_dataclass(values) and not isinstance(values, type):
        names = [item.name for item in fields(values)]
        items = zip(*(_each(getattr(values, name), robots) for name in names), strict=True)
        return [replace(values, **dict(zip(names, item, strict=True))) for item in items]
    return [values] * robots


def with_robots(values: Values, robots: Int64[Tensor, " chosen"], others: Values) -> Values:
    """Return the values with those of some robots replaced by others, one behind the other."""
    changed: Values = _mapped(
        lambda value, other: value.index_copy(0, robots.to(value.device), other), values, others
    )
    return changed


def in_order(values: Sequence[Values], robots: Sequence[Int64[Tensor, " some"]]) -> Values:
    """Return the values of all robots in the order of their numbers, of those of some robots each."""
    if len(values) == 1:
        return values[0]
    joined: Values = _mapped(lambda *several: torch.cat(several), *values)
    return of_robots(joined, torch.cat(list(robots)).argsort())


def _mapped(function: Callable[..., Tensor], *values: Any) -> Any:
    first = values[0]
    if isinstance(first, Tensor):
        return function(*values)
    if isinstance(first, tuple):
        return tuple(_mapped(function, *items) for items in zip(*values, strict=True))
    if is_dataclass(first) and not isinstance(first, type):
        names = [item.name for item in fields(first)]
        changed = {name: _mapped(function, *(getattr(value, name) for value in values)) for name in names}
        return replace(first, **changed)
    return first
