"""Lines in the spectrum of the joints' errors: fast harmonics that stand out of what a first model leaves."""

import math

import torch
from jaxtyping import Bool, Complex128, Float64
from torch import Tensor

from pisigma.calibration.hybrid.design import Design, Rows
from pisigma.estimation.regression import Posterior
from pisigma.joint_correction.feature import turning_rate

HIGHEST = 3_000
"""[cycles a turn] Motors of 10 pairs of poles behind gears of 1:101 cog with 2,020; 0.1 mrad shift the phase of the
highest order by 0.3 rad."""
MOST_LINES = 8
"""Of a joint."""
ALIKE = 0.9
"""Harmonics whose sines have this correlation at the measured joint values cannot be told apart."""
BLOCK = 64
"""Powers of `exp(i angle)` that are made one by one; the others are their products."""


def lines(design: Design, rows: Rows, posterior: Posterior, lowest: int) -> tuple[tuple[int, ...], ...]:
    """Orders of the lines of every joint, the strongest first.

    The periodogram of unevenly sampled values (Scargle 1982, The Astrophysical Journal 263, 835-853) of what the joints
    would have to turn for the rest to vanish: by how much sine and cosine of an order raise the log likelihood.
    Of pure noise the gain is exponential with mean 1; the mean is taken from the median, as noise that the joints
    themselves make is larger than what the sensors' noise says. Orders whose gain outweighs the odds against them are
    lines more likely than not, and these predict best (the median probability model: Barbieri and Berger 2004, The
    Annals of Statistics 32(3), 870-897). Whether there are lines at all the evidence for all of them together says.

    Args:
        design: of a first model.
        rows: linearised.
        posterior: of the first model.
        lowest: [cycles a turn] Harmonics from here on.

    Returns:
        Per joint, in cycles a turn (of a prismatic joint, in twice its travel).
    """
    slope, curvature = _slope_and_curvature(design, rows, posterior)
    angle = design.problem.q * torch.from_numpy(turning_rate(design.problem.space.robot)).to(slope)
    least = odds_against_a_line(angle.shape[1])
    columns = zip(angle.t(), slope.t(), curvature.t(), strict=True)
    return tuple(_lines_of_joint(*column, lowest, least) for column in columns)


def odds_against_a_line(joints: int) -> float:
    """Logarithm of the number of orders of all joints, any of which may be a line."""
    return math.log(joints * HIGHEST)


def _slope_and_curvature(
    design: Design, rows: Rows, posterior: Posterior
) -> tuple[Float64[Tensor, "rows dof"], Float64[Tensor, "rows dof"]]:
    """First and minus second derivative of the log likelihood of every row by its joint values."""
    slope, curvature = torch.zeros_like(design.problem.q), torch.zeros_like(design.problem.q)
    for sensor, sigma in zip(rows.values, posterior.noise, strict=True):
        if not sensor.certain:
            weight = (sensor.root / sigma).square()[:, None]
            residual = sensor.residual - design.moved(sensor, posterior.x)
            for row, joints in sensor.sides:
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
    """Orders whose gain is the largest and beyond `least`, one after the other."""
    G = _sums(angle, curvature, 2 * HIGHEST + 1)
    candidates = _told_apart(G, lowest)
    if not bool(candidates.any()):
        return ()
    total, G2 = G[0].real, G[: 2 * HIGHEST + 1 : 2]
    ss, cc, sc = (total - G2.real) / 2, (total + G2.real) / 2, G2.imag / 2
    determinant = ss * cc - sc.square()
    orders: list[int] = []
    while len(orders) < MOST_LINES:
        P = _sums(angle, slope, HIGHEST + 1)
        sine, cosine = (
            (cc * P.imag - sc * P.real) / determinant,
            (ss * P.real - sc * P.imag) / determinant,
        )
        gain = torch.where(candidates, (sine * P.imag + cosine * P.real) / 2, 0.0)
        order = int(gain.argmax())
        chance = max(float(gain[candidates].median()) / math.log(2), 1.0)
        if float(gain[order]) < least * chance:
            break
        orders.append(order)
        wave = sine[order] * (order * angle).sin() + cosine[order] * (order * angle).cos()
        slope = slope - curvature * wave
    return tuple(orders)


def _told_apart(G: Complex128[Tensor, " _orders"], lowest: int) -> Bool[Tensor, " _orders"]:
    """Which orders are judged: where joint values stand on a grid, up to half of the harmonic that is constant there.

    Args:
        G: sums of the curvature times powers of `exp(i angle)`; near G_0 where powers are the same at all values.
        lowest: the first order; a joint whose values are too near to each other to tell its powers apart has none.
    """
    orders = torch.arange(HIGHEST + 1)
    constant = (G.abs() > ALIKE * G[0].real).nonzero()[:, 0]
    beyond = constant[constant >= lowest]
    highest = int(beyond[0]) / 2 if len(beyond) else HIGHEST + 1
    return (orders >= lowest) & (orders < highest)


def _sums(
    angle: Float64[Tensor, " rows"], values: Float64[Tensor, " rows"], count: int
) -> Complex128[Tensor, " count"]:
    """`Σ values · exp(i k angle)` for k = 0 … count - 1, as products of powers up to `BLOCK` and of multiples of it."""
    few = torch.exp(1j * angle[:, None] * torch.arange(BLOCK))
    steps = torch.exp(1j * BLOCK * angle * torch.arange(-(-count // BLOCK))[:, None])
    return ((steps * values) @ few).flatten()[:count]
