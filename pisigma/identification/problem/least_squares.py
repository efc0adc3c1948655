"""Levenberg-Marquardt on normal equations; problem, solver and solution are apart."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.errors import IdentificationError

Point = TypeVar("Point")
START_DAMPING = 1e-3
SMALLEST_DAMPING = 1e-9
LARGEST_DAMPING = 1e12
SWINGING = 50
"""Steps after which the noise stays as it is: few rows may let it swing between two estimates for ever."""
PATIENCE = 2
"""Steps that may raise the cost before the search goes back."""
SHORTEST_STEP = 1e-3
"""[standard errors] A step shorter than this in every direction ends the search."""


class SolutionStatus(Enum):
    """How a search ended; the value is a sentence."""

    CONVERGED = "converged: a step moves nothing by more than a thousandth of its standard error any more"
    EXACT = "converged: the residuals are at rounding level"
    STALLED = "stopped: no step lowers the cost any more, though the residuals are above rounding level"
    ITERATION_LIMIT = (
        "stopped at the iteration limit; allow more iterations or look for gross errors in the data"
    )

    @property
    def good(self) -> bool:
        """Whether the point is a minimum."""
        return self in (SolutionStatus.CONVERGED, SolutionStatus.EXACT)


@dataclass(frozen=True, eq=False)
class Linearisation(Generic[Point]):
    """A least-squares problem linearised from one point, with cost `Σ (r / sigma)²`.

    Attributes:
        point: where.
        cost: without unit.
        descent: minus half the gradient of the cost by the unknowns.
        normal: half its Gauss-Newton Hessian, whose inverse is the covariance of the unknowns.
        misfit: the part of the cost that the data make (the rest is a prior's).
        rounding: the misfit that rounding errors alone may make.
        detail: what the problem wants to remember.
    """

    point: Point
    cost: float
    descent: Float[Tensor, " unknowns"]
    normal: Float[Tensor, "unknowns unknowns"]
    misfit: float
    rounding: float
    detail: object


class AbstractLeastSquares(ABC, Generic[Point]):
    """What the solver needs to know of a problem."""

    @abstractmethod
    def linearise(self, point: Point, like: Linearisation[Point] | None) -> Linearisation[Point]:
        """See the problem from a point, with the noise of `like` (a guess of its own where None)."""

    @abstractmethod
    def renewed(self, linearisation: Linearisation[Point]) -> tuple[Linearisation[Point], bool]:
        """The same with the noise estimated from its residuals, and whether the noise has settled."""

    @abstractmethod
    def moved(self, point: Point, step: Float[Tensor, " unknowns"]) -> Point:
        """The point after a step."""

    @property
    @abstractmethod
    def step_scale(self) -> Float[Tensor, " unknowns"]:
        """A usual size of every unknown, which the damping is measured with."""


@dataclass(frozen=True, eq=False)
class Solution(Generic[Point]):
    """Where a search ended.

    Attributes:
        linearisation: the problem seen from the end point, the noise renewed.
        iterations: steps tried.
        status: why it ended.
        path: the problem seen from every point passed, the start first.
    """

    linearisation: Linearisation[Point]
    iterations: int
    status: SolutionStatus
    path: tuple[Linearisation[Point], ...]


def levenberg_marquardt(
    problem: AbstractLeastSquares[Point],
    start: Point | Linearisation[Point],
    maximum_iterations: int = 50,
    close_enough: float = 0.0,
) -> Solution[Point]:
    """Minimise by Levenberg-Marquardt steps `(normal + damping / step_scale²) step = descent`.

    The damping is measured against `step_scale` in units of the noise, which is estimated anew at every
    point: as the residuals shrink, so does it, and exact data are met quadratically even where the normal
    matrix is singular (Yamashita and Fukushima 2001). The linear system is solved by Cholesky after scaling
    its columns. A step that raises the cost is followed further once or twice, because curved valleys are
    left and met again that way; if the best cost is not undercut by then, the search goes back there with a
    hundredfold damping (watchdog technique, Chamberlain et al. 1982).

    Args:
        problem: what to minimise.
        start: where to begin, or the problem as already seen from there.
        maximum_iterations: steps tried at most.
        close_enough: length [standard errors] of a step that is not taken any more; the search has converged then.

    Returns:
        The best point, with the reason for stopping (see `SolutionStatus`).
    """
    first = start if isinstance(start, Linearisation) else problem.linearise(start, None)
    best, settled = problem.renewed(first)
    here, path, damping, uphill, iterations = best, [best], START_DAMPING, 0, 0

    def ended(status: SolutionStatus) -> Solution[Point]:
        return Solution(best, iterations, status, tuple(path))

    while iterations < maximum_iterations:
        step = solve_damped(here, problem.step_scale, damping)
        decrement = float((here.normal @ step).dot(step))
        if here is best and decrement < close_enough**2:
            return ended(SolutionStatus.CONVERGED)
        iterations += 1
        there = problem.linearise(problem.moved(here.point, step), best)
        if there.cost <= best.cost:
            best, settled = problem.renewed(there) if iterations <= SWINGING else (there, True)
            here, uphill, damping = best, 0, max(damping / 10, SMALLEST_DAMPING)
            path.append(best)
            if best.misfit <= best.rounding:
                return ended(SolutionStatus.EXACT)
            if decrement <= SHORTEST_STEP**2 and settled:
                return ended(SolutionStatus.CONVERGED)
            continue
        if best.misfit <= 1e4 * best.rounding:
            return ended(SolutionStatus.EXACT)
        if here is best and (decrement <= SHORTEST_STEP**2 or decrement <= 1e-10 * best.cost):
            return ended(SolutionStatus.CONVERGED)
        if damping > LARGEST_DAMPING:
            return ended(SolutionStatus.STALLED)
        uphill += 1
        lost = not bool(there.descent.any())  # such as where a loss rejects every row
        if uphill <= PATIENCE and there.cost < float("inf") and not lost:
            here = problem.renewed(there)[0]
        else:
            here, uphill, damping = best, 0, max(100 * damping, 0.1)
    return ended(SolutionStatus.ITERATION_LIMIT)


def solve_damped(
    linearisation: Linearisation[Point], step_scale: Float[Tensor, " unknowns"], damping: float
) -> Float[Tensor, " unknowns"]:
    """Solve `(normal + damping / step_scale²) step = descent` by Cholesky with column scaling.

    Raises:
        IdentificationError: they are not finite.
    """
    normal = linearisation.normal
    if not math.isfinite(float(normal.sum() + linearisation.descent.sum())):
        raise IdentificationError(
            "the normal equations are not finite; look for huge values, or standard deviations of next to nothing, in "
            "the measurements."
        )
    while True:
        damped = normal.diagonal() + damping / step_scale.square()
        scale = damped.rsqrt()
        scaled = normal * (scale * scale[:, None])
        scaled.diagonal().copy_(damped * scale.square() + 1e-14)
        factor, failed = torch.linalg.cholesky_ex(scaled)
        if not failed:
            return scale * torch.cholesky_solve((scale * linearisation.descent)[:, None], factor)[:, 0]
        damping = max(10 * damping, 1e-6)


def covariance_of(normal: Float64[Tensor, "active active"]) -> Float64[Tensor, "active active"]:
    """Invert a normal matrix, with column scaling; directions that it does not hold get no variance."""
    diagonal = normal.diagonal()
    scale = torch.where(diagonal > 0, diagonal, 1.0).rsqrt()
    scales = scale * scale[:, None]
    scaled = normal * scales
    factor, failed = torch.linalg.cholesky_ex(scaled)
    if not failed and bool((factor.diagonal() > 1e-6).all()):
        inverse = torch.cholesky_inverse(factor)
    else:
        inverse = torch.linalg.pinv(scaled, rtol=1e-12, hermitian=True)
    return inverse * scales
