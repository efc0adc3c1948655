"""Normal populations: what their members have in common, by empirical Bayes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from scipy.stats import chi2
from torch import Tensor

FEWEST_ROBOTS = 5
"""Below, scatter between robots cannot be told from what each is uncertain by."""
EM_STEPS = 60
SEARCH_STEPS = 25
"""So few do while odd robots are searched for."""
CLASS_ROBOTS = 0.02
"""The class of the robot counts like so many robots in the variances of the fleet: hardly, as robots of one type are
more alike, and only so much that what no rows determine stays as uncertain as in the class."""
SEARCH_CLASS_ROBOTS = 0.2
"""The same while odd robots are searched for: a fleet that a few robots make too narrow calls the others odd."""
ROBOTS_AT_ONCE = 100
"""Inverses of so many robots are kept at a time, 40 MB."""
CONCENTRATIONS = 10
ODD = 1e-3
"""Probability that any robot of a fleet without odd ones is called odd."""


@dataclass(frozen=True, eq=False)
class Information:
    """What the values of one robot say of its unknowns.

    Attributes:
        normal: information on the unknowns.
        descent: its product with their most likely values.
    """

    normal: Float64[Tensor, "unknowns unknowns"]
    descent: Float64[Tensor, " unknowns"]


@dataclass(frozen=True, eq=False)
class Population:
    """Normal errors of the robots of a fleet.

    Attributes:
        mean: of the unknowns [m or rad].
        covariance: between robots: of geometric parameters in full, of the weights of the correction each by itself.
        geometric: number of geometric parameters, which come first.
    """

    mean: Float64[Tensor, " unknowns"]
    covariance: Float64[Tensor, "unknowns unknowns"]
    geometric: int

    def of_another(self, robots: int) -> "Population":
        """Give what is known of a robot besides those that the population was estimated from.

        With n of them the mean scatters by `Σ / n`, and the estimate of Σ is too small by `(n - 1) / n`: together
        `(n + 1) / (n - 1)`.

        Args:
            robots: how many there were.
        """
        return replace(self, covariance=(robots + 1) / (robots - 1) * self.covariance)

    def surprise(self, robot: Information) -> tuple[float, int]:
        """How far a robot is from the fleet: a sum of squares that is chi-squared for a robot of it, and of how many.

        In the coordinates in which the covariance is the identity and the information diagonal, `λ`, the descent minus
        what the mean lets expect has the variance `λ + λ²`.
        """
        root = torch.linalg.cholesky(self.covariance)
        information, axes = torch.linalg.eigh(root.t() @ robot.normal @ root)
        identified = information > 0.1
        along = axes.t() @ (root.t() @ (robot.descent - robot.normal @ self.mean))
        squares = along.square() / (information + information.square())
        return float(squares[identified].sum()), int(identified.sum())

    def log_evidence(self, robot: Information) -> float:
        """Logarithm of the probability of a robot's rows, up to a constant of the robot."""
        root = torch.linalg.cholesky(self.covariance)
        factor = torch.linalg.cholesky(torch.eye(len(root)).to(root) + root.t() @ robot.normal @ root)
        at_mean = robot.normal @ self.mean
        right = torch.linalg.solve_triangular(
            factor, root.t() @ (robot.descent - at_mean)[:, None], upper=False
        )
        exponent = right.square().sum() / 2 + self.mean @ (robot.descent - at_mean / 2)
        return float(exponent - factor.diagonal().log().sum())


def without_odd(
    evidence: Sequence[Information], start: Population, usual: Float64[Tensor, " unknowns"]
) -> tuple[Population, tuple[int, ...]]:
    """Estimate the population of the robots that are alike, and give the numbers of the others.

    It begins with the half that is nearest to the median robot, which several odd ones that are alike do not stretch to
    themselves, and takes in whatever is not odd beside those, until that no longer changes: concentration steps of
    Rousseeuw and Van Driessen 1999 (Technometrics 41(3), 212-223). Half of the robots scatter less than all, so
    distances count in units of the median robot's where that is farther than expected.

    Args:
        evidence: of the robots.
        start: a population of usual robots.
        usual: variances of the class of the robots.
    """
    alike = _nearest_to_median(evidence, start)
    population = start
    for _ in range(CONCENTRATIONS):
        chosen = [evidence[number] for number in alike]
        population = expectation_maximisation(chosen, start, usual, SEARCH_CLASS_ROBOTS, SEARCH_STEPS)
        surprises = [population.surprise(one) for one in evidence]
        ratios = sorted(square / max(count, 1) for square, count in surprises)
        unit = max(ratios[len(ratios) // 2], 1.0)
        now = [
            number
            for number, (square, count) in enumerate(surprises)
            if chi2.sf(square / unit, max(count, 1)) >= ODD / len(evidence)
        ]
        if now == alike or len(now) < FEWEST_ROBOTS:
            break
        alike = now
    population = expectation_maximisation([evidence[number] for number in alike], population, usual)
    return population, tuple(number for number in range(len(evidence)) if number not in alike)


def _nearest_to_median(evidence: Sequence[Information], start: Population) -> list[int]:
    """Numbers of the half of the robots that are nearest to the median one, in the directions that are measured."""
    precision = torch.linalg.inv(start.covariance)
    inverses = torch.linalg.inv(torch.stack([one.normal for one in evidence]) + precision)
    x = torch.einsum("rij,rj->ri", inverses, torch.stack([one.descent for one in evidence]))
    median = x.median(0).values
    scatter = (x - median).abs().median(0).values.square() + inverses.diagonal(dim1=1, dim2=2).mean(0)
    population = Population(median, scatter.diag(), start.geometric)
    distances = [square / max(count, 1) for square, count in map(population.surprise, evidence)]
    order = sorted(range(len(evidence)), key=lambda number: distances[number])
    return sorted(order[: max(FEWEST_ROBOTS, len(evidence) // 2 + 1)])


def expectation_maximisation(
    evidence: Sequence[Information],
    start: Population,
    usual: Float64[Tensor, " unknowns"],
    class_robots: float = CLASS_ROBOTS,
    steps: int = EM_STEPS,
) -> Population:
    """Mean and covariance of the robots' errors.

    Args:
        evidence: of the robots.
        start: to begin with.
        usual: variances of the class of the robots.
        class_robots: so many robots the class counts like.
        steps: how many.
    """
    population = start
    for _ in range(steps):
        population = _maximised(evidence, population, class_robots * usual, class_robots + len(evidence))
    return population


def _maximised(
    evidence: Sequence[Information], now: Population, of_class: Float64[Tensor, " unknowns"], robots: float
) -> Population:
    """One step of expectation and maximisation.

    The covariance of geometric parameters is drawn towards its diagonal, the more the fewer robots there are.

    Args:
        evidence: of the robots.
        now: the population.
        of_class: squares that the class adds to those of the robots.
        robots: how many they are together.
    """
    size, count = now.geometric, len(evidence)
    precision = torch.linalg.inv(now.covariance)
    at_mean, x, scatter = precision @ now.mean, [], torch.zeros_like(precision)
    for first in range(0, count, ROBOTS_AT_ONCE):
        some = evidence[first : first + ROBOTS_AT_ONCE]
        factors = torch.linalg.cholesky(torch.stack([one.normal for one in some]) + precision)
        inverses = torch.cholesky_inverse(factors)
        right = torch.stack([one.descent for one in some]) + at_mean
        x.append(torch.einsum("rij,rj->ri", inverses, right))
        scatter += inverses.sum(0)
    mean = torch.cat(x).mean(0)
    off = torch.cat(x) - mean
    scatter += off.t() @ off
    diagonal = (of_class + scatter.diagonal()) / robots
    covariance = diagonal.diag()
    covariance[:size, :size] = count / (count + size) * scatter[:size, :size] / robots
    covariance.diagonal().copy_(diagonal)
    return Population(mean, covariance, size)
