"""Standard deviations of predicted positions, from the posterior of parameters and weights."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.hybrid.abstract_regression import AbstractRegression
from pisigma.calibration.hybrid.covariance_root import CovarianceRoot
from pisigma.calibration.hybrid.design import FOLDS, FOLDS_OF_FEW, MOST_GROUPS, Design, Rows
from pisigma.calibration.hybrid.evidence import LeftOut, Posterior
from pisigma.calibration.hybrid.sensor_values import joint_columns, weight_columns
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.sensor import numbers_of
from pisigma.robot.kinematics.parameter_jacobian import identification_jacobian

CHUNK = 128
"""Rows whose columns are in memory at a time."""
FEW_GROUPS = 600
"""Up to so many, noise and prior sizes are estimated anew for every fold that is left out."""
VERY_FEW_GROUPS = 60
"""Up to so many, `FOLDS_OF_FEW` folds are left out: without a quarter of so few rows a calibration is much worse than
with all of them, so that its errors say little of theirs."""
FOLD_UPDATES, FEWER_UPDATES, SOME_GROUPS = 3, 1, 150
"""Updates of noise and prior sizes then, and of more than so many groups: with one update 0.9 % fewer of 30 rows lie in
the predicted 95 %, 0.4 % of 100 rows and 0.3 % of 300 rows; a fit of these takes four fifths of the time with it."""
LEAST_EFFECTIVE = 0.5
"""Prior sizes of groups of which the data determine fewer unknowns do not matter."""
LARGEST_SCALE = 1e4
"""Largest factor on variances."""


@dataclass(frozen=True, eq=False)
class PositionUncertainty:
    """Standard deviations of positions: `sqrt(x C x^T)` with x the derivative of a coordinate by all unknowns.

    Attributes:
        space: the parameters.
        geometry: where the derivative is taken.
        features: what the weights belong to.
        covariance_root: `R` with `C = R R^T`, of all parameters of the space (0 for those that were not free) and then
            all weights, scaled so that left-out rows are missed by as much as it says.
        prior_scale: factor on the variances that this took.
        noise: per sensor, its standard deviation [m or rad], or a factor where the rows state it; empty in folders from
            before it was kept.
    """

    space: ParameterSpace
    geometry: IdentifiedGeometry
    features: tuple[AbstractFeature, ...]
    covariance_root: CovarianceRoot
    prior_scale: float
    noise: Mapping[str, float] = field(default_factory=dict)

    @property
    def root(self) -> Float64[Tensor, "unknowns directions"]:
        """R as a matrix."""
        return self.covariance_root.dense

    def deviation(
        self, measurements: Measurements, q_moved: Float64[Tensor, "rows dof"]
    ) -> Float64[Tensor, "rows 3"]:
        """Standard deviation of every row's position along the axes of its frame [m].

        Args:
            measurements: joint values, frames and targets.
            q_moved: the joint values with their corrections.
        """
        state = JointState.of(measurements)
        frame = numbers_of(measurements.frame, self.space.frames, measurements.rows)
        target = numbers_of(measurements.target, self.space.targets, measurements.rows)
        deviation = torch.full((measurements.rows, 3), torch.nan, dtype=torch.float64)
        for f in range(len(self.space.frames)):
            for t in range(len(self.space.targets)):
                rows = ((frame == f) & (target == t)).nonzero()[:, 0]
                for part in torch.split(rows, CHUNK):
                    deviation[part] = self._of_rows(state[part], q_moved[part], f, t)
        return deviation

    def _of_rows(
        self, state: JointState, q_moved: Float64[Tensor, "rows dof"], frame: int, target: int
    ) -> Float64[Tensor, "rows 3"]:
        columns = self.columns(state, q_moved, frame, target)[:, :3]
        return self.covariance_root.along(columns).square().sum(-1).sqrt()

    def columns(
        self, state: JointState, q_moved: Float64[Tensor, "rows dof"], frame: int = 0, target: int = 0
    ) -> Float64[Tensor, "rows 6 unknowns"]:
        """Derivative of position [m] and rotation vector [rad] of a target in a frame by all unknowns.

        Args:
            state: commanded joint values, and what is stated beside them.
            q_moved: the joint values with their corrections.
            frame: number of the frame.
            target: number of the target.
        """
        space = self.space
        base, tool = list(self.geometry.bases.values())[frame], list(self.geometry.tools.values())[target]
        robot = self.geometry.robot.with_geometry(base=base, tool=tool)
        J = identification_jacobian(robot, q_moved)[1]
        columns = J.new_zeros((len(q_moved), 6, len(self.covariance_root.directions)))
        columns[..., : space.arm_size] = J[..., : space.arm_size]
        for group, number, first in (("base", frame, space.arm_size), ("tool", target, space.arm_size + 6)):
            start = space.of(group).start + 6 * number
            columns[..., start : start + 6] = J[..., first : first + 6]
        columns[..., len(space.parameters) :] = self._weight_columns(J, state)
        return columns

    def _weight_columns(self, J: Tensor, state: JointState) -> Float64[Tensor, "rows 6 weights"]:
        joints = J[..., joint_columns(self.space)] * J.new_tensor(self.space.robot.directions)
        blocks = [weight_columns(joints, chosen, state) for chosen in self.features]
        return torch.cat([joints[..., :0], *blocks], -1)


def root_of_sizes(posterior: Posterior, root: CovarianceRoot) -> Float64[Tensor, "unknowns groups"]:
    """What the uncertainty of the prior's sizes adds to a root of the covariance C of the unknowns.

    With `dx / d log s_g = 2 C Λ_g x` for the unknowns of group g and `var(log s_g) = 1 / (2 n_g)`, where n_g of
    them are determined by the data (first order; Kass and Steffey 1989, J. Amer. Statist. Assoc. 84(407), 717-726).
    """
    prior, x = posterior.prior, posterior.x
    groups = torch.zeros(len(x), len(prior.sizes), dtype=x.dtype, device=x.device)
    groups[torch.arange(len(x)), prior.group] = 1.0
    certain = posterior.determined > LEAST_EFFECTIVE
    moved = 2 * root.covariance_times((groups * (prior.precision * x)[:, None])[:, certain])
    return moved * (2 * posterior.determined[certain]).rsqrt()


def left_out_scale(errors: LeftOut) -> float:
    """Factor on the unknowns' covariance with which left-out values are missed by as much as predicted; 1 or more.

    With errors e and predicted deviations s in units of the noise, it solves `mean(e² / (1 + f (s² - 1))) = 1`.
    What the model cannot express makes it larger than 1.
    """
    square, extra = errors.error.square(), errors.spread.square() - 1
    low, high = 0.0, math.log(LARGEST_SCALE)
    if float((square / (1 + extra)).mean()) <= 1:
        return 1.0
    for _ in range(60):
        middle = (low + high) / 2
        if float((square / (1 + math.exp(middle) * extra)).mean()) > 1:
            low = middle
        else:
            high = middle
    return math.exp(high)


def position_uncertainty(
    rows: Rows,
    design: Design,
    fit: AbstractRegression,
    posterior: Posterior,
    geometry: IdentifiedGeometry,
    left_out: LeftOut | None = None,
) -> PositionUncertainty:
    """Of the positions that a posterior predicts, scaled by what left-out rows show.

    Args:
        rows: linearised values.
        design: the unknowns.
        fit: regression of the rows on them.
        posterior: of them.
        geometry: in the user's coordinates.
        left_out: values left out of this fit, where they are at hand; used where their sizes need no estimate anew.
    """
    folds = rows.folds(FOLDS if rows.groups > VERY_FEW_GROUPS else FOLDS_OF_FEW, MOST_GROUPS)
    if rows.groups <= FEW_GROUPS:
        updates = FOLD_UPDATES if rows.groups <= SOME_GROUPS else FEWER_UPDATES
        missed = fit.left_out_anew(posterior, folds, updates)
    else:
        missed = left_out or fit.left_out(posterior, folds)
    prior_scale = left_out_scale(missed)
    root = fit.covariance_root(posterior)
    change = geometry.change[:, design.problem.active.cpu()]
    root = root.extended(root_of_sizes(posterior, root), prior_scale**0.5, change)
    noise = {sensor.name: sigma for sensor, sigma in zip(rows.values, posterior.noise, strict=True)}
    return PositionUncertainty(design.problem.space, geometry, design.features, root, prior_scale, noise)
