"""Levenberg-Marquardt method with normal equations, with separate classes for problem, solver and solution."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from enum import Enum
from typing import Generic, TypeVar

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.files.errors import IdentificationError

Point = TypeVar("Point")
_START_DAMPING = 1e-3
_SMALLEST_DAMPING = 1e-9
_LARGEST_DAMPING = 1e12
MAX_NOISE_UPDATES = 50
"""Number of steps after which the noise is no longer updated; with few rows it may oscillate between two estimates."""
_MAX_UPHILL_STEPS = 2
"""Number of steps that may raise the cost before the search returns to the best point."""
SHORTEST_STEP = 1e-3
"""Length of a step, in standard errors, below which the search has converged."""


class SolutionStatus(Enum):
    """Reason why a search ended; the value is the predicate of a sentence."""

    CONVERGED = "converged: the last step changed no parameter by more than 0.001 of its standard error"
    EXACT = "converged: the residuals are at rounding level"
    STALLED = "stopped: no step lowers the cost, although the residuals are above rounding level"
    ITERATION_LIMIT = (
        "stopped at the iteration limit; allow more iterations, or look for gross errors in the data"
    )

    @property
    def is_minimum(self) -> bool:
        """Whether the search ended at a minimum."""
        return self in (SolutionStatus.CONVERGED, SolutionStatus.EXACT)


@dataclass(frozen=True, eq=False)
class Linearisation(Generic[Point]):
    """A least-squares problem with cost `Σ (r / sigma)²`, linearised at a point.

    Attributes:
        point: the point of linearisation.
        cost: cost at the point [1].
        descent: minus half the gradient of the cost with respect to the unknowns.
        normal: half the Gauss-Newton Hessian of the cost, whose inverse is the covariance of the unknowns.
        misfit: part of the cost due to the data; the remainder is due to the prior.
        rounding: misfit that can be caused by rounding errors alone.
        problem_data: further data that the problem stores for later calls.
    """

    point: Point
    cost: Float[Tensor, ""]
    descent: Float[Tensor, " unknowns"]
    normal: Float[Tensor, "unknowns unknowns"]
    misfit: Float[Tensor, ""]
    rounding: Float[Tensor, ""]
    problem_data: object


class AbstractLeastSquares(ABC, Generic[Point]):
    """Interface of least-squares problems for the solver."""

    @abstractmethod
    def linearise(self, point: Point, with_noise_of: Linearisation[Point] | None) -> Linearisation[Point]:
        """Linearise the problem at a point with the noise of `with_noise_of`, or with a default noise if None."""

    def linearise_at_start(self, point: Point) -> Linearisation[Point]:
        """Linearise the problem at a start, with the noise estimated from its residuals."""
        return self.with_updated_noise(self.linearise(point, None))[0]

    @abstractmethod
    def with_updated_noise(self, linearisation: Linearisation[Point]) -> tuple[Linearisation[Point], bool]:
        """Estimate the noise from the residuals; return the updated linearisation, and whether it has converged."""

    @abstractmethod
    def apply_step(self, point: Point, step: Float[Tensor, " unknowns"]) -> Point:
        """Return the point after a step."""

    @property
    @abstractmethod
    def step_scale(self) -> Float[Tensor, " unknowns"]:
        """Typical size of every unknown, to which the damping is relative."""

    def rms(self, linearisation: Linearisation[Point]) -> Float[Tensor, ""]:
        """Return the size of the residuals, by default in standard deviations, for the path of a search."""
        return linearisation.misfit.sqrt()


@dataclass(frozen=True, eq=False)
class Solution(Generic[Point]):
    """Result of a search.

    Attributes:
        linearisation: the problem linearised at the best point, with the noise estimated there.
        iterations: number of steps tried.
        status: reason why the search ended.
        rms_path: size of the residuals at the start and at every accepted point; see `AbstractLeastSquares.rms`.
    """

    linearisation: Linearisation[Point]
    iterations: int
    status: SolutionStatus
    rms_path: tuple[float, ...]

    def continued_by(self, other: "Solution[Point]") -> "Solution[Point]":
        """Return the result of a search that continued this one, with the iterations and the path of both."""
        return replace(
            other, iterations=self.iterations + other.iterations, rms_path=self.rms_path + other.rms_path[1:]
        )


def levenberg_marquardt(
    problem: AbstractLeastSquares[Point],
    start: Point | Linearisation[Point],
    maximum_iterations: int = 50,
    step_tolerance: float = 0.0,
) -> Solution[Point]:
    """Minimise by Levenberg-Marquardt steps `(normal + damping / step_scale²) step = descent`.

    The damping is relative to `step_scale` in units of the noise, which is estimated again at every point. It
    decreases with the residuals, so convergence for exact data is quadratic even if the normal matrix is singular
    (Yamashita and Fukushima 2001). The linear system is solved by Cholesky factorisation after column scaling. A
    step that raises the cost is accepted once or twice, because the search can leave a curved valley and meet it
    again; if the cost does not fall below the lowest cost, the search returns to the best point with a hundred times
    larger damping (watchdog technique, Chamberlain et al. 1982).

    Args:
        problem: the problem to minimise.
        start: start point, or the problem linearised at the start point.
        maximum_iterations: maximum number of steps.
        step_tolerance: length of a step [standard errors] below which the step is not taken and the search has
            converged.

    Returns:
        The best point, with the reason for stopping (see `SolutionStatus`).
    """
    first = (
        problem.with_updated_noise(start)[0]
        if isinstance(start, Linearisation)
        else problem.linearise_at_start(start)
    )
    search = _Search(problem, first)
    status: SolutionStatus | None = None
    while status is None and search.iterations < maximum_iterations:
        search.propose_step()
        near = search.at_best and search.decrement < step_tolerance**2
        status = SolutionStatus.CONVERGED if near else search.try_step()
    ended = status or SolutionStatus.ITERATION_LIMIT
    return Solution(search.best, search.iterations, ended, tuple(search.path))


class _Search(Generic[Point]):
    """State of a search.

    Attributes:
        best: the best point.
        here: point from which the next step starts.
        at_best: whether the next step starts at the best point.
        iterations: number of steps tried.
        decrement: decrease of the cost that the next step would cause in a linear problem [squared standard errors].
        path: size of the residuals at every accepted point.
    """

    def __init__(self, problem: AbstractLeastSquares[Point], best: Linearisation[Point]) -> None:
        self.problem, self.here, self.best = problem, best, best
        self.iterations, self.at_best, self.uphill = 0, True, 0
        self.damping, self.decrement, self.step = _START_DAMPING, 0.0, best.descent
        self.path = [float(problem.rms(best))]

    def propose_step(self) -> None:
        """Compute the next step."""
        self.step = solve_damped(self.here, self.problem.step_scale, self.damping)
        self.decrement = float((self.here.normal @ self.step) @ self.step)

    def try_step(self) -> SolutionStatus | None:
        """Try the step, and choose the start of the next step, or return the reason why the search has ended."""
        self.iterations += 1
        there = self.problem.linearise(self.problem.apply_step(self.here.point, self.step), self.best)
        if not bool(there.cost <= self.best.cost):
            return self._climb(there)
        settled = self._descend(there)
        if bool(self.best.misfit <= self.best.rounding):
            return SolutionStatus.EXACT
        return SolutionStatus.CONVERGED if settled and self.decrement <= SHORTEST_STEP**2 else None

    def _descend(self, there: Linearisation[Point]) -> bool:
        """Accept a point with a lower cost, and return whether the noise has converged."""
        settled = True
        if self.iterations <= MAX_NOISE_UPDATES:
            there, settled = self.problem.with_updated_noise(there)
        self.best = self.here = there
        self.damping = max(self.damping / 10, _SMALLEST_DAMPING)
        self.uphill, self.at_best = 0, True
        self.path.append(float(self.problem.rms(there)))
        return settled

    def _climb(self, there: Linearisation[Point]) -> SolutionStatus | None:
        """Accept a higher cost, return to the best point, or return the reason why the search has ended."""
        small = self.decrement <= max(SHORTEST_STEP**2, 1e-10 * float(self.best.cost))
        if bool(self.best.misfit <= 1e4 * self.best.rounding):
            return SolutionStatus.EXACT
        if self.at_best and small:
            return SolutionStatus.CONVERGED
        if self.damping > _LARGEST_DAMPING:
            return SolutionStatus.STALLED
        # The descent is zero, for example, if the loss rejects every row.
        going = math.isfinite(float(there.cost)) and bool(there.descent.any())
        self.at_best = not (going and self.uphill < _MAX_UPHILL_STEPS)
        if self.at_best:
            self.here, self.uphill, self.damping = self.best, 0, max(100 * self.damping, 0.1)
        else:
            self.here, self.uphill = self.problem.with_updated_noise(there)[0], self.uphill + 1
        return None


def solve_damped(
    linearisation: Linearisation[Point],
    step_scale: Float[Tensor, " unknowns"],
    damping: float,
) -> Float[Tensor, " unknowns"]:
    """Solve `(normal + damping / step_scale²) step = descent` by Cholesky factorisation with column scaling.

    Raises:
        IdentificationError: the normal equations are not finite.
    """
    normal, descent = linearisation.normal, linearisation.descent
    diagonal = normal.diagonal()
    # The product of two columns is finite if their squares are finite, so checking the diagonal is sufficient.
    if not math.isfinite(float((diagonal + descent).sum())):
        raise IdentificationError(
            "the normal equations are not finite",
            remedy="look for huge values, or standard deviations near 0, in the measurements",
        )
    while True:
        damped = diagonal + damping / step_scale.square()
        scale = damped.rsqrt()
        # A unit diagonal makes metres and radians comparable, and the factorisation as stable as possible.
        scaled = normal * (scale * scale[:, None])
        scaled.diagonal().copy_(damped * scale.square() + 1e-14)
        factor, failed = torch.linalg.cholesky_ex(scaled)
        if not bool(failed):
            solved = torch.cholesky_solve((scale * descent)[:, None], factor)[:, 0]
            return scale * solved
        damping = max(10 * damping, 1e-6)


def covariance_of(normal: Float64[Tensor, "active active"]) -> Float64[Tensor, "active active"]:
    """Return the inverse of a normal matrix, computed with column scaling; undetermined directions get variance 0."""
    diagonal = normal.diagonal()
    scale = diagonal.masked_fill(diagonal <= 0, 1.0).rsqrt_()
    scales = scale * scale[:, None]
    scaled = normal * scales
    factor, failed = torch.linalg.cholesky_ex(scaled)
    if not bool(failed) and bool((factor.diagonal() > 1e-6).all()):
        return torch.cholesky_inverse(factor).mul_(scales)
    covariance: Tensor = torch.linalg.pinv(scaled, rtol=1e-12, hermitian=True) * scales
    return covariance
