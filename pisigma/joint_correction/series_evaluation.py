"""Fourier series of all joints at many joint values, read from a table instead of summed."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

DEGREE = 7

NODES_PER_HARMONIC = 16
"""Nodes over a turn for every harmonic, at least; rounded up to a power of two."""


class SeriesTable:
    """`S_j(θ) = Σ_k a_jk sin kθ + b_jk cos kθ`, k = 1 … K, by Taylor polynomials around equally spaced nodes.

    With N nodes a turn and x the distance to the nearest node in node spacings `h = 2π / N`, `|x| ≤ 1/2`::

        S(θ) = Σ_n S^(n)(θ_i) h^n / n! x^n,    n = 0 … 7

    What is left out is at most `Σ_k |c_k| (π k / N)^8 / 8!`: some 1e-11 of the size of the weights at k = K and far
    less below, 1e-14 rad of a correction. An evaluation costs ten times less than sines and cosines of all multiples,
    or products of them, whatever K is. The last axis of all values is that of the poses.
    """

    def __init__(self, sine: Float[Tensor, "dof harmonics"], cosine: Float[Tensor, "dof harmonics"]) -> None:
        """Take the weights a and b of sin kθ and cos kθ for k = 1 … K."""
        dof, harmonics = sine.shape
        self._nodes = 2 ** math.ceil(math.log2(max(NODES_PER_HARMONIC * harmonics, 64)))
        k = torch.arange(1, harmonics + 1, dtype=sine.dtype, device=sine.device)
        step = 2 * math.pi / self._nodes
        angle = torch.arange(self._nodes, dtype=sine.dtype, device=sine.device) * step
        waves = [torch.sin(k[:, None] * angle), torch.cos(k[:, None] * angle)]
        found, a, b = [], sine, cosine
        for degree in range(DEGREE + 1):
            found.append((a @ waves[0] + b @ waves[1]) / math.factorial(degree))
            a, b = -b * k * step, a * k * step  # of the derivative by x
        self._coefficients = torch.stack(found).reshape(DEGREE + 1, dof * self._nodes).contiguous()
        self._first = (torch.arange(dof, device=sine.device) * self._nodes)[:, None]

    def __call__(self, angle: Float[Tensor, "dof poses"]) -> Float[Tensor, "dof poses"]:
        """Values of the series at angles [rad]."""
        x, entries = self._look_up(angle)
        value = entries[DEGREE]
        for n in reversed(range(DEGREE)):
            value = torch.addcmul(entries[n], value, x)
        return value.reshape(angle.shape)

    def with_slope(
        self, angle: Float[Tensor, "dof poses"]
    ) -> tuple[Float[Tensor, "dof poses"], Float[Tensor, "dof poses"]]:
        """Values of the series, and their derivatives by the angles."""
        x, entries = self._look_up(angle)
        value, slope = entries[DEGREE], torch.zeros_like(x)
        for n in reversed(range(DEGREE)):
            slope = torch.addcmul(value, slope, x)
            value = torch.addcmul(entries[n], value, x)
        return value.reshape(angle.shape), slope.reshape(angle.shape) * (self._nodes / (2 * math.pi))

    def _look_up(self, angle: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Distance to the nearest node, and the coefficients there."""
        along = angle * (self._nodes / (2 * math.pi))
        node = along.round()
        place = ((node.long() & (self._nodes - 1)) + self._first).reshape(-1)
        return (along - node).reshape(-1), [row.index_select(0, place) for row in self._coefficients]
