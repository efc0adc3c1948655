"""Levenberg-Marquardt on normal equations; problem, solver and solution are apart."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.robots import in_order, of_robots, with_robots
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
    """A least-squares problem linearised from one point, with cost `Σ (r / sigma)²`; or those of several robots.

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
    cost: Float[Tensor, "*robots"]
    descent: Float[Tensor, "*robots unknowns"]
    normal: Float[Tensor, "*robots unknowns unknowns"]
    misfit: Float[Tensor, "*robots"]
    rounding: Float[Tensor, "*robots"]
    detail: object


class AbstractLeastSquares(ABC, Generic[Point]):
    """What the solver needs to know of a problem, which may be those of several robots side by side."""

    @abstractmethod
    def linearise(self, point: Point, like: Linearisation[Point] | None) -> Linearisation[Point]:
        """See the problem from a point, with the noise of `like` (a guess of its own where None)."""

    def begin(self, point: Point) -> Linearisation[Point]:
        """See the problem from a start, with the noise that its residuals show."""
        return self.renewed(self.linearise(point, None))[0]

    @abstractmethod
    def renewed(self, linearisation: Linearisation[Point]) -> tuple[Linearisation[Point], Tensor]:
        """The same with the noise estimated from its residuals, and whether the noise has settled, `*robots`."""

    @abstractmethod
    def moved(self, point: Point, step: Float[Tensor, "*robots unknowns"]) -> Point:
        """The point after a step."""

    @property
    @abstractmethod
    def step_scale(self) -> Float[Tensor, " unknowns"]:
        """A usual size of every unknown, which the damping is measured with."""

    def rms(self, linearisation: Linearisation[Point]) -> Float[Tensor, "*robots"]:
        """A size of the residuals, by which the path of a search is shown; in standard deviations unless said."""
        return linearisation.misfit.sqrt()

    def of_robots(self, robots: Int64[Tensor, " chosen"]) -> "AbstractLeastSquares[Point]":
        """The problem of some of its robots; that of one robot is the same whichever are chosen.

        Args:
            robots: numbers of those that are kept.
        """
        return self


@dataclass(frozen=True)
class SearchEnd:
    """How the search for one robot ended.

    Attributes:
        iterations: steps tried.
        status: why it ended.
        path: size of the residuals at every point passed, the start first; see `AbstractLeastSquares.rms`.
    """

    iterations: int
    status: SolutionStatus
    path: tuple[float, ...]

    def before(self, other: "SearchEnd") -> "SearchEnd":
        """The end of a search that went on from this one."""
        return SearchEnd(self.iterations + other.iterations, other.status, self.path + other.path[1:])


@dataclass(frozen=True, eq=False)
class Solution(Generic[Point]):
    """Where a search ended.

    Attributes:
        linearisation: the problem seen from the end point, the noise renewed.
        ends: how it ended for every robot.
    """

    linearisation: Linearisation[Point]
    ends: tuple[SearchEnd, ...]

    @property
    def iterations(self) -> int:
        """Steps tried, most of all robots."""
        return max(end.iterations for end in self.ends)

    @property
    def status(self) -> SolutionStatus:
        """Why the search for one robot ended."""
        (end,) = self.ends
        return end.status

    @property
    def path(self) -> tuple[float, ...]:
        """Size of one robot's residuals at every point passed, the start first."""
        (end,) = self.ends
        return end.path


def levenberg_marquardt(
    problem: AbstractLeastSquares[Point],
    start: Point | Linearisation[Point],
    maximum_iterations: int | Sequence[int] = 50,
    close_enough: float = 0.0,
) -> Solution[Point]:
    """Minimise by Levenberg-Marquardt steps `(normal + damping / step_scale²) step = descent`.

    The damping is measured against `step_scale` in units of the noise, which is estimated anew at every
    point: as the residuals shrink, so does it, and exact data are met quadratically even where the normal
    matrix is singular (Yamashita and Fukushima 2001). The linear system is solved by Cholesky after scaling
    its columns. A step that raises the cost is followed further once or twice, because curved valleys are
    left and met again that way; if the best cost is not undercut by then, the search goes back there with a
    hundredfold damping (watchdog technique, Chamberlain et al. 1982).

    Several robots go side by side, each with its own damping and its own end, as if each were searched for alone.

    Args:
        problem: what to minimise.
        start: where to begin, or the problem as already seen from there.
        maximum_iterations: steps tried at most; of all robots, or of each.
        close_enough: length [standard errors] of a step that is not taken any more; the search has converged then.

    Returns:
        The best point, with the reason for stopping (see `SolutionStatus`).
    """
    first = problem.renewed(start)[0] if isinstance(start, Linearisation) else problem.begin(start)
    search = _Search(problem, first)
    limits = np.broadcast_to(np.array(maximum_iterations), len(search.robots))
    while len(search.robots):
        search.end(limits[search.robots] <= search.iterations, SolutionStatus.ITERATION_LIMIT)
        if len(search.robots):
            search.propose()
            near = search.at_best & (search.decrement < close_enough**2)
            search.end(near, SolutionStatus.CONVERGED)
        if len(search.robots):
            search.go()
    return Solution(in_order(*zip(*search.ended, strict=True)), tuple(search.ends))


class _Search(Generic[Point]):
    """The searches that go on; arrays have one entry for each of them.

    Attributes:
        robots: whose searches they are, their numbers among all.
        ended: the best points where searches have ended, and the numbers of their robots.
        ends: how the searches have ended.
        best: the best points.
        here: where the next steps start.
        at_best: whether those are the best points.
        iterations: steps tried.
        decrement: by how much the next step lowers the cost if the problem is linear [squared standard errors].
    """

    def __init__(self, problem: AbstractLeastSquares[Point], best: Linearisation[Point]) -> None:
        self.problem, self.here, self.best = problem, best, best
        self.ended: list[tuple[Linearisation[Point], Tensor]] = []
        count = best.cost.numel()
        self.robots, self.iterations = np.arange(count), 0
        self.at_best, self.uphill = np.ones(count, dtype=bool), np.zeros(count, dtype=np.int64)
        self.damping, self.decrement, self.step = np.full(count, START_DAMPING), np.zeros(count), best.descent
        self.ends = [SearchEnd(0, SolutionStatus.ITERATION_LIMIT, (rms,)) for rms in self._rms()]

    def propose(self) -> None:
        """Work out the next steps."""
        damping = torch.from_numpy(self.damping).to(self.best.cost).view_as(self.best.cost)
        self.step = solve_damped(self.here, self.problem.step_scale, damping)
        self.decrement = _array(_product(self.here.normal, self.step).mul_(self.step).sum(-1))

    def go(self) -> None:
        """Take the steps; end the searches that are over, and decide where the others go on."""
        self.iterations += 1
        there = self.problem.linearise(self.problem.moved(self.here.point, self.step), self.best)
        lower, over = _array(there.cost <= self.best.cost), np.full(len(self.robots), None, dtype=object)
        settled = self._descend(there) if lower.all() else self._climb_or_descend(there, lower, over)
        for robot, rms, passed in zip(self.robots, self._rms(), lower, strict=True):
            if passed:
                self.ends[robot] = replace(self.ends[robot], path=(*self.ends[robot].path, rms))
        over[lower & settled & (self.decrement <= SHORTEST_STEP**2)] = SolutionStatus.CONVERGED
        over[lower & _array(self.best.misfit <= self.best.rounding)] = SolutionStatus.EXACT
        self.end(over.astype(bool), over)

    def _descend(self, there: Linearisation[Point]) -> np.ndarray:
        """Go on from where all costs are lower, and say where the noise has settled."""
        settled = np.ones(len(self.robots), dtype=bool)
        if self.iterations <= SWINGING:
            there, now = self.problem.renewed(there)
            settled = _array(now)
        self.best = self.here = there
        self.damping = np.maximum(self.damping / 10, SMALLEST_DAMPING)
        self.uphill, self.at_best = np.zeros_like(self.uphill), np.ones_like(self.at_best)
        return settled

    def _climb_or_descend(
        self, there: Linearisation[Point], lower: np.ndarray, over: np.ndarray
    ) -> np.ndarray:
        """Go on from lower costs, follow higher ones or go back; say where the noise has settled, and what is over."""
        small = (self.decrement <= SHORTEST_STEP**2) | (self.decrement <= 1e-10 * _array(self.best.cost))
        over[~lower & (self.damping > LARGEST_DAMPING)] = SolutionStatus.STALLED
        over[~lower & self.at_best & small] = SolutionStatus.CONVERGED
        over[~lower & _array(self.best.misfit <= 1e4 * self.best.rounding)] = SolutionStatus.EXACT
        # there is no descent such as where a loss rejects every row
        going = np.isfinite(_array(there.cost)) & _array(there.descent.any(-1))
        climbing = ~lower & (over == None) & (self.uphill < PATIENCE) & going  # noqa: E711 - of every entry
        there, settled = self._renewed(there, climbing | (lower & (self.iterations <= SWINGING)))
        self.best = _where(lower, there, self.best)
        self.here = _where(climbing, there, self.best)
        back = np.where(climbing, self.damping, np.maximum(100 * self.damping, 0.1))
        self.damping = np.where(lower, np.maximum(self.damping / 10, SMALLEST_DAMPING), back)
        self.uphill, self.at_best = np.where(climbing, self.uphill + 1, 0), ~climbing
        return settled

    def end(self, ended: np.ndarray, status: SolutionStatus | np.ndarray) -> None:
        """End some of the searches, all by one status or each by its own, and go on with the others."""
        if not ended.any():
            return
        reasons = np.broadcast_to(np.array(status, dtype=object), len(ended))
        for robot, reason in zip(self.robots[ended], reasons[ended], strict=True):
            self.ends[robot] = replace(self.ends[robot], iterations=self.iterations, status=reason)
        numbers, left = torch.from_numpy(np.flatnonzero(ended)), torch.from_numpy(np.flatnonzero(~ended))
        best = of_robots(self.best, numbers) if len(left) else self.best
        self.ended.append((best, torch.from_numpy(self.robots[ended])))
        self.robots = self.robots[~ended]
        if len(left):
            self.problem, same = self.problem.of_robots(left), self.here is self.best
            self.best, self.step = of_robots((self.best, self.step), left)
            self.here = self.best if same else of_robots(self.here, left)
            for name in ("at_best", "uphill", "damping", "decrement"):
                setattr(self, name, getattr(self, name)[~ended])

    def _renewed(
        self, there: Linearisation[Point], chosen: np.ndarray
    ) -> tuple[Linearisation[Point], np.ndarray]:
        """Renew the noise of the chosen, and say where it has settled; that of the others stays as it is."""
        settled = np.ones(len(chosen), dtype=bool)
        if chosen.all():
            renewed, now = self.problem.renewed(there)
        elif chosen.any():
            robots = torch.from_numpy(np.flatnonzero(chosen))
            renewed, now = self.problem.of_robots(robots).renewed(of_robots(there, robots))
            renewed = with_robots(there, robots, renewed)
        else:
            return there, settled
        settled[chosen] = _array(now)
        return renewed, settled

    def _rms(self) -> list[float]:
        """Size of the residuals at the best points."""
        sizes: list[float] = _array(self.problem.rms(self.best)).tolist()
        return sizes


def _array(values: Tensor) -> np.ndarray:
    """One entry for each search."""
    array: np.ndarray = values.reshape(-1).cpu().numpy()
    return array


def _product(
    matrix: Float[Tensor, "*robots rows columns"], vector: Float[Tensor, "*robots columns"]
) -> Tensor:
    return (matrix @ vector[..., None])[..., 0]


def _where(
    chosen: np.ndarray, these: Linearisation[Point], those: Linearisation[Point]
) -> Linearisation[Point]:
    """Return these linearisations for the chosen robots, and those for all others."""
    if chosen.all():
        return these
    if not chosen.any():
        return those
    robots = torch.from_numpy(np.flatnonzero(chosen))
    return with_robots(those, robots, of_robots(these, robots))


def solve_damped(
    linearisation: Linearisation[Point],
    step_scale: Float[Tensor, " unknowns"],
    damping: Float[Tensor, "*robots"],
) -> Float[Tensor, "*robots unknowns"]:
    """Solve `(normal + damping / step_scale²) step = descent` by Cholesky with column scaling.

    Raises:
        IdentificationError: they are not finite.
    """
    normal, descent = linearisation.normal, linearisation.descent
    diagonal = normal.diagonal(dim1=-2, dim2=-1)
    # a product of two columns is finite where their squares are
    if not math.isfinite(float((diagonal + descent).sum())):
        raise IdentificationError(
            "the normal equations are not finite; look for huge values, or standard deviations of next to nothing, in "
            "the measurements."
        )
    while True:
        damped = torch.addcdiv(diagonal, damping[..., None], step_scale.square())
        scale = damped.rsqrt()
        scaled = normal * (scale[..., None, :] * scale[..., None])
        scaled.diagonal(dim1=-2, dim2=-1).copy_(damped * scale.square() + 1e-14)
        factor, failed = torch.linalg.cholesky_ex(scaled)
        if not bool(failed.any()):
            solved = torch.cholesky_solve((scale * descent)[..., None], factor)[..., 0]
            return scale * solved
        damping = torch.where(failed > 0, (10 * damping).clamp(min=1e-6), damping)


def covariance_of(
    normal: Float64[Tensor, "*robots active active"],
) -> Float64[Tensor, "*robots active active"]:
    """Invert a normal matrix, with column scaling; directions that it does not hold get no variance."""
    diagonal = normal.diagonal(dim1=-2, dim2=-1)
    scale = diagonal.masked_fill(diagonal <= 0, 1.0).rsqrt_()
    scales = scale[..., None, :] * scale[..., None]
    scaled = normal * scales
    factor, failed = torch.linalg.cholesky_ex(scaled)
    clear = (factor.diagonal(dim1=-2, dim2=-1) > 1e-6).all(-1)
    if bool(clear.all()) and not bool(failed.any()):
        return torch.cholesky_inverse(factor).mul_(scales)
    clear &= failed == 0
    inverse = torch.linalg.pinv(scaled, rtol=1e-12, hermitian=True)
    if bool(clear.any()):
        inverse[clear] = torch.cholesky_inverse(factor[clear])
    covariance: Tensor = inverse * scales
    return covariance
