"""Copying and filling of plain rows of numbers.

Loops, because numba brings half its text handling along for the complaints of a slice assignment.
"""

from typing import Any, no_type_check

from numba import njit

Array = Any
"""Numbers: an array, or a field of a record that is one."""
Record = Any
"""One of the structs of `kernels.layout`, or a part of one."""


@njit(error_model="numpy")
@no_type_check
def copy(source: Array, target: Array) -> None:
    """Write all numbers of one row into another."""
    for i in range(target.shape[0]):
        target[i] = source[i]


@njit(error_model="numpy")
@no_type_check
def copy_rows(source: Array, target: Array) -> None:
    """Write all rows of one matrix into another."""
    for i in range(target.shape[0]):
        copy(source[i], target[i])


@njit(error_model="numpy")
@no_type_check
def fill(target: Array, value: float) -> None:
    """Write one number all over a row."""
    for i in range(target.shape[0]):
        target[i] = value
