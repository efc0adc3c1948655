"""Standard deviations of predicted positions from the posterior of parameters and weights."""

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.joint_repeatability import corner_sigma_factor
from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.hybrid.design import (
    FOLDS,
    FOLDS_OF_FEW,
    MAX_GROUPS,
    AbstractDesignRegression,
    Design,
    LinearisedRows,
)
from pisigma.calibration.hybrid.noise import JOINT, CalibrationNoise, median_stated_sigmas
from pisigma.calibration.hybrid.sensor_values import joint_value_parameters, weight_columns
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.estimation.held_out import HeldOutErrors, held_out_covariance_factor
from pisigma.estimation.regression import Posterior, prior_scale_columns
from pisigma.estimation.rounded_root import round_root
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.sensor import indices_of_names
from pisigma.robot.kinematics.parameter_jacobian import identification_jacobian

CHUNK = 128
"""Number of rows whose columns are in memory at a time."""
FEW_GROUPS = 600
"""Number of groups up to which noise and prior scales are estimated again for every fold that is held out."""
_VERY_FEW_GROUPS = 60
"""Number of groups up to which `FOLDS_OF_FEW` folds are held out: with a quarter of so few rows left out, a calibration
is much worse than with all rows, so its errors are not representative."""
_FOLD_UPDATES, _FEWER_UPDATES, _SOME_GROUPS = 3, 1, 150
"""Number of updates of noise and prior scales for every fold, for few and for more groups, and the number of groups
up to which the first applies. With one update, the share of rows in the predicted 95 % intervals is 0.9 % lower for 30
rows, 0.4 % for 100 rows and 0.3 % for 300 rows; fitting 300 rows then takes four fifths of the time."""

MAX_EXACT_ENTRIES = 1 << 18
"""Entries of a covariance root up to which it is not rounded: 2 MB in a model folder."""
ROUNDING_TOLERANCE = 0.009
"""Largest relative change of a predicted standard deviation by rounding the covariance root; the standard deviations
themselves are known to some 2 % from 1,000 held-out rows."""
_PROBED_ROWS, _PROBED_FRAMES = 200, 8
"""Rows, and frames or targets, at which the change is computed."""


@dataclass(frozen=True, eq=False)
class PositionUncertainty:
    """Standard deviations of positions, `sqrt(x C x^T)` with x the derivative with respect to all unknowns.

    Attributes:
        space: the parameters.
        geometry: geometry at which the derivative is taken.
        features: features of the weights.
        covariance_root: root `R` of `C = R R^T` for all parameters of the space (0 for parameters that were not
            free), followed by all weights, scaled so that predicted and observed held-out errors agree.
        variance_factor: factor on the variances that results from this scaling.
        noise: noise of the sensors; empty in folders of earlier versions.
    """

    space: ParameterSpace
    geometry: IdentifiedGeometry
    features: tuple[AbstractFeature, ...]
    covariance_root: CovarianceRoot
    variance_factor: float
    noise: CalibrationNoise = field(default_factory=CalibrationNoise)

    @property
    def dense_root(self) -> Float64[Tensor, "unknowns directions"]:
        """Root `R` as a dense matrix."""
        return self.covariance_root.as_matrix

    @property
    def uncertain_unknowns(self) -> list[int]:
        """Indices of the unknowns whose rows of R a model folder stores: the free parameters, and all weights."""
        parameters = len(self.space.parameters)
        free: list[int] = self.dense_root[:parameters].any(1).nonzero()[:, 0].tolist()
        return [*free, *range(parameters, len(self.dense_root))]

    def sigma(
        self, measurements: Measurements, correction: JointCorrection | None = None
    ) -> Float64[Tensor, "rows 3"]:
        """Compute the standard deviation of every row's position along the axes of its frame [m].

        It includes the effect of conditions that the rows do not state, such as directions of approach.

        Args:
            measurements: joint values, frames and targets.
            correction: the joint correction; None without one.
        """
        state = JointState.from_measurements(measurements)
        frame = indices_of_names(measurements.frame, self.space.frames, measurements.rows)
        target = indices_of_names(measurements.target, self.space.targets, measurements.rows)
        deviation = torch.full((measurements.rows, 3), torch.nan, dtype=torch.float64)
        for f in range(len(self.space.frames)):
            for t in range(len(self.space.targets)):
                rows = ((frame == f) & (target == t)).nonzero()[:, 0]
                for part in torch.split(rows, CHUNK):
                    deviation[part] = self._of_rows(state[part], correction, f, t)
        return deviation

    def with_rounded_root(self, rows: Measurements) -> "PositionUncertainty":
        """Round a large covariance root, so that a model folder stores some 1/40 of the bytes.

        Predicted standard deviations at the rows, at joint values permuted between rows, and of the motions between
        both change by at most `ROUNDING_TOLERANCE`; those of single unknowns do not change.

        Args:
            rows: rows of the calibration.

        Returns:
            The same uncertainty, with `R` in one matrix if it is small or cannot be rounded.
        """
        kept = CovarianceRoot(root := self.dense_root)
        if root.numel() > MAX_EXACT_ENTRIES:
            uncertain = self.uncertain_unknowns
            probes = self._probes(JointState.from_measurements(rows))[:, uncertain]
            if (rounded := round_root(root[uncertain], probes, ROUNDING_TOLERANCE)) is not None:
                kept = CovarianceRoot.from_rounded(rounded.with_exact_unknowns(uncertain, len(root)))
        return replace(self, covariance_root=kept)

    def _probes(self, state: JointState) -> Float64[Tensor, "probes unknowns"]:
        """Return the combinations of unknowns in poses of rows, at permuted joint values, and in motions between."""
        rows = state[torch.linspace(0, len(state.q) - 1, min(len(state.q), _PROBED_ROWS)).round().long()]
        generator = torch.Generator().manual_seed(0)
        order = torch.rand(rows.q.shape, generator=generator).argsort(0)
        others = replace(rows, q=rows.q.take_along_dim(order, 0))
        frames, targets = len(self.space.frames), len(self.space.targets)
        pairs = sorted({(f % frames, f % targets) for f in range(min(max(frames, targets), _PROBED_FRAMES))})
        probes = []
        for frame, target in pairs:
            here, there = (self.pose_derivatives(one, one.q, frame, target) for one in (rows, others))
            probes += [here, there, here - there]
        return torch.cat(probes).flatten(0, 1)

    def _of_rows(
        self, state: JointState, correction: JointCorrection | None, frame: int, target: int
    ) -> Float64[Tensor, "rows 3"]:
        with torch.no_grad():
            q_moved = state.q if correction is None else state.q + correction(state)
        columns = self.pose_derivatives(state, q_moved, frame, target)[:, :3]
        variance: Tensor = self.covariance_root.left_multiply(columns).square().sum(-1)
        if correction is not None:
            joints = columns[..., joint_value_parameters(self.space)] * columns.new_tensor(
                self.space.robot.directions
            )
            unstated = joints @ correction.unstated_covariance_root(state)
            variance = variance + unstated.square().sum(-1)
        return variance.sqrt()

    def pose_derivatives(
        self, state: JointState, q_corrected: Float64[Tensor, "rows dof"], frame: int = 0, target: int = 0
    ) -> Float64[Tensor, "rows 6 unknowns"]:
        """Compute the derivative of a target's position [m] and rotation vector [rad] with respect to all unknowns.

        Args:
            state: commanded joint values and stated conditions.
            q_corrected: joint values with their corrections [rad or m].
            frame: index of the frame.
            target: index of the target.
        """
        space = self.space
        base, tool = list(self.geometry.bases.values())[frame], list(self.geometry.tools.values())[target]
        robot = self.geometry.robot.with_geometry(base=base, tool=tool)
        J = identification_jacobian(robot, q_corrected)[1]
        columns = J.new_zeros((len(q_corrected), 6, len(self.covariance_root.directions)))
        columns[..., : space.arm_parameter_count] = J[..., : space.arm_parameter_count]
        for group, number, first in (
            ("base", frame, space.arm_parameter_count),
            ("tool", target, space.arm_parameter_count + 6),
        ):
            start = space.indices_of(group).start + 6 * number
            columns[..., start : start + 6] = J[..., first : first + 6]
        columns[..., len(space.parameters) :] = self._weight_columns(J, state)
        return columns

    def _weight_columns(self, J: Tensor, state: JointState) -> Float64[Tensor, "rows 6 weights"]:
        joints = J[..., joint_value_parameters(self.space)] * J.new_tensor(self.space.robot.directions)
        blocks = [weight_columns(joints, chosen, state) for chosen in self.features]
        return torch.cat([joints[..., :0], *blocks], -1)


def position_uncertainty(
    rows: LinearisedRows,
    design: Design,
    fit: AbstractDesignRegression,
    posterior: Posterior,
    geometry: IdentifiedGeometry,
    held_out_errors: HeldOutErrors | None = None,
) -> PositionUncertainty:
    """Return the uncertainty of positions predicted by a posterior, scaled by held-out errors.

    Args:
        rows: linearised values.
        design: the unknowns.
        fit: regression of the rows on the unknowns.
        posterior: posterior of the unknowns.
        geometry: geometry in the user's coordinates.
        held_out_errors: held-out predictions of this fit, if available; they are used if there are too many groups to
            estimate noise and prior scales again for every fold.
    """
    folds = rows.folds(FOLDS if rows.groups > _VERY_FEW_GROUPS else FOLDS_OF_FEW, MAX_GROUPS)
    if rows.groups <= FEW_GROUPS:
        updates = _FOLD_UPDATES if rows.groups <= _SOME_GROUPS else _FEWER_UPDATES
        missed = fit.held_out_errors_refitted(posterior, folds, updates)
    else:
        missed = held_out_errors or fit.held_out_errors(posterior, folds)
    variance_factor = held_out_covariance_factor(missed)
    root = fit.covariance_root(posterior)
    change = geometry.coordinate_jacobian[:, design.problem.active.cpu()]
    root = root.with_columns(prior_scale_columns(posterior, root), variance_factor**0.5, change)
    value = {sensor.name: sigma for sensor, sigma in zip(rows.values, posterior.noise, strict=True)}
    setup = geometry.setup
    if setup is not None and setup.joint_repeatability and "corner" in value:
        factor = corner_sigma_factor(setup.measurements, value["corner"])
        value[JOINT] = factor * setup.joint_repeatability
    noise = CalibrationNoise(value, median_stated_sigmas(design.problem.sensors))
    return PositionUncertainty(design.problem.space, geometry, design.features, root, variance_factor, noise)
