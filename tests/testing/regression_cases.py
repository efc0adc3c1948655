"""Linearised rows of all kinds with features, prior and noise, for tests of the hybrid's regressions."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from testing.dense_regression import DenseRegression
from testing.linearised import LinearisedArm, linearised, random_joints, tracker_data
from testing.sensors import mixed_data, true_robot
from torch import Tensor

from pisigma.calibration.hybrid.design import Design, LinearisedRows
from pisigma.estimation.held_out import HeldOutErrors
from pisigma.estimation.prior import GaussianPrior
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.input_products import InputProducts
from pisigma.joint_correction.shared_features import ScaledJoints
from pisigma.robot import Robot


@dataclass(frozen=True, eq=False)
class RegressionCase:
    """Inputs of a regression.

    Attributes:
        design: all unknowns.
        smaller: a subset of the features, one of which may be smaller.
        rows: linearised rows.
        prior: prior of the unknowns.
        noise: noise per sensor.
        exactness: tolerance of the other forms against the dense solution, in standard deviations of the unknowns;
            larger where a sensor is nearly certain.
    """

    design: Design
    smaller: tuple[AbstractFeature, ...]
    rows: LinearisedRows
    prior: GaussianPrior
    noise: tuple[float, ...]
    exactness: float

    @functools.cached_property
    def dense(self) -> DenseRegression:
        """The regression with all columns in one matrix."""
        return DenseRegression.from_rows(self.design, self.rows)

    @functools.cached_property
    def folds(self) -> tuple[Tensor, ...]:
        """Folds of one group each: large groups, such as of a placement of sockets or an anchor, and some others."""
        large = torch.bincount(self.rows.group) > 4
        others = torch.arange(self.rows.groups)[~large][:: max(self.rows.groups // 8, 1)]
        return tuple(torch.cat([large.nonzero()[:, 0], others])[:, None])

    @functools.cached_property
    def refitted(self) -> HeldOutErrors:
        """Values of the folds, predicted without them."""
        return self.dense.held_out_errors(self.dense.solve(self.prior, self.noise), self.folds)


def case_of(
    arm: LinearisedArm,
    features: tuple[AbstractFeature, ...],
    smaller: tuple[AbstractFeature, ...],
    exactness: float = 1e-6,
) -> RegressionCase:
    """Return a case with different prior scales of the groups."""
    design = Design(arm.rows.problem, features)
    prior = design.prior(arm.prior_scale)
    factor = torch.linspace(0.5, 3.0, len(prior.group_scales), dtype=torch.float64)
    return RegressionCase(
        design,
        smaller,
        arm.rows,
        replace(prior, group_scales=prior.group_scales * factor),
        arm.noise,
        exactness,
    )


@functools.cache
def poses() -> RegressionCase:
    """Return positions and rotations of an arm with a prismatic joint, with weights and unused columns."""
    robot = Robot.load("kiro3")
    q = random_joints(robot, 30, 0)
    arm = linearised(robot, tracker_data(robot, q, 1e-4 * (3 * q).sin(), 1e-5, turn_noise=1e-5, several=True))
    weight = torch.linspace(0.5, 2.0, 30, dtype=torch.float64)
    values = tuple(sensor.apply_weights(weight) for sensor in arm.rows.values)
    features = (ScaledJoints(robot), GravityTorques(robot), FourierSeries(robot, 3))
    smaller = (features[1], FourierSeries(robot, 2))
    return case_of(replace(arm, rows=replace(arm.rows, values=values)), features, smaller)


@functools.cache
def several_targets() -> RegressionCase:
    """Return two targets per configuration, with similar residuals."""
    robot = Robot.load("rb5")
    q = random_joints(robot, 25, 2).repeat_interleave(4, 0)
    arm = linearised(robot, tracker_data(robot, q, 3e-4 * (3 * q).sin(), 1e-5, several=True))
    return case_of(arm, (GravityTorques(robot), FourierSeries(robot, 2)), (FourierSeries(robot, 2),))


@functools.cache
def all_kinds() -> RegressionCase:
    """Return all kinds of sensors, both sides of pairs, and one certain distance of sockets."""
    robot, data = true_robot().nominal, mixed_data()
    off = 3e-5 * torch.randn(data.q.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    known = {("plate/0", "plate/1"): 0.05}
    arm = linearised(robot, replace(data, q=data.q + off), socket_distances=known)
    features = (GravityTorques(robot), FourierSeries(robot, 2))
    return case_of(arm, features, (FourierSeries(robot, 1),), exactness=1e-3)


@functools.cache
def few_values() -> RegressionCase:
    """Return far fewer values than unknowns, including products."""
    robot = Robot.load("rb5")
    q = random_joints(robot, 20, 1)
    arm = linearised(robot, tracker_data(robot, q, 2e-4 * q.sin(), 3e-5))
    features = (GravityTorques(robot), FourierSeries(robot, 4), InputProducts(robot))
    return case_of(arm, features, (features[0], FourierSeries(robot, 3)))


CASES: dict[str, Callable[[], RegressionCase]] = {
    "poses": poses,
    "several targets": several_targets,
    "all kinds": all_kinds,
    "few values": few_values,
}
