"""Find lines in the spectrum of joint errors: high harmonics in the residuals of a first model."""

import math

import torch
from jaxtyping import Bool, Complex128, Float64
from torch import Tensor

from pisigma.calibration.hybrid.design import Design, LinearisedRows
from pisigma.estimation.regression import Posterior
from pisigma.joint_correction.feature import angle_per_joint_value

HIGHEST_ORDER = 3_000
"""Highest order of a line [1/turn]. Motors with 10 pole pairs and gear ratios of 101:1 have cogging at 2,020; an error
of 0.1 mrad shifts the phase of the highest order by 0.3 rad."""
_MAX_LINES = 8
"""Largest number of lines per joint."""
_ALIKE = 0.9
"""Correlation of two harmonics at the measured joint values above which they cannot be distinguished."""
BLOCK = 64
"""Number of powers of `exp(i angle)` that are computed directly; higher powers are products of these."""


def find_spectral_lines(
    design: Design, rows: LinearisedRows, posterior: Posterior, lowest_order: int
) -> tuple[tuple[int, ...], ...]:
    """Find the orders of the spectral lines of every joint, strongest first.

    The periodogram of unevenly sampled values (Scargle 1982, The Astrophysical Journal 263, 835-853) of the joint
    motions that would cancel the residuals gives the increase of the log likelihood by sine and cosine of each order.
    For pure noise, this gain has an exponential distribution with mean 1. The mean is estimated from the median,
    because joints cause noise in addition to that of the sensors. Orders whose gain exceeds the prior log odds against
    them are lines with a probability above 1/2, and such lines predict best (median probability model: Barbieri and
    Berger 2004, The Annals of Statistics 32(3), 870-897). The evidence for all lines together decides whether there
    are lines.

    Args:
        design: design of a first model.
        rows: linearised rows.
        posterior: posterior of the first model.
        lowest_order: lowest order [1/turn].

    Returns:
        Orders per joint [1/turn] (for a prismatic joint per twice its travel).
    """
    slope, curvature = _slope_and_curvature(design, rows, posterior)
    angle = design.problem.q * torch.from_numpy(angle_per_joint_value(design.problem.space.robot)).to(slope)
    least = log_number_of_orders(angle.shape[1])
    columns = zip(angle.t(), slope.t(), curvature.t(), strict=True)
    return tuple(_lines_of_joint(*column, lowest_order, least) for column in columns)


def log_number_of_orders(joints: int) -> float:
    """Return the logarithm of the number of candidate lines: every order of every joint."""
    return math.log(joints * HIGHEST_ORDER)


def _slope_and_curvature(
    design: Design, rows: LinearisedRows, posterior: Posterior
) -> tuple[Float64[Tensor, "rows dof"], Float64[Tensor, "rows dof"]]:
    """Return first and negative second derivatives of the rows' log likelihood with respect to the joint values."""
    slope, curvature = torch.zeros_like(design.problem.q), torch.zeros_like(design.problem.q)
    for sensor, sigma in zip(rows.values, posterior.noise, strict=True):
        if not sensor.are_values_given:
            weight = (sensor.weight_root / sigma).square()[:, None]
            residual = sensor.residual - design.predicted_change(sensor, posterior.x)
            for row, joints in sensor.row_derivatives:
                slope.index_add_(0, row, torch.einsum("rcj,rc->rj", joints, residual) * weight)
                curvature.index_add_(0, row, joints.square().sum(1) * weight)
    return slope, curvature


def _lines_of_joint(
    angle: Float64[Tensor, " rows"],
    slope: Float64[Tensor, " rows"],
    curvature: Float64[Tensor, " rows"],
    lowest: int,
    least: float,
) -> tuple[int, ...]:
    """Find the orders with the largest gains above `least` one by one, subtracting each line from the residuals."""
    G = _sums(angle, curvature, 2 * HIGHEST_ORDER + 1)
    candidates = _distinguishable(G, lowest)
    if not bool(candidates.any()):
        return ()
    total, G2 = G[0].real, G[: 2 * HIGHEST_ORDER + 1 : 2]
    # Weighted sums of sin², cos² and sin·cos of every order k, from `exp(2ik angle)`.
    ss, cc, sc = (total - G2.real) / 2, (total + G2.real) / 2, G2.imag / 2
    determinant = ss * cc - sc.square()
    orders: list[int] = []
    while len(orders) < _MAX_LINES:
        P = _sums(angle, slope, HIGHEST_ORDER + 1)
        sine, cosine = (
            (cc * P.imag - sc * P.real) / determinant,
            (ss * P.real - sc * P.imag) / determinant,
        )
        gain = torch.where(candidates, (sine * P.imag + cosine * P.real) / 2, 0.0)
        order = int(gain.argmax())
        # mean of an exponential distribution, from its median
        chance = max(float(gain[candidates].median()) / math.log(2), 1.0)
        if float(gain[order]) < least * chance:
            break
        orders.append(order)
        wave = sine[order] * (order * angle).sin() + cosine[order] * (order * angle).cos()
        slope = slope - curvature * wave
    return tuple(orders)


def _distinguishable(G: Complex128[Tensor, " _orders"], lowest: int) -> Bool[Tensor, " _orders"]:
    """Return the mask of orders that can be distinguished: on a grid, up to half the order that looks constant.

    Args:
        G: sums of the curvature times powers of `exp(i angle)`, near G_0 for powers that are equal at all joint values.
        lowest: lowest order; a joint whose values are too close together has no distinguishable orders.
    """
    orders = torch.arange(HIGHEST_ORDER + 1)
    constant = (G.abs() > _ALIKE * G[0].real).nonzero()[:, 0]
    beyond = constant[constant >= lowest]
    highest = int(beyond[0]) / 2 if len(beyond) else HIGHEST_ORDER + 1
    return (orders >= lowest) & (orders < highest)


def _sums(
    angle: Float64[Tensor, " rows"], values: Float64[Tensor, " rows"], count: int
) -> Complex128[Tensor, " count"]:
    """Compute `Σ values · exp(i k angle)` for k = 0 … count - 1 from powers up to `BLOCK` and of its multiples."""
    few = torch.exp(1j * angle[:, None] * torch.arange(BLOCK))
    steps = torch.exp(1j * BLOCK * angle * torch.arange(-(-count // BLOCK))[:, None])
    return ((steps * values) @ few).flatten()[:count]
