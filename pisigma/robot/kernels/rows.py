"""What all kernels are made with: numba's decorators, and copying and filling of plain rows of numbers."""

import inspect
from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])

Array = Any
"""Numbers: an array, or a field of a record that is one."""
Record = Any
"""One of the structs of `kernels.layout`, or a part of one."""


# Functions are unwrapped, because type checkers at run time wrap them in what numba cannot compile.


def kernel(function: Function) -> Function:
    """Have numba compile a function of numbers and arrays; dividing by 0 gives infinity or NaN, as with NumPy."""
    return njit(error_model="numpy")(inspect.unwrap(function))  # type: ignore[return-value]


def contracted_kernel(function: Function) -> Function:
    """The same, and a product and a sum may be rounded once instead of twice."""
    return njit(error_model="numpy", fastmath={"contract"})(inspect.unwrap(function))  # type: ignore[return-value]


# Loops, because numba brings half its text handling along for the complaints of a slice assignment.


@kernel
def copy(source: Array, target: Array) -> None:
    """Write all numbers of one row into another."""
    for i in range(target.shape[0]):
        target[i] = source[i]


@kernel
def copy_rows(source: Array, target: Array) -> None:
    """Write all rows of one matrix into another."""
    for i in range(target.shape[0]):
        copy(source[i], target[i])


@kernel
def fill(target: Array, value: float) -> None:
    """Write one number all over a row."""
    for i in range(target.shape[0]):
        target[i] = value
