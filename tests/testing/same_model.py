"""Bitwise differences of two values of any classes, such as a model and its stored folder."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch


def differences(one: object, other: object, place: str = "") -> list[str]:
    """Return the names of the parts that differ, with reasons.

    Values of classes are compared by their attributes; functions and private attributes of modules are left out.
    """
    if isinstance(one, torch.Tensor):
        one, other = one.detach().numpy(), other.detach().numpy() if isinstance(other, torch.Tensor) else None
    if isinstance(one, np.ndarray):
        same = isinstance(other, np.ndarray) and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
        return [] if same else [f"{place}: arrays"]
    if isinstance(one, float) and isinstance(other, float) and math.isnan(one) and math.isnan(other):
        return []
    parts, others = _parts(one), _parts(other)
    if parts is None or others is None:
        return [] if callable(one) or one == other else [f"{place}: {one!r} and {other!r}"]
    if list(parts) != list(others):
        return [f"{place}: has {', '.join(parts)}, but {', '.join(others)}"]
    return [line for key, part in parts.items() for line in differences(part, others[key], f"{place}.{key}")]


def _parts(value: object) -> dict[str, object] | None:
    """Return the parts of a value by name; None for a value without parts."""
    if isinstance(value, torch.nn.Module):
        return {**value.state_dict(), **{key: own for key, own in vars(value).items() if key[0] != "_"}}
    if isinstance(value, Mapping):
        return {str(key): own for key, own in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return {str(number): own for number, own in enumerate(value)}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return dict(vars(value)) if hasattr(value, "__dict__") and not callable(value) else None
