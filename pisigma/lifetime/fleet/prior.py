"""Fleet prior: distribution of the errors of robots of one type by empirical Bayes, and consistency with it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64
from scipy.stats import chi2
from torch import Tensor

from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.hybrid.arm import HybridArm, JointCoverage
from pisigma.calibration.hybrid.noise import CalibrationNoise
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.estimation.population import FALSE_ALARM, MIN_ROBOTS, Information, Population, without_outliers
from pisigma.files.errors import FleetError
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.lifetime.recalibration.adaptation import adapt
from pisigma.lifetime.recalibration.recalibration_problem import (
    RELOCATION_PRIOR,
    frame_keys,
    recalibration_problem,
)
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, Provenance
from pisigma.model.geometric_model import branches_of
from pisigma.model.model_posterior import FLEET_PRIOR, ModelPosterior
from pisigma.model.stored_starts import evenly_spaced_rows
from pisigma.planning.robot_posterior import Instrument, RobotPosterior
from pisigma.robot.description import Robot

_CLASS_SHARES = (0.0, *np.geomspace(1e-4, 10.0, 21).tolist())
"""Multiples of the covariance of the class that are compared."""
LINEARISATIONS = 2
"""Linearisations at the mean robot."""


@dataclass(frozen=True, eq=False)
class FleetPrior:
    """Distribution of the errors of a fleet.

    Attributes:
        model: mean robot, with the uncertainty that applies to a further robot of the fleet.
        population: mean and covariance of the errors between robots.
        names: names of the geometric parameters.
        inconsistent_robots: indices of robots that were not used, because they are inconsistent with the other robots.
    """

    model: CalibratedModel
    population: Population
    names: tuple[str, ...]
    inconsistent_robots: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class RobotEvidence(Information):
    """Information of a robot's rows on the unknowns of its arm, with base and tool marginalised.

    Attributes:
        noise: noise of each sensor, see `Adaptation.noise`.
    """

    noise: CalibrationNoise


def fleet_prior(name: str, robot: Robot, fleet: Sequence[Measurements]) -> FleetPrior:
    """Estimate the distribution of the errors of a fleet.

    Every robot has errors `u ~ N(μ, Σ)` and rows that are linear in them. Expectation-maximisation (Dempster, Laird and
    Rubin 1977, J. Royal Statistical Society B 39(1), 1-38) finds μ and Σ, to which each robot contributes as far as its
    rows determine its errors. The usual errors of the robot's class have a small weight, see
    `pisigma.estimation.population.CLASS_ROBOTS`. Robots whose rows are too improbable given the others are left out,
    and the estimate is repeated.

    Args:
        name: name of the fleet.
        robot: nominal robot, common to all robots.
        fleet: rows of each robot.

    Raises:
        FleetError: there are too few robots.
        IdentificationError: the rows of a robot do not determine its base and tool.
    """
    if len(fleet) < MIN_ROBOTS:
        raise FleetError(
            expected=f"{MIN_ROBOTS} robots or more of one type", value=len(fleet), option="fleet"
        )
    posterior = RobotPosterior.from_robot(robot)
    space = posterior.uncertainty.space
    first = population = robot_class_population(robot)
    usual = first.covariance.diagonal()
    noise = CalibrationNoise({"position": Instrument().sigma})
    odd: tuple[int, ...] = ()
    for _ in range(LINEARISATIONS):
        model = mean_robot(name, posterior, population, fleet, noise)
        evidence = [evidence_of(model, population.mean, rows) for rows in fleet]
        population, odd = without_outliers(evidence, first, usual)
        noise = _medians([one.noise for one in evidence])
    model = mean_robot(
        name, posterior, population.predictive_distribution(len(fleet) - len(odd)), fleet, noise
    )
    return FleetPrior(model, population, space.names[: space.arm_parameter_count], odd)


def robot_class_population(robot: Robot) -> Population:
    """Return the distribution of errors of a robot's class, see `pisigma.robot.robot_class`."""
    uncertainty = RobotPosterior.from_robot(robot).uncertainty
    usual = select_arm_rows(uncertainty.dense_root, uncertainty.space).square().sum(1)
    return Population(torch.zeros_like(usual), usual.diag(), uncertainty.space.arm_parameter_count)


def select_arm_rows(
    covariance_root: Float64[Tensor, "unknowns directions"], space: ParameterSpace
) -> Float64[Tensor, "arm directions"]:
    """Return the rows of a root for the arm's parameters and weights, without rows of base, tool and sensors."""
    return torch.cat([covariance_root[: space.arm_parameter_count], covariance_root[len(space.parameters) :]])


def mean_robot(
    name: str,
    nominal_prior: RobotPosterior,
    population: Population,
    fleet: Sequence[Measurements],
    noise: CalibrationNoise,
) -> CalibratedModel:
    """Return the mean robot of a population, with the covariance between robots as its uncertainty.

    Args:
        name: name of the model.
        nominal_prior: prior of the nominal robot, with the unknowns of the population.
        population: errors of the robots.
        fleet: rows of robots, which define the measured joint values.
        noise: noise of each sensor, see `Adaptation.noise`.
    """
    usual, size = nominal_prior.uncertainty, population.geometric_count
    space, nominal = usual.space, usual.space.robot
    dh = nominal.dh + population.mean[:size].numpy().reshape(nominal.dh.shape)
    mean = nominal.with_geometry(dh=dh)
    correction = _correction(nominal, usual.features, population.mean[size:])
    q = torch.cat([rows.q.cpu() for rows in fleet])
    starts = evenly_spaced_rows(torch.unique(q, dim=0))
    root = torch.zeros(len(usual.dense_root), len(population.mean), dtype=torch.float64)
    factor = torch.linalg.cholesky(population.covariance)
    root[: space.arm_parameter_count], root[len(space.parameters) :] = factor[:size], factor[size:]
    frames = {"": np.array(nominal.base)}, {"": np.array(nominal.tool)}
    return CalibratedModel(
        name=name,
        kind=FLEET_PRIOR,
        robot=nominal,
        network=None,
        domain=None,
        branches=branches_of(nominal, starts),
        starts=starts,
        calibrated=mean,
        bases=frames[0],
        tools=frames[1],
        hybrid=HybridArm(mean, correction, JointCoverage.from_joints(nominal, q)),
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
            versions=Provenance.installed_versions(),
        ),
    )


def _correction(
    robot: Robot, features: tuple[AbstractFeature, ...], weights: Float64[Tensor, " weights"]
) -> JointCorrection:
    """Return the joint correction with given weights of the used columns of all features."""
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
    model: CalibratedModel,
    mean: Float64[Tensor, " unknowns"],
    rows: Measurements,
    class_covariance_factor: float = 0.0,
) -> RobotEvidence:
    """Compute the information of a robot's rows, linearised at its most probable errors.

    Args:
        model: mean robot of a fleet.
        mean: mean of the unknowns [m or rad].
        rows: rows of the robot.
        class_covariance_factor: multiple of the covariance of the robot's class by which the prior is widened while
            the most probable errors, the noise and the wrong rows are found.
    """
    posterior = _widened(ModelPosterior.from_model(model), class_covariance_factor)
    rows = posterior.with_model_names(rows)
    problem = recalibration_problem(model, posterior, rows, frame_keys(rows, ("base", "tool")))
    problem = replace(problem, groups=tuple(group for group in problem.groups if group.fixed_size))
    adaptation = adapt(problem)
    values, space = adaptation.values, problem.design.problem.space
    deviation = values.sigma(adaptation.drift.noise)
    X, y = values.X / deviation[:, None], values.y / deviation
    others = X[:, space.arm_parameter_count : len(space.parameters)]
    kept = torch.cat([X[:, : space.arm_parameter_count], X[:, len(space.parameters) :]], 1)
    inner = others.t() @ others
    inner.diagonal().add_(RELOCATION_PRIOR["m"] ** -2)
    # Base, tool and sensor unknowns differ between robots, so they are eliminated (Schur complement).
    taken = torch.linalg.solve(inner, others.t() @ torch.cat([kept, y[:, None]], 1))
    normal = kept.t() @ kept - kept.t() @ others @ taken[:, :-1]
    descent = kept.t() @ y - kept.t() @ others @ taken[:, -1]
    normal = (normal + normal.t()) / 2
    # Linearised at the mean, the residuals determine the errors minus the mean, so the mean is added.
    return RobotEvidence(normal, descent + normal @ mean, adaptation.noise)


def _widened(prior: ModelPosterior, class_covariance_factor: float) -> ModelPosterior:
    """Return the prior with a multiple of the covariance of the robot's class added."""
    if not class_covariance_factor:
        return prior
    space, usual = prior.space, robot_class_population(prior.space.robot)
    deviation = (class_covariance_factor * usual.covariance.diagonal()).sqrt().diag()
    between = prior.covariance_root.new_zeros(
        (len(space.parameters) - space.arm_parameter_count, len(deviation))
    )
    arm, weights = deviation[: space.arm_parameter_count], deviation[space.arm_parameter_count :]
    added = torch.cat([arm, between, weights])
    return replace(prior, covariance_root=torch.cat([prior.covariance_root, added], 1))


def _medians(noises: Sequence[CalibrationNoise]) -> CalibrationNoise:
    """Return the median noise of each sensor, over robots whose rows state standard deviations if there are any."""
    value, stated = dict[str, float](), dict[str, float]()
    for name in dict.fromkeys(name for noise in noises for name in noise.value):
        of_sensor = [noise for noise in noises if name in noise.value]
        stating = [noise for noise in of_sensor if noise.is_factor(name)]
        value[name] = float(np.median([noise.value[name] for noise in stating or of_sensor]))
        if stating:
            stated[name] = float(
                np.median([noise.standard_deviation(name) / noise.value[name] for noise in stating])
            )
    return CalibrationNoise(value, stated)


@dataclass(frozen=True)
class FleetConsistency:
    """Consistency of a robot with the other robots of its fleet.

    Attributes:
        p_value: probability that a robot of the fleet is at least as far from its mean.
        log_evidence_gain: log evidence of its rows under the fleet prior, minus that under the prior of its class.
        class_covariance_factor: multiple of the covariance of its class which, added to that of the fleet, makes its
            rows most probable; a robot unlike the others would otherwise get the small predicted errors of the fleet.
    """

    p_value: float
    log_evidence_gain: float
    class_covariance_factor: float

    @staticmethod
    def from_rows(model: CalibratedModel, rows: Measurements) -> "FleetConsistency":
        """Compare a robot with the mean of a fleet prior.

        Args:
            model: model of the prior.
            rows: rows of the robot.

        Raises:
            IdentificationError: the rows do not determine the robot's base and tool.
        """
        posterior = ModelPosterior.from_model(model)
        root = select_arm_rows(posterior.covariance_root, posterior.space)
        nominal = posterior.space.robot
        errors = torch.from_numpy(posterior.geometry.robot.dh - nominal.dh)
        mean = torch.cat([errors.flatten(), posterior.weights])
        # Rows that a robot of the fleet cannot have may be right for a robot unlike it.
        evidence = evidence_of(model, mean, rows, class_covariance_factor=_CLASS_SHARES[-1])
        fleet = Population(mean, root @ root.t(), posterior.space.arm_parameter_count)
        square, count = fleet.squared_distance(evidence)
        usual = robot_class_population(nominal)
        evidences = [
            replace(fleet, covariance=fleet.covariance + share * usual.covariance).log_evidence(evidence)
            for share in _CLASS_SHARES
        ]
        gain = evidences[0] - usual.log_evidence(evidence)
        best = _CLASS_SHARES[int(np.argmax(evidences))]
        return FleetConsistency(float(chi2.sf(square, count)), gain, best)

    def widened(self, prior: ModelPosterior) -> ModelPosterior:
        """Return the prior with this multiple of the covariance of the robot's class added."""
        return _widened(prior, self.class_covariance_factor)

    @property
    def is_inconsistent(self) -> bool:
        """Whether the robot is inconsistent with the fleet, and the robot's class explains the rows better."""
        return self.p_value < FALSE_ALARM and self.log_evidence_gain < 0

    @property
    def sentence(self) -> str:
        """Sentence with the result of the comparison."""
        if self.is_inconsistent:
            return (
                f"This robot is inconsistent with the fleet: fewer than 1 in {1 / FALSE_ALARM:,.0f} robots of the "
                "fleet are this far from the mean, and the usual errors of the robot's class explain the rows better. "
                "The fleet prior is not used if the rows suffice for a calibration without it."
            )
        share = f"{100 * self.p_value:.0f} %" if self.p_value >= 0.01 else "fewer than 1 %"
        return f"This robot is consistent with the fleet: {share} of its robots are at least this far from the mean."
