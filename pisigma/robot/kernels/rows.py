"""Decorators that compile kernels by numba, and functions that copy and fill rows of numbers."""

import inspect
from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])

Array = Any
"""An array of numbers, or an array field of a record."""
Record = Any
"""One of the structs of `kernels.layout`, or a part of one."""


# Functions are unwrapped, because type checkers at run time wrap them in what numba cannot compile.


def kernel(function: Function) -> Function:
    """Compile a function of numbers and arrays by numba; division by 0 returns infinity or NaN, as in NumPy."""
    return njit(error_model="numpy")(inspect.unwrap(function))  # type: ignore[return-value]


def contracted_kernel(function: Function) -> Function:
    """Compile a function like `kernel`, but allow fused multiply-add operations."""
    return njit(error_model="numpy", fastmath={"contract"})(inspect.unwrap(function))  # type: ignore[return-value]


# Loops, because error messages of slice assignments would add much of numba's code for strings.


@kernel
def copy(source: Array, target: Array) -> None:
    """Copy all numbers of a row into another."""
    for i in range(target.shape[0]):
        target[i] = source[i]


@kernel
def copy_rows(source: Array, target: Array) -> None:
    """Copy all rows of a matrix into another."""
    for i in range(target.shape[0]):
        copy(source[i], target[i])


@kernel
def fill(target: Array, value: float) -> None:
    """Fill a row with one number."""
    for i in range(target.shape[0]):
        target[i] = value
