"""Determine the direction of gravity by the evidence for the axes of the base and for inclined directions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.hybrid.design import AbstractDesignRegression, Design, LinearisedRows
from pisigma.calibration.hybrid.regression import build_regression
from pisigma.calibration.hybrid.search import CLEAR_EVIDENCE, ROUGH_TOLERANCE
from pisigma.estimation.regression import Posterior
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import Direction, GravityTorques
from pisigma.robot.description import Robot
from pisigma.robot.se3 import rotation_from_zyx

USUAL: Direction = (0.0, 0.0, -1.0)
"""Direction of gravity in the base frame of a robot on the floor."""
_FLOOR_ODDS = 100.0
"""Prior odds of a robot on the floor against a robot that is mounted otherwise although the user does not state it;
also of gravity along an axis of the base against an inclined direction. The measured UR10, which is on the floor,
has a log evidence for an inclined direction that is 16 above that of the axes."""
_HARMONICS = 8
"""Number of harmonics of a series that is fitted as well: low harmonics of a gear look like torques of gravity along
other axes."""
_LEAST_INCLINATION = math.radians(30)
"""Angle to all axes above which a direction is inclined. Unmodelled errors of simulated arms on the floor, and of the
measured UR10, look like an inclination by up to 24 deg, which predicts held-out rows better, but not rows of another
session; smaller inclinations have to be stated."""
AXES: tuple[Direction, ...] = (USUAL, (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0))
_STARTS = 64
"""Number of directions on a half sphere, about 18 deg apart; the best of them is refined."""
_UPDATES = 8
"""Number of steps of Newton's method, which converges in 3 to 6 steps on simulated arms."""


def to_first_row_frame(robot: Robot, direction: Direction) -> Direction:
    """Return a direction in the robot's base frame, transformed to the frame of its first row."""
    turned = rotation_from_zyx(torch.tensor(robot.base[3:])).mT @ torch.tensor(direction).double()
    x, y, z = (turned + 0.0).tolist()
    return x, y, z


def gravity_by_evidence(
    robot: Robot, rows: LinearisedRows, noise: tuple[float, ...], prior_scale: Sequence[float]
) -> Direction:
    """Find the direction of gravity in the base frame, for robots on walls, rails, ceilings and inclined pedestals.

    Geometry, a short series and the `GravityTorques` of each axis are fitted to the rows. Torques are linear in masses
    of either sign, so the evidence and all predictions are the same for both directions of an axis; the direction
    with a positive sum of masses is chosen. Directions other than down must have a log evidence above that of the
    other axes by `CLEAR_EVIDENCE` plus the log prior odds against them. For an inclined direction, which is fitted to
    the rows, the logarithm of the share of the half sphere that is compatible with the rows (Laplace's approximation)
    is subtracted from this threshold, and the direction must not be near an axis (`_LEAST_INCLINATION`).

    Args:
        robot: the nominal robot.
        rows: rows linearised at the geometric calibration.
        noise: noise of the geometric calibration per sensor.
        prior_scale: prior scales of the geometric calibration.

    Returns:
        The direction in the robot's base frame.
    """

    def fitted(*directions: Direction) -> tuple[AbstractDesignRegression, Posterior, Design]:
        torques = (GravityTorques(robot, to_first_row_frame(robot, one)) for one in directions)
        design = Design(rows.problem, (*torques, FourierSeries(robot, _HARMONICS)))
        fit = build_regression(design, rows)
        return fit, fit.maximise_evidence(design.prior(prior_scale), noise, tolerance=ROUGH_TOLERANCE), design

    def judged(direction: Direction) -> tuple[float, Direction]:
        _, posterior, design = fitted(direction)
        used = design.features[0].used
        weight = torch.zeros(used.shape).to(posterior.x)
        masses = weight.masked_scatter(used, posterior.x[design.weights_of(0)])[:, ::4]
        x, y, z = (value if masses.sum() > 0 else 0.0 - value for value in direction)
        return posterior.log_evidence, (x, y, z)

    (second, _), (first, best) = sorted(map(judged, AXES))[1:]
    direction, share = _most_probable(_evidence_of_direction(*fitted(*AXES)))
    inclined, direction = judged(direction)
    is_inclined = max(map(abs, direction)) < math.cos(_LEAST_INCLINATION)
    if is_inclined and inclined - first > CLEAR_EVIDENCE + 2 * math.log(_FLOOR_ODDS) - math.log(share):
        return direction
    return best if first - second > CLEAR_EVIDENCE + math.log(_FLOOR_ODDS) else USUAL


@dataclass(frozen=True, eq=False)
class _EvidenceOfDirection:
    """Log evidence for gravity along `Σ c_k a_k`, for the `AXES` a_k, with the same masses for all axes.

    With the precision `P = 1 + Σ c_k c_l N_kl` and the right-hand side `d = Σ c_k d_k` of the normal equations of the
    masses, it is `(d P^-1 d - log det P) / 2`. c may have any length, which only scales the prior of the masses.

    Attributes:
        normal: the matrices `N_kl + N_lk`.
        descent: the vectors `d_k`.
    """

    normal: Float64[Tensor, "3 3 masses masses"]
    descent: Float64[Tensor, "3 masses"]

    def __call__(self, c: Float64[Tensor, "*batch 3"]) -> Float64[Tensor, "*batch"]:
        """Return the log evidence for the coefficients c."""
        lower = torch.linalg.cholesky(self._precision(c))
        gain = torch.linalg.solve_triangular(lower, (c @ self.descent)[..., None], upper=False)
        value: Tensor = gain.square().sum((-2, -1)) / 2 - lower.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return value

    def derivatives(self, c: Float64[Tensor, " 3"]) -> tuple[Float64[Tensor, " 3"], Float64[Tensor, "3 3"]]:
        """Return gradient and Hessian of the log evidence with respect to c."""
        inverse = torch.linalg.inv(self._precision(c))
        x = inverse @ (c @ self.descent)
        slope = torch.einsum("kmln,l->kmn", self.normal.transpose(1, 2), c)
        moved, turned = slope @ x, inverse @ slope
        rest = self.descent - moved
        gradient = self.descent @ x - moved @ x / 2 - turned.diagonal(dim1=1, dim2=2).sum(-1) / 2
        traces = torch.einsum("kmn,lnm->kl", turned, turned) - torch.einsum(
            "klmn,nm->kl", self.normal, inverse
        )
        curved = torch.einsum("m,klmn,n->kl", x, self.normal, x)
        return gradient, rest @ inverse @ rest.t() + (traces - curved) / 2

    def _precision(self, c: Float64[Tensor, "*batch 3"]) -> Float64[Tensor, "*batch masses masses"]:
        products = (c[..., :, None] * c[..., None, :]).flatten(-2)
        precision = (products @ self.normal.flatten(0, 1).flatten(1)) / 2
        return precision.reshape(*c.shape[:-1], *self.normal.shape[2:]) + torch.eye(self.normal.shape[-1]).to(
            c
        )


def _evidence_of_direction(
    fit: AbstractDesignRegression, posterior: Posterior, design: Design
) -> _EvidenceOfDirection:
    """Return the evidence from a fit with separate masses for each of the `AXES`, without their prior."""
    count = len(AXES)
    weights = slice(design.weights_of(0).start, design.weights_of(count - 1).stop)
    # Inverting the block of the covariance marginalises geometry and series; minus the prior, data alone are left.
    root = fit.covariance_root(posterior).as_matrix[weights].cpu()
    total, prior = torch.linalg.inv(root @ root.t()), posterior.prior.precision[weights].cpu()
    # In units of the prior standard deviations, the prior precision of the masses is 1 for every direction.
    size = prior.reshape(count, -1)[0].rsqrt()
    normal = (total - prior.diag()).reshape(count, len(size), count, len(size))
    normal = (normal * size[:, None, None] * size).transpose(1, 2)
    descent = (total @ posterior.x[weights].cpu()).reshape(count, -1) * size
    return _EvidenceOfDirection(normal + normal.transpose(0, 1), descent)


def _most_probable(log_evidence: _EvidenceOfDirection) -> tuple[Direction, float]:
    """Find the direction with the highest evidence by Newton's method from the best of `_STARTS` directions.

    Returns:
        The direction in the base frame, and the share of the half sphere that is compatible with the rows.
    """
    number = torch.arange(_STARTS, dtype=torch.float64)
    # Fibonacci lattice: equal steps of height are equal areas, and the golden angle spreads the directions evenly.
    height, turn = (number + 0.5) / _STARTS, math.pi * (3 - math.sqrt(5)) * number
    level = (1 - height.square()).sqrt()
    tried = torch.stack([height, level * turn.cos(), level * turn.sin()], 1)
    for _ in range(_UPDATES):
        c = tried[log_evidence(tried).argmax()]
        gradient, hessian = log_evidence.derivatives(c)
        curvature, along = torch.linalg.eigh(hessian)
        # With the absolute curvature, the step points uphill where the Hessian is not negative; the factor 0 keeps c.
        step = along @ (along.t() @ gradient / curvature.abs())
        tried = c + step * torch.tensor([[0.0], [0.125], [0.25], [0.5], [1.0]]).to(c)
    # Laplace: with the information H per squared radian along two tangents, the posterior covers an area of
    # 2 π det(H)^-1/2 of the 2 π of the half sphere, at most all of it.
    across = torch.linalg.svd(c[None]).Vh[1:] * c.norm()
    information = -across @ log_evidence.derivatives(c)[1] @ across.t()
    x, y, z = (c / c.norm() @ c.new_tensor(AXES)).tolist()
    return (x, y, z), float(torch.linalg.det(information).clamp(min=1.0).rsqrt())


def gravity_in_base(robot: Robot, features: Sequence[AbstractFeature]) -> Direction | None:
    """Return the direction of gravity in the base frame that the features assume; None if no feature depends on it."""
    directions = [chosen.gravity for chosen in features if isinstance(chosen, GravityTorques)]
    if not directions:
        return None
    turned = rotation_from_zyx(torch.tensor(robot.base[3:])) @ torch.tensor(directions[0]).double()
    x, y, z = turned.tolist()
    return x, y, z


def gravity_sentence(robot: Robot, features: Sequence[AbstractFeature]) -> str:
    """Return a sentence about the axis of the base along which gravity acts; empty if no feature depends on it."""
    direction = gravity_in_base(robot, features)
    if direction is None:
        return ""
    axis = max(range(3), key=lambda k: abs(direction[k]))
    along = f"{'-' if direction[axis] < 0 else '+'}{'xyz'[axis]}"
    if abs(direction[axis]) < 1 - 1e-9:
        along = "({:.3g}, {:.3g}, {:.3g})".format(*direction)
    return f"Gravity acts along {along} of the base."
