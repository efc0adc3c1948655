"""Levenberg-Marquardt on normal equations; problem, solver and solution are apart."""

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
    cost: Float[Tensor, ""]
    descent: Float[Tensor, " unknowns"]
    normal: Float[Tensor, "unknowns unknowns"]
    misfit: Float[Tensor, ""]
    rounding: Float[Tensor, ""]
    detail: object


class AbstractLeastSquares(ABC, Generic[Point]):
    """What the solver needs to know of a problem."""

    @abstractmethod
    def linearise(self, point: Point, like: Linearisation[Point] | None) -> Linearisation[Point]:
        """See the problem from a point, with the noise of `like` (a guess of its own where None)."""

    def begin(self, point: Point) -> Linearisation[Point]:
        """See the problem from a start, with the noise that its residuals show."""
        return self.renewed(self.linearise(point, None))[0]

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

    def rms(self, linearisation: Linearisation[Point]) -> Float[Tensor, ""]:
        """A size of the residuals, by which the path of a search is shown; in standard deviations unless said."""
        return linearisation.misfit.sqrt()


@dataclass(frozen=True, eq=False)
class Solution(Generic[Point]):
    """Where a search ended.

    Attributes:
        linearisation: the problem seen from the end point, the noise renewed.
        iterations: steps tried.
        status: why the search ended.
        path: size of the residuals at every point passed, the start first; see `AbstractLeastSquares.rms`.
    """

    linearisation: Linearisation[Point]
    iterations: int
    status: SolutionStatus
    path: tuple[float, ...]

    def before(self, other: "Solution[Point]") -> "Solution[Point]":
        """The end of a search that went on from where this one ended."""
        return replace(other, iterations=self.iterations + other.iterations, path=self.path + other.path[1:])


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
    first = problem.renewed(start)[0] if isinstance(start, Linearisation) else problem.begin(start)
    search = _Search(problem, first)
    status: SolutionStatus | None = None
    while status is None and search.iterations < maximum_iterations:
        search.propose()
        near = search.at_best and search.decrement < close_enough**2
        status = SolutionStatus.CONVERGED if near else search.go()
    ended = status or SolutionStatus.ITERATION_LIMIT
    return Solution(search.best, search.iterations, ended, tuple(search.path))


class _Search(Generic[Point]):
    """A search that goes on.

    Attributes:
        best: the best point.
        here: where the next step starts.
        at_best: whether that is the best point.
        iterations: steps tried.
        decrement: by how much the next step lowers the cost if the problem is linear [squared standard errors].
        path: size of the residuals at every point passed.
    """

    def __init__(self, problem: AbstractLeastSquares[Point], best: Linearisation[Point]) -> None:
        self.problem, self.here, self.best = problem, best, best
        self.iterations, self.at_best, self.uphill = 0, True, 0
        self.damping, self.decrement, self.step = START_DAMPING, 0.0, best.descent
        self.path = [float(problem.rms(best))]

    def propose(self) -> None:
        """Work out the next step."""
        self.step = solve_damped(self.here, self.problem.step_scale, self.damping)
        self.decrement = float((self.here.normal @ self.step) @ self.step)

    def go(self) -> SolutionStatus | None:
        """Take the step, and decide where to go on, or why the search is over."""
        self.iterations += 1
        there = self.problem.linearise(self.problem.moved(self.here.point, self.step), self.best)
        if not bool(there.cost <= self.best.cost):
            return self._climb(there)
        settled = self._descend(there)
        if bool(self.best.misfit <= self.best.rounding):
            return SolutionStatus.EXACT
        return SolutionStatus.CONVERGED if settled and self.decrement <= SHORTEST_STEP**2 else None

    def _descend(self, there: Linearisation[Point]) -> bool:
        """Go on from where the cost is lower, and say whether the noise has settled."""
        settled = True
        if self.iterations <= SWINGING:
            there, settled = self.problem.renewed(there)
        self.best = self.here = there
        self.damping = max(self.damping / 10, SMALLEST_DAMPING)
        self.uphill, self.at_best = 0, True
        self.path.append(float(self.problem.rms(there)))
        return settled

    def _climb(self, there: Linearisation[Point]) -> SolutionStatus | None:
        """Follow a higher cost or go back, or say why the search is over."""
        small = self.decrement <= max(SHORTEST_STEP**2, 1e-10 * float(self.best.cost))
        if bool(self.best.misfit <= 1e4 * self.best.rounding):
            return SolutionStatus.EXACT
        if self.at_best and small:
            return SolutionStatus.CONVERGED
        if self.damping > LARGEST_DAMPING:
            return SolutionStatus.STALLED
        # there is no descent such as where a loss rejects every row
        going = math.isfinite(float(there.cost)) and bool(there.descent.any())
        self.at_best = not (going and self.uphill < PATIENCE)
        if self.at_best:
            self.here, self.uphill, self.damping = self.best, 0, max(100 * self.damping, 0.1)
        else:
            self.here, self.uphill = self.problem.renewed(there)[0], self.uphill + 1
        return None


def solve_damped(
    linearisation: Linearisation[Point],
    step_scale: Float[Tensor, " unknowns"],
    damping: float,
) -> Float[Tensor, " unknowns"]:
    """Solve `(normal + damping / step_scale²) step = descent` by Cholesky with column scaling.

    Raises:
        IdentificationError: they are not finite.
    """
    normal, descent = linearisation.normal, linearisation.descent
    diagonal = normal.diagonal()
    # a product of two columns is finite where their squares are
    if not math.isfinite(float((diagonal + descent).sum())):
        raise IdentificationError(
            "the normal equations are not finite; look for huge values, or standard deviations of next to nothing, in "
            "the measurements."
        )
    while True:
        damped = diagonal + damping / step_scale.square()
        scale = damped.rsqrt()
        scaled = normal * (scale * scale[:, None])
        scaled.diagonal().copy_(damped * scale.square() + 1e-14)
        factor, failed = torch.linalg.cholesky_ex(scaled)
        if not bool(failed):
            solved = torch.cholesky_solve((scale * descent)[:, None], factor)[:, 0]
            return scale * solved
        damping = max(10 * damping, 1e-6)


def covariance_of(normal: Float64[Tensor, "active active"]) -> Float64[Tensor, "active active"]:
    """Invert a normal matrix, with column scaling; directions that it does not hold get no variance."""
    diagonal = normal.diagonal()
    scale = diagonal.masked_fill(diagonal <= 0, 1.0).rsqrt_()
    scales = scale * scale[:, None]
    scaled = normal * scales
    factor, failed = torch.linalg.cholesky_ex(scaled)
    if not bool(failed) and bool((factor.diagonal() > 1e-6).all()):
        return torch.cholesky_inverse(factor).mul_(scales)
    covariance: Tensor = torch.linalg.pinv(scaled, rtol=1e-12, hermitian=True) * scales
    return covariance
