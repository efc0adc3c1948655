"""What robots of one type have in common, by empirical Bayes, and how like the others of its fleet one robot is."""

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
from pisigma.estimation.population import FALSE_ALARM, MIN_ROBOTS, Information, Population, without_outliers
from pisigma.files.errors import FleetError
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.lifetime.recalibration.adaptation import adapt
from pisigma.lifetime.recalibration.recalibration_problem import ELSEWHERE, frame_keys, recalibration_problem
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, Provenance
from pisigma.model.geometric_model import branches_of
from pisigma.model.model_posterior import FLEET_PRIOR, ModelPosterior
from pisigma.model.stored_starts import spread_rows
from pisigma.planning.robot_posterior import Instrument, RobotPosterior
from pisigma.robot.description import Robot

LINEARISATIONS = 2


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


@dataclass(frozen=True, eq=False)
class RobotEvidence(Information):
    """What the rows of one robot say of the unknowns of its arm, base and tool integrated out.

    Attributes:
        noise: per sensor, see `Adaptation.noise`.
    """

    noise: Mapping[str, float]


def fleet_prior(name: str, robot: Robot, fleet: Sequence[Measurements]) -> FleetPrior:
    """Estimate what the robots of a fleet have in common.

    Every robot has errors `u ~ N(μ, Σ)` and rows that are linear in them. The expectation-maximisation of Dempster,
    Laird and Rubin 1977 (J. Royal Statistical Society B 39(1), 1-38) finds μ and Σ, so that each robot counts by what
    its rows determine; the usual errors of the robot's class count a little, see
    `pisigma.estimation.population.CLASS_ROBOTS`. Robots whose rows the
    others make too improbable are left out, and the rest is estimated anew.

    Args:
        name: of the fleet.
        robot: as drawn, the same for all.
        fleet: rows of each robot.

    Raises:
        FleetError: there are too few robots.
        IdentificationError: the rows of a robot do not determine where it stands.
    """
    if len(fleet) < MIN_ROBOTS:
        raise FleetError(
            f"{MIN_ROBOTS} robots or more of one type were wanted to estimate what they have in common, got "
            f"{len(fleet)}."
        )
    posterior = RobotPosterior.of_robot(robot)
    space = posterior.uncertainty.space
    first = population = class_population(robot)
    usual = first.covariance.diagonal()
    noise: Mapping[str, float] = {"position": Instrument().sigma}
    odd: tuple[int, ...] = ()
    for _ in range(LINEARISATIONS):
        model = mean_robot(name, posterior, population, fleet, noise)
        evidence = [evidence_of(model, population.mean, rows) for rows in fleet]
        population, odd = without_outliers(evidence, first, usual)
        noise = _medians([one.noise for one in evidence])
    model = mean_robot(name, posterior, population.of_another(len(fleet) - len(odd)), fleet, noise)
    return FleetPrior(model, population, space.names[: space.arm_size], odd)


def class_population(robot: Robot) -> Population:
    """Give the robots of the class of a robot, see `pisigma.robot.robot_class`."""
    uncertainty = RobotPosterior.of_robot(robot).uncertainty
    usual = of_arm(uncertainty.root, uncertainty.space).square().sum(1)
    return Population(torch.zeros_like(usual), usual.diag(), uncertainty.space.arm_size)


def of_arm(
    root: Float64[Tensor, "unknowns directions"], space: ParameterSpace
) -> Float64[Tensor, "arm directions"]:
    """Select the rows of geometric parameters and of weights, without those of base, tool and sensors."""
    return torch.cat([root[: space.arm_size], root[len(space.parameters) :]])


def mean_robot(
    name: str,
    posterior: RobotPosterior,
    population: Population,
    fleet: Sequence[Measurements],
    noise: Mapping[str, float],
) -> CalibratedModel:
    """Give the mean robot of a population, which is uncertain by the scatter between robots.

    Args:
        name: of the model.
        posterior: of the robot as drawn, with the unknowns of the population.
        population: errors of the robots.
        fleet: rows of robots, which say where they were measured.
        noise: per sensor, see `Adaptation.noise`.
    """
    usual, size = posterior.uncertainty, population.geometric
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
    problem = recalibration_problem(model, posterior, rows, frame_keys(rows, ("base", "tool")))
    problem = replace(problem, groups=tuple(group for group in problem.groups if group.fixed_size))
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


def _medians(noises: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Median noise per sensor."""
    names = dict.fromkeys(name for noise in noises for name in noise)
    values = {name: sorted(noise[name] for noise in noises if name in noise) for name in names}
    return {name: those[len(those) // 2] for name, those in values.items()}


@dataclass(frozen=True)
class FleetConsistency:
    """How like the other robots of a fleet one is.

    Attributes:
        probability: that a robot of the fleet is as far from its mean, or farther.
        gain: log evidence of its rows as those of a robot of the fleet, minus that as those of any of its class.
    """

    probability: float
    gain: float

    @staticmethod
    def of(model: CalibratedModel, rows: Measurements) -> "FleetConsistency":
        """See how far the robot of some rows is from the mean of a fleet prior.

        Args:
            model: of the prior.
            rows: of the robot.

        Raises:
            IdentificationError: the rows do not determine where the robot stands.
        """
        posterior = ModelPosterior.of(model)
        root = of_arm(posterior.root, posterior.space)
        drawn = posterior.space.robot
        errors = torch.from_numpy(posterior.geometry.robot.dh - drawn.dh)
        mean = torch.cat([errors.flatten(), posterior.weights])
        evidence = evidence_of(model, mean, rows)
        fleet = Population(mean, root @ root.t(), posterior.space.arm_size)
        square, count = fleet.surprise(evidence)
        gain = fleet.log_evidence(evidence) - class_population(drawn).log_evidence(evidence)
        return FleetConsistency(float(chi2.sf(square, count)), gain)

    @property
    def odd(self) -> bool:
        """Whether the fleet says little of the robot: less than the usual errors of its class."""
        return self.probability < FALSE_ALARM and self.gain < 0

    @property
    def sentence(self) -> str:
        """The same in words."""
        if self.odd:
            return (
                f"This robot is unlike the fleet: fewer than 1 in {1 / FALSE_ALARM:,.0f} of its robots are as far from "
                "the mean, and the usual errors of its class explain its rows better. The fleet does not count where "
                "the rows are enough for a calibration of their own."
            )
        share = f"{100 * self.probability:.0f} %" if self.probability >= 0.01 else "fewer than 1 %"
        return f"This robot is like the fleet: {share} of its robots are as far from the mean, or farther."
