"""Normal populations of robots, estimated by empirical Bayes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from scipy.stats import chi2
from torch import Tensor

MIN_ROBOTS = 5
"""Minimum number of robots of a fleet; with fewer, their scatter cannot be distinguished from their uncertainties."""
_EM_STEPS = 60
_SEARCH_STEPS = 25
"""Number of expectation-maximisation steps during the search for outliers, in which they need not converge."""
_CLASS_ROBOTS = 0.02
"""Weight of the robot class in the variances of the fleet, as a number of robots. It is small, because robots of one
type are more alike, but large enough for unknowns that no rows determine to be as uncertain as in the class."""
_SEARCH_CLASS_ROBOTS = 0.2
"""Weight of the robot class, as a number of robots, during the search for outliers. It is larger, because all other
robots would be outliers if a few robots made the fleet too narrow."""
_ROBOTS_PER_CHUNK = 100
"""Number of robots whose inverse matrices are kept at a time (40 MB)."""
_MAX_CONCENTRATIONS = 10
FALSE_ALARM = 1e-3
"""Probability that any robot of a fleet without outliers is classified as one."""


@dataclass(frozen=True, eq=False)
class Information:
    """Information of the measured values of one robot on its unknowns.

    Attributes:
        normal: information matrix (normal matrix) of the unknowns.
        descent: product of the information matrix and the most likely values, the right-hand side of the normal
            equations.
    """

    normal: Float64[Tensor, "unknowns unknowns"]
    descent: Float64[Tensor, " unknowns"]


@dataclass(frozen=True, eq=False)
class Population:
    """Normal distribution of the errors of the robots of a fleet.

    Attributes:
        mean: mean of the unknowns [m or rad].
        covariance: covariance between robots; full for geometric parameters, diagonal for weights of the correction.
        geometric_count: number of geometric parameters, which come first.
    """

    mean: Float64[Tensor, " unknowns"]
    covariance: Float64[Tensor, "unknowns unknowns"]
    geometric_count: int

    def predictive_distribution(self, robots: int) -> "Population":
        """Return the predictive distribution of a robot that was not used for the estimate.

        With n robots, the mean has the covariance `Σ / n`, and the estimate of Σ is biased by `(n - 1) / n`; together,
        they give a factor of `(n + 1) / (n - 1)`.

        Args:
            robots: number of robots from which the population was estimated.
        """
        return replace(self, covariance=(robots + 1) / (robots - 1) * self.covariance)

    def squared_distance(self, robot: Information) -> tuple[float, int]:
        """Return a robot's squared distance from the fleet, chi-squared for robots of the fleet, and its freedom.

        In coordinates in which the covariance is the identity and the information is diagonal with entries λ, the
        right-hand side of the normal equations minus its expectation for the mean has the variance `λ + λ²`.
        """
        root = torch.linalg.cholesky(self.covariance)
        information, axes = torch.linalg.eigh(root.t() @ robot.normal @ root)
        # Directions that the rows of this robot hardly determine say nothing about it.
        identified = information > 0.1
        along = axes.t() @ (root.t() @ (robot.descent - robot.normal @ self.mean))
        squares = along.square() / (information + information.square())
        return float(squares[identified].sum()), int(identified.sum())

    def log_evidence(self, robot: Information) -> float:
        """Return the log probability of a robot's rows, up to a constant that depends only on the robot."""
        root = torch.linalg.cholesky(self.covariance)
        # In units of the population, prior and information add up without inverting the covariance.
        factor = torch.linalg.cholesky(torch.eye(len(root)).to(root) + root.t() @ robot.normal @ root)
        at_mean = robot.normal @ self.mean
        right = torch.linalg.solve_triangular(
            factor, root.t() @ (robot.descent - at_mean)[:, None], upper=False
        )
        exponent = right.square().sum() / 2 + self.mean @ (robot.descent - at_mean / 2)
        return float(exponent - factor.diagonal().log().sum())


def without_outliers(
    evidence: Sequence[Information], start: Population, class_variances: Float64[Tensor, " unknowns"]
) -> tuple[Population, tuple[int, ...]]:
    """Estimate the population of the robots without outliers, and return the indices of the outliers.

    The search starts with the half of the robots nearest to the median, which a group of similar outliers cannot
    attract, and adds all robots that are not outliers relative to them until the set no longer changes: concentration
    steps of Rousseeuw and Van Driessen 1999 (Technometrics 41(3), 212-223). Because half of the robots scatter less
    than all, distances are divided by that of the median robot if it is larger than expected.

    Args:
        evidence: information on every robot.
        start: population of typical robots, as a starting point.
        class_variances: variances of the robot class.
    """
    alike = _nearest_to_median(evidence, start)
    population = start
    for _ in range(_MAX_CONCENTRATIONS):
        chosen = [evidence[number] for number in alike]
        population = expectation_maximisation(
            chosen, start, class_variances, _SEARCH_CLASS_ROBOTS, _SEARCH_STEPS
        )
        surprises = [population.squared_distance(one) for one in evidence]
        ratios = sorted(square / max(count, 1) for square, count in surprises)
        # The chosen half scatters less than all robots, so the median robot sets the unit.
        unit = max(ratios[len(ratios) // 2], 1.0)
        now = [
            number
            for number, (square, count) in enumerate(surprises)
            if chi2.sf(square / unit, max(count, 1)) >= FALSE_ALARM / len(evidence)
        ]
        if now == alike or len(now) < MIN_ROBOTS:
            break
        alike = now
    population = expectation_maximisation([evidence[number] for number in alike], population, class_variances)
    return population, tuple(number for number in range(len(evidence)) if number not in alike)


def _nearest_to_median(evidence: Sequence[Information], start: Population) -> list[int]:
    """Return the indices of the half of the robots nearest to the median robot, in measured directions."""
    precision = torch.linalg.inv(start.covariance)
    inverses = torch.linalg.inv(torch.stack([one.normal for one in evidence]) + precision)
    x = torch.einsum("rij,rj->ri", inverses, torch.stack([one.descent for one in evidence]))
    median = x.median(0).values
    # The scatter is the median deviation, which outliers do not change, plus the uncertainty that the rows leave.
    scatter = (x - median).abs().median(0).values.square() + inverses.diagonal(dim1=1, dim2=2).mean(0)
    population = Population(median, scatter.diag(), start.geometric_count)
    distances = [square / max(count, 1) for square, count in map(population.squared_distance, evidence)]
    order = sorted(range(len(evidence)), key=lambda number: distances[number])
    return sorted(order[: max(MIN_ROBOTS, len(evidence) // 2 + 1)])


def expectation_maximisation(
    evidence: Sequence[Information],
    start: Population,
    class_variances: Float64[Tensor, " unknowns"],
    class_weight_in_robots: float = _CLASS_ROBOTS,
    steps: int = _EM_STEPS,
) -> Population:
    """Estimate mean and covariance of the robots' errors by expectation-maximisation.

    Args:
        evidence: information on every robot.
        start: initial population.
        class_variances: variances of the robot class.
        class_weight_in_robots: weight of the class, in robots.
        steps: number of steps.
    """
    population = start
    for _ in range(steps):
        population = _maximised(
            evidence,
            population,
            class_weight_in_robots * class_variances,
            class_weight_in_robots + len(evidence),
        )
    return population


def _maximised(
    evidence: Sequence[Information], now: Population, of_class: Float64[Tensor, " unknowns"], robots: float
) -> Population:
    """Compute one step of expectation-maximisation.

    The covariance of geometric parameters is shrunk towards its diagonal, more strongly for fewer robots.

    Args:
        evidence: information on every robot.
        now: current population.
        of_class: sums of squares that the robot class contributes.
        robots: number of robots including the weight of the class.
    """
    size, count = now.geometric_count, len(evidence)
    precision = torch.linalg.inv(now.covariance)
    at_mean, x, scatter = precision @ now.mean, [], torch.zeros_like(precision)
    for first in range(0, count, _ROBOTS_PER_CHUNK):
        # Expectation: posterior mean and covariance of every robot under the current population.
        some = evidence[first : first + _ROBOTS_PER_CHUNK]
        factors = torch.linalg.cholesky(torch.stack([one.normal for one in some]) + precision)
        inverses = torch.cholesky_inverse(factors)
        right = torch.stack([one.descent for one in some]) + at_mean
        x.append(torch.einsum("rij,rj->ri", inverses, right))
        scatter += inverses.sum(0)
    # Maximisation: scatter of the posterior means, plus their covariances summed above.
    mean = torch.cat(x).mean(0)
    off = torch.cat(x) - mean
    scatter += off.t() @ off
    diagonal = (of_class + scatter.diagonal()) / robots
    covariance = diagonal.diag()
    # A full covariance needs more robots than parameters, so correlations are shrunk.
    covariance[:size, :size] = count / (count + size) * scatter[:size, :size] / robots
    covariance.diagonal().copy_(diagonal)
    return Population(mean, covariance, size)
