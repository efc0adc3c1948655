"""Square root of a covariance of many unknowns in whole numbers, for which model folders need few bytes."""

import bz2
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float64, Int16
from torch import Tensor

STEPS = (1 / 256, 1 / 512, 1 / 1024)
"""Units to try, as shares of an unknown's standard deviation given all previous unknowns."""
_SMALLEST_UNIT = 2.0**-14
"""Smallest unit as a share of an unknown's standard deviation: multiples of it by whole numbers fit into 16 bits."""
_BLOCK = 64
"""Number of rows that are rounded with one matrix product."""


@dataclass(frozen=True, eq=False)
class RoundedRoot:
    """Root `R = diag(unit) N` with a lower triangular N of whole numbers.

    Attributes:
        unit: unit of every row of N, in the unit of the unknown.
        integers: N.
    """

    unit: Float64[Tensor, " unknowns"]
    integers: Int16[Tensor, "unknowns directions"]

    @cached_property
    def as_matrix(self) -> Float64[Tensor, "unknowns directions"]:
        """R as a matrix."""
        return self.integers.double() * self.unit[:, None]

    def select(self, rows: list[int]) -> "RoundedRoot":
        """Return the root of some unknowns, by their indices."""
        return RoundedRoot(self.unit[rows], self.integers[rows])

    def with_exact_unknowns(self, rows: list[int], count: int) -> "RoundedRoot":
        """Return the root of `count` unknowns: `rows` are the unknowns of this root, the others are exact."""
        unit, numbers = self.unit.new_zeros(count), self.integers.new_zeros(count, self.integers.shape[1])
        unit[rows], numbers[rows] = self.unit, self.integers
        return RoundedRoot(unit, numbers)

    def packed(self) -> bytes:
        """Compress the numbers on and below the diagonal, row by row."""
        numbers = self.integers.numpy()[np.tril_indices(len(self.integers))].astype(np.int32)
        # with the sign in the lowest bit most high bytes are 0, and compress better if they follow one another
        unsigned = numbers << 1 ^ numbers >> 31
        return bz2.compress(np.concatenate([unsigned & 255, unsigned >> 8]).astype(np.uint8).tobytes())

    @staticmethod
    def unpacked(content: bytes, unit: Float64[Tensor, " unknowns"]) -> "RoundedRoot":
        """Reverse `packed`; no more is decompressed than the root needs.

        Raises:
            ValueError: the content is not compressed with bz2, or has a wrong number of values.
        """
        result = RoundedRoot(unit, torch.zeros(len(unit), len(unit), dtype=torch.int16))
        cells = np.tril_indices(len(unit))
        try:
            planes = bz2.BZ2Decompressor().decompress(content, 2 * len(cells[0]) + 1)
        except OSError as problem:
            raise ValueError(f"expected numbers compressed by bz2: {problem}") from None
        if len(planes) != 2 * len(cells[0]):
            raise ValueError(f"expected {len(cells[0]):,} compressed numbers, got a different number")
        low, high = np.frombuffer(planes, np.uint8).astype(np.int32).reshape(2, -1)
        unsigned = low | high << 8
        result.integers.numpy()[cells] = unsigned >> 1 ^ -(unsigned & 1)
        return result


def round_root(
    covariance_root: Float64[Tensor, "unknowns directions"],
    combinations: Float64[Tensor, "probes unknowns"],
    tolerance: float,
) -> RoundedRoot | None:
    """Round a root with the largest unit that keeps the standard deviations of given combinations of the unknowns.

    Args:
        covariance_root: root of the covariance.
        combinations: combinations of the unknowns.
        tolerance: largest relative change of the standard deviation of a combination.

    Returns:
        The rounded root; None if even the smallest unit changes a standard deviation by more.
    """
    exact = torch.linalg.vector_norm(combinations @ covariance_root, dim=1)
    # R^T = Q U gives R R^T = U^T U without forming it, which would lose half of the digits of small directions
    triangular: Tensor = torch.linalg.qr(covariance_root.t(), mode="r")[1].t()
    lower = torch.nn.functional.pad(triangular, (0, len(covariance_root) - triangular.shape[1]))
    for step in STEPS:
        rounded = _rounded(lower, step)
        change = torch.linalg.vector_norm(combinations @ rounded.as_matrix, dim=1) - exact
        if bool((change.abs() <= tolerance * exact).all()):
            return rounded
    return None


def _rounded(lower: Float64[Tensor, "unknowns unknowns"], step: float) -> RoundedRoot:
    """Round a lower triangular root L row by row, compensating in every row for the rounding of previous rows.

    The rounded root is `L Z`, where Z is the identity except for errors. Combinations of correlated unknowns are known
    much better than the individual unknowns, so errors of independently rounded rows would dominate. Row i is therefore
    rounded from `L_i Z` with the Z of the previous rows. Only its own error is then new, with a standard deviation of
    `0.29 step` for any combination. Rows that are determined by previous rows are rounded to their smallest unit.

    Args:
        lower: L.
        step: unit of every row as a share of its diagonal entry.
    """
    pivot = lower.diagonal().abs()
    smallest = torch.linalg.vector_norm(lower, dim=1) * _SMALLEST_UNIT
    unit = torch.maximum(step * pivot, smallest)
    numbers, Z = torch.zeros_like(lower), torch.eye(len(lower)).to(lower)
    for row, exact in _rows_times(lower, Z):
        if unit[row] > 0:
            numbers[row, : row + 1] = torch.round(exact[: row + 1] / unit[row])
        if step * pivot[row] > smallest[row]:
            Z[row] += (numbers[row] * unit[row] - exact) / lower[row, row]
    return RoundedRoot(unit, numbers.to(torch.int16))


def _rows_times(
    lower: Float64[Tensor, "unknowns unknowns"], Z: Float64[Tensor, "unknowns unknowns"]
) -> Iterator[tuple[int, Float64[Tensor, " unknowns"]]]:
    """Yield the rows of `lower @ Z` one after the other; a row of Z may change after it was used."""
    for start in range(0, len(lower), _BLOCK):
        before = lower[start : start + _BLOCK, :start] @ Z[:start, :start]
        before = torch.nn.functional.pad(before, (0, len(lower) - start))
        for row, done in enumerate(before, start):
            yield row, done + lower[row, start : row + 1] @ Z[start : row + 1]
