"""What robots of one type have in common: means and covariances of their errors, by empirical Bayes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64
from scipy.stats import chi2
from torch import Tensor

from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.hybrid.arm import HybridArm, JointCoverage
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.files.errors import FleetError
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.lifetime.recalibration.adaptation import adapt
from pisigma.lifetime.recalibration.recalibration_problem import ELSEWHERE, owners_in, recalibration_problem
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, Provenance
from pisigma.model.geometric_model import branches_of
from pisigma.model.model_posterior import FLEET_PRIOR, ModelPosterior
from pisigma.model.stored_starts import spread_rows
from pisigma.planning.knowledge import Instrument, Knowledge
from pisigma.robot.description import Robot

FEWEST_ROBOTS = 5
"""Below, scatter between robots cannot be told from what each is uncertain by."""
LINEARISATIONS = 2
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
class RobotEvidence:
    """What the rows of one robot say of the unknowns of its arm, base and tool integrated out.

    Attributes:
        normal: information on the unknowns.
        descent: its product with their most likely values.
        noise: per sensor, see `Adaptation.noise`.
    """

    normal: Float64[Tensor, "unknowns unknowns"]
    descent: Float64[Tensor, " unknowns"]
    noise: Mapping[str, float]


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

    def surprise(self, robot: RobotEvidence) -> tuple[float, int]:
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

    def log_evidence(self, robot: RobotEvidence) -> float:
        """Logarithm of the probability of a robot's rows, up to a constant of the robot."""
        root = torch.linalg.cholesky(self.covariance)
        factor = torch.linalg.cholesky(torch.eye(len(root)).to(root) + root.t() @ robot.normal @ root)
        at_mean = robot.normal @ self.mean
        right = torch.linalg.solve_triangular(
            factor, root.t() @ (robot.descent - at_mean)[:, None], upper=False
        )
        exponent = right.square().sum() / 2 + self.mean @ (robot.descent - at_mean / 2)
        return float(exponent - factor.diagonal().log().sum())


@dataclass(frozen=True, eq=False)
class FleetPrior:
    """What a fleet has in common.

    Attributes:
        model: the mean robot, as uncertain as another robot of the fleet.
        population: the scatter between robots.
        names: of the geometric parameters.
        odd: numbers of the robots that are unlike the others and did not count.
    """

    model: CalibratedModel
    population: Population
    names: tuple[str, ...]
    odd: tuple[int, ...]


def fleet_prior(name: str, robot: Robot, fleet: Sequence[Measurements]) -> FleetPrior:
    """Estimate what the robots of a fleet have in common.

    Every robot has errors `u ~ N(μ, Σ)` and rows that are linear in them. The expectation-maximisation of Dempster,
    Laird and Rubin 1977 (J. Royal Statistical Society B 39(1), 1-38) finds μ and Σ, so that each robot counts by what
    its rows determine; the usual errors of the robot's class count a little, see `CLASS_ROBOTS`. Robots whose rows the
    others make too improbable are left out, and the rest is estimated anew.

    Args:
        name: of the fleet.
        robot: as drawn, the same for all.
        fleet: rows of each robot.

    Raises:
        FleetError: there are too few robots.
        IdentificationError: the rows of a robot do not determine where it stands.
    """
    if len(fleet) < FEWEST_ROBOTS:
        raise FleetError(
            f"{FEWEST_ROBOTS} robots or more of one type were wanted to estimate what they have in common, got "
            f"{len(fleet)}."
        )
    knowledge = Knowledge.of_robot(robot)
    space = knowledge.uncertainty.space
    first = population = class_population(robot)
    usual = first.covariance.diagonal()
    noise: Mapping[str, float] = {"position": Instrument().sigma}
    odd: tuple[int, ...] = ()
    for _ in range(LINEARISATIONS):
        model = mean_robot(name, knowledge, population, fleet, noise)
        evidence = [evidence_of(model, population.mean, rows) for rows in fleet]
        population, odd = without_odd(evidence, first, usual)
        noise = _medians([one.noise for one in evidence])
    model = mean_robot(name, knowledge, population.of_another(len(fleet) - len(odd)), fleet, noise)
    return FleetPrior(model, population, space.names[: space.arm_size], odd)


def class_population(robot: Robot) -> Population:
    """Give the robots of the class of a robot, see `pisigma.robot.robot_class`."""
    uncertainty = Knowledge.of_robot(robot).uncertainty
    usual = of_arm(uncertainty.root, uncertainty.space).square().sum(1)
    return Population(torch.zeros_like(usual), usual.diag(), uncertainty.space.arm_size)


def of_arm(
    root: Float64[Tensor, "unknowns directions"], space: ParameterSpace
) -> Float64[Tensor, "arm directions"]:
    """Select the rows of geometric parameters and of weights, without those of base, tool and sensors."""
    return torch.cat([root[: space.arm_size], root[len(space.parameters) :]])


def mean_robot(
    name: str,
    knowledge: Knowledge,
    population: Population,
    fleet: Sequence[Measurements],
    noise: Mapping[str, float],
) -> CalibratedModel:
    """Give the mean robot of a population, which is uncertain by the scatter between robots.

    Args:
        name: of the model.
        knowledge: of the robot as drawn, with the unknowns of the population.
        population: errors of the robots.
        fleet: rows of robots, which say where they were measured.
        noise: per sensor, see `Adaptation.noise`.
    """
    usual, size = knowledge.uncertainty, population.geometric
    space, drawn = usual.space, usual.space.robot
    dh = drawn.dh + population.mean[:size].numpy().reshape(drawn.dh.shape)
    mean = drawn.with_geometry(dh=dh)
    correction = _correction(drawn, usual.features, population.mean[size:])
    q = torch.cat([rows.q.cpu() for rows in fleet])
    starts = spread_rows(torch.unique(q, dim=0))
    root = torch.zeros(len(usual.root), len(population.mean), dtype=torch.float64)
    factor = torch.linalg.cholesky(population.covariance)
    root[: space.arm_size], root[len(space.parameters) :] = factor[:size], factor[size:]
    frames = {"": np.array(drawn.base)}, {"": np.array(drawn.tool)}
    return CalibratedModel(
        name=name,
        kind=FLEET_PRIOR,
        robot=drawn,
        network=None,
        domain=None,
        branches=branches_of(drawn, starts),
        starts=starts,
        calibrated=mean,
        bases=frames[0],
        tools=frames[1],
        hybrid=HybridArm(mean, correction, JointCoverage.of(drawn, q)),
        hybrid_bases=frames[0],
        hybrid_tools=frames[1],
        uncertainty=PositionUncertainty(
            space,
            IdentifiedGeometry(mean, *frames, {}),
            usual.features,
            CovarianceRoot(root),
            1.0,
            noise,
        ),
        provenance=Provenance(
            data_source=f"{len(fleet)} robots",
            rows=sum(rows.rows for rows in fleet),
            versions=Provenance.present_versions(),
        ),
    )


def _correction(
    robot: Robot, features: tuple[AbstractFeature, ...], weights: Float64[Tensor, " weights"]
) -> JointCorrection:
    """The joint correction with some weights, of the used columns of all features."""
    correction, start = JointCorrection(robot, list(features), ()), 0
    with torch.no_grad():
        for parameter, feature in zip(correction.linear, features, strict=True):
            count = int(feature.used.sum())
            values = weights[start : start + count]
            parameter.copy_(torch.zeros(feature.used.shape).to(weights).masked_scatter(feature.used, values))
            start += count
    correction.requires_grad_(False)
    return correction


def evidence_of(
    model: CalibratedModel, mean: Float64[Tensor, " unknowns"], rows: Measurements
) -> RobotEvidence:
    """Say what the rows of a robot say, linearised at its most probable errors; the mean is that of the model."""
    posterior = ModelPosterior.of(model)
    rows = posterior.renamed(rows)
    problem = recalibration_problem(model, posterior, rows, owners_in(rows, ("base", "tool")))
    problem = replace(problem, groups=tuple(group for group in problem.groups if group.stands))
    adaptation = adapt(problem, posterior.noise)
    values, space = adaptation.values, problem.design.problem.space
    deviation = values.deviation(adaptation.drift.noise)
    X, y = values.X / deviation[:, None], values.y / deviation
    others = X[:, space.arm_size : len(space.parameters)]
    kept = torch.cat([X[:, : space.arm_size], X[:, len(space.parameters) :]], 1)
    inner = others.t() @ others
    inner.diagonal().add_(ELSEWHERE["m"] ** -2)
    taken = torch.linalg.solve(inner, others.t() @ torch.cat([kept, y[:, None]], 1))
    normal = kept.t() @ kept - kept.t() @ others @ taken[:, :-1]
    descent = kept.t() @ y - kept.t() @ others @ taken[:, -1]
    normal = (normal + normal.t()) / 2
    return RobotEvidence(normal, descent + normal @ mean, adaptation.noise)


def without_odd(
    evidence: Sequence[RobotEvidence], start: Population, usual: Float64[Tensor, " unknowns"]
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


def _nearest_to_median(evidence: Sequence[RobotEvidence], start: Population) -> list[int]:
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
    evidence: Sequence[RobotEvidence],
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
    evidence: Sequence[RobotEvidence], now: Population, of_class: Float64[Tensor, " unknowns"], robots: float
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


def _medians(noises: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Median noise per sensor."""
    names = dict.fromkeys(name for noise in noises for name in noise)
    values = {name: sorted(noise[name] for noise in noises if name in noise) for name in names}
    return {name: those[len(those) // 2] for name, those in values.items()}
