"""Residuals of a calibration in the order of the file, with their derivatives."""

import contextlib
import hashlib
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64

from pisigma.calibration.geometric.initial_guess.initial_guess import randomly_chosen_rows
from pisigma.calibration.geometric.problem.noise import (
    ALWAYS_GOOD,
    UNDETERMINED,
    contributions_and_noise_of,
    renumber,
)
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.calibration.hybrid.gravity import USUAL, to_first_row_frame
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.calibration.hybrid.search import MIN_USUAL_SCALE
from pisigma.joint_correction.backlash import Backlash
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.measurement.conditions import APPROACH, order_of_rows

_MAX_ROWS = 4_000
"""Largest number of rows that are used, drawn from all rows."""
SENSORS = ("position", "rotation")
"""Sensors whose values depend on frame and tool directly, without other unknowns."""
_CAP = 3.0
"""Multiple of the upper quartile of their lengths at which residuals are clipped during the search for a fault."""
_HARMONICS, _JOINT_ERROR = 3, 3e-4
"""Harmonics of a series of the joint values, and prior standard deviation of its weights [rad]. The series is fitted
together with the parameters, because in rows ordered by a joint's values, slow errors of its gear look like a slow
motion."""
_SAG = 1e-3
"""Prior standard deviation of the weights of gravity torques [rad], which are also fitted, because the sag of elastic
joints can look like a second arm. The weights are 8.6e-4 for the measured UR10."""
_MAX_ITERATIONS, _CONVERGENCE_TOLERANCE = 12, 1e-2
"""Largest number of iterations of noise and prior scales, and their relative change at convergence."""
_MIN_EFFECTIVE, _SMALLEST_SIZE = 0.1, 1e-2
"""Effective number of weights of a kind below which their prior scale is not estimated, and smallest factor on it."""
_VALUES_PER_POSE = 6
"""Number of independent values of a configuration (the pose of the tool), regardless of targets and repeats."""


@dataclass(frozen=True, eq=False)
class OrderedRows:
    """Residuals of a calibration in the order of the file, with their derivatives, all divided by the noise.

    Attributes:
        result: the geometric calibration.
        problem: the problem of these rows.
        row_index: index of every row in the measurements.
        residual: three values per sensor, 0 where nothing was measured.
        derivative: derivative of the values with respect to all parameters.
        value_count: number of measured values.
        noise: standard deviation of every column of values [m or rad], or the factor on the standard deviations
            stated in the rows.
        prior_factors: factors on the prior standard deviations of the weights of each kind of joint errors, if they
            were estimated; empty for stated sizes, and for the sag of masses at the origins of the frames alone.
    """

    result: CalibrationResult
    problem: CalibrationProblem
    row_index: Int64[np.ndarray, " rows"]
    residual: Float64[np.ndarray, "rows values"]
    derivative: Float64[np.ndarray, "rows values parameters"]
    value_count: int
    noise: Float64[np.ndarray, " values"]
    prior_factors: tuple[float, ...] = ()

    @cached_property
    def content_hash(self) -> bytes:
        """SHA-256 of everything that a search depends on, which identifies its last result.

        The same rows are used in a calibration when they are added to a cell, and again for its model.
        """
        setup = (
            self.problem.frame.cpu().numpy(),
            self.problem.target.cpu().numpy(),
            self.configuration_index,
        )
        names = (self.problem.space.frames, self.problem.space.targets)  # the result already contains them
        counts = (self.jacobian.shape, self.value_count, self.configuration_index is None)
        digest = hashlib.sha256(repr((names, counts)).encode())
        for one in (
            self.row_index,
            self.residual,
            self.derivative,
            self.jacobian,
            self.noise,
            self.prior_precision,
            *setup,
        ):
            digest.update(b"" if one is None else np.ascontiguousarray(one).tobytes())
        return digest.digest()

    def __eq__(self, other: object) -> bool:
        """Return whether a search gives the same result for both."""
        return isinstance(other, OrderedRows) and self.content_hash == other.content_hash

    def __hash__(self) -> int:
        """Return the hash of the content."""
        return hash(self.content_hash)

    @staticmethod
    def from_result(result: CalibrationResult | HybridResult) -> "OrderedRows | None":
        """Compute the residuals of a calibration; None if it has no positions or orientations with noise."""
        learned = result.learned if isinstance(result, HybridResult) else None
        geometric = result.geometric if isinstance(result, HybridResult) else result
        solved = geometric.solved
        data, view, rows = (
            solved.measurements,
            contributions_and_noise_of(solved.refined_linearisation),
            solved.setup.row_indices.cpu(),
        )
        errors = None if learned is None else result.errors_of(data)
        present = [sensor.present for sensor in solved.problem.sensors if sensor.name in SENSORS]
        if not present:
            return None
        measured = torch.stack(present).any(0).nonzero()[:, 0].cpu()
        some = measured[randomly_chosen_rows(len(measured), _MAX_ROWS)]
        some = some[np.argsort(np.argsort(order_of_rows(data))[rows[some]])]
        problem = replace(solved.problem, pair_count=0).select(some)
        whole, every = slice(0, len(some)), torch.arange(len(problem.space.parameters))
        motion = problem.motion(solved.refined_linearisation.point, whole, every)
        unknowns = problem.space.sensor_unknowns(solved.refined_linearisation.point)
        R = solved.setup.reference_frames.bases[:, :3, :3][problem.frame]
        residuals, derivatives, values, noise = [], [], 0, []
        for k, sensor in enumerate(problem.sensors):
            sigma = float(view.noise[k]) if learned is None else learned.noise[sensor.name]
            if sensor.name not in SENSORS or sigma <= ALWAYS_GOOD:
                continue
            residual = view.contributions[k].residual[:, some]
            if errors is not None:
                residual = (R.mT @ errors[sensor.name][rows[some], :, None])[..., 0].t()
            root = sensor.present / (sigma if sensor.sigma is None else sigma * sensor.sigma)
            J = problem.prediction_derivative(sensor, motion, unknowns, whole, every)
            residuals.append(torch.where(sensor.present, residual * root, 0.0).t().cpu().numpy())
            derivatives.append((J * root).permute(2, 1, 0).cpu().numpy())
            values += int(sensor.present.sum()) * sensor.components
            noise += [sigma] * sensor.components
        if not residuals:
            return None
        flat = (np.concatenate(residuals, 1), np.concatenate(derivatives, 1))
        return OrderedRows(geometric, problem, rows[some].numpy(), *flat, values, np.array(noise))

    @cached_property
    def clipped_residual(self) -> Float64[np.ndarray, "rows values"]:
        """Residuals; large ones are shortened so that they do not dominate the search for a fault."""
        lengths = np.linalg.norm(self.residual, axis=1)
        longest = _CAP * np.quantile(lengths, 0.75)
        shortened: np.ndarray = (
            self.residual * np.minimum(1.0, longest / np.maximum(lengths, 1e-300))[:, None]
        )
        return shortened

    def motion_derivative(
        self, kind: Literal["frame", "target"]
    ) -> tuple[Int64[np.ndarray, " rows"], Float64[np.ndarray, "rows values motion"]]:
        """Return the frame or target of every row, and derivatives with respect to its shift and rotation.

        Positions do not depend on the rotation of a target.
        """
        space = self.problem.space
        group = (self.problem.frame if kind == "frame" else self.problem.target).cpu().numpy()
        columns = (
            space.indices_of("base" if kind == "frame" else "tool").start + 6 * group[:, None] + np.arange(6)
        )
        Z = np.take_along_axis(self.derivative, columns[:, None], 2)
        return group, Z if kind == "frame" or self.residual.shape[1] > 3 else Z[:, :, :3]

    @cached_property
    def joint_derivative(self) -> Float64[np.ndarray, "rows values dof"]:
        """Derivative of the values with respect to the joint values."""
        robot = self.problem.space.robot
        theta_or_d = 5 * np.array(robot.joint_rows) + ~np.array(robot.revolute)
        derivative: np.ndarray = self.derivative[:, :, theta_or_d] * robot.directions
        return derivative

    @cached_property
    def jacobian(self) -> Float64[np.ndarray, "rows values unknowns"]:
        """Derivative with respect to the calibration's parameters, and the weights of joint errors."""
        by_weights = [
            (
                self.joint_derivative[..., None]
                * feature.columns_of_rows(self.problem.state).cpu().numpy()[:, None]
            )[..., used]
            for feature, used, _ in self._joint_errors
        ]
        return np.concatenate([self.derivative[:, :, self.problem.active.cpu().numpy()], *by_weights], 2)

    @cached_property
    def _joint_errors(self) -> tuple[tuple[AbstractFeature, Bool[np.ndarray, "dof columns"], float], ...]:
        """Derivatives with respect to weights of unmodelled joint errors, and prior standard deviations of these [rad].

        Gravity acts on masses at the origins of the frames, and on first moments if their size can be estimated.
        Backlash needs stated directions of approach.
        """
        robot = self.problem.space.robot
        play = Backlash(robot)
        backlash = (
            ((play, play.used.numpy(), _JOINT_ERROR),) if APPROACH in self.problem.state.conditions else ()
        )
        series, sag = (
            FourierSeries(robot, _HARMONICS),
            GravityTorques(robot, to_first_row_frame(robot, USUAL)),
        )
        is_mass = np.arange(sag.used.shape[1]) % 4 == 0
        moments = ((sag, sag.used.numpy() & ~is_mass, _SAG),) if self.prior_factors else ()
        masses = (sag, sag.used.numpy() & is_mass, _SAG)
        kinds = ((series, series.used.numpy(), _JOINT_ERROR), masses, *moments, *backlash)
        sizes = self.prior_factors or (1.0,) * len(kinds)
        return tuple(
            (feature, used, size * factor) for (feature, used, size), factor in zip(kinds, sizes, strict=True)
        )

    @cached_property
    def prior_precision(self) -> Float64[np.ndarray, " unknowns"]:
        """Prior precision (1 / variance) of the parameters and of the weights."""
        robot = self.problem.space.robot
        active = self.problem.precision[self.problem.active]
        view = contributions_and_noise_of(self.result.solved.refined_linearisation)
        if self.prior_factors:
            view = replace(view, prior_scale=view.prior_scale.clamp(min=MIN_USUAL_SCALE))
        precision = view.scaled_precision(active, self.problem.prior_group).cpu().numpy()
        unit = np.where(robot.revolute, 1.0, robot.reach)[:, None]
        weights = [
            np.broadcast_to((size * unit) ** -2.0, used.shape)[used] for _, used, size in self._joint_errors
        ]
        return np.concatenate([precision, *weights])

    @cached_property
    def covariance(self) -> Float64[np.ndarray, "unknowns unknowns"]:
        """Covariance of the parameters and weights, with full weight of all rows."""
        flat = self.jacobian.reshape(-1, self.jacobian.shape[2])
        return inverse_of(flat.T @ flat + np.diag(self.prior_precision))

    @cached_property
    def with_estimated_noise(self) -> "OrderedRows":
        """The same rows, divided by the noise that parameters and joint errors leave, for the search of small effects.

        The noise of a geometric calibration contains what its parameters do not explain, such as the sag under a load.
        It hides effects that are larger than the noise of the sensor, and a prior for errors of all sizes leaves few
        values that could show them. Therefore the noise of every sensor and the prior scale of every kind of joint
        errors are estimated by their evidence (MacKay 1992, Neural Computation 4(3), eqs. 4.7 and 4.8, with the
        parameters that every sensor determines of Förstner 1979), and the prior of the geometry is not narrower than
        usual.
        """
        kinds = 3 + (APPROACH in self.problem.state.conditions)
        rows = replace(self, prior_factors=(1.0,) * kinds)
        weights = [int(used.sum()) for _, used, _ in rows._joint_errors]
        kind = np.repeat(np.arange(-1, kinds), [len(rows.prior_precision) - sum(weights), *weights])
        scale, sizes = _noise_and_sizes(rows, kind)
        scale = np.maximum(scale, ALWAYS_GOOD / self.noise)
        return replace(
            self,
            residual=self.residual / scale,
            derivative=self.derivative / scale[:, None],
            noise=self.noise * scale,
            prior_factors=tuple(sizes.tolist()),
        )

    @cached_property
    def residual_after_fit(self) -> Float64[np.ndarray, "rows values"]:
        """Residuals after fitting the parameters and the series of joint errors."""
        return self.project_out_parameters(self.residual.ravel()).reshape(self.residual.shape)

    def project_out_parameters(
        self, values: Float64[np.ndarray, "*values"]
    ) -> Float64[np.ndarray, "*values"]:
        """Return the remainder of values, or of columns of values, after fitting the parameters and weights to them."""
        X = self.jacobian.reshape(-1, self.jacobian.shape[2])
        left: np.ndarray = values - X @ (self.covariance @ (X.T @ values))
        return left

    @cached_property
    def unexplained_residual(self) -> Float64[np.ndarray, " values"]:
        """Clipped residuals after fitting the parameters and the series of joint errors."""
        return self.project_out_parameters(self.clipped_residual.ravel())

    def evidence_of(self, columns: Float64[np.ndarray, "values sizes"]) -> "Effect":
        """Fit further columns to the unexplained residuals (Frisch-Waugh).

        The Bayes factor is that of Schwarz's criterion (1978, Annals of Statistics 6(2)).

        Args:
            columns: derivatives of the values with respect to the sizes, after `project_out_parameters`.
        """
        left, count = self.unexplained_residual, columns.shape[1]
        sizes = np.linalg.lstsq(columns, left, rcond=None)[0]
        ratio = max(float(((left - columns @ sizes) ** 2).sum() / (left @ left)), 1e-12)
        spare = max(self.value_count - self.effective_parameters, 1.0)
        freedom = self.degrees_of_freedom
        odds = -freedom / 2 * math.log(ratio) - count * math.log(max(freedom, 2.0)) / 2
        return Effect(sizes, math.sqrt(spare / max(spare - count, 1.0) / ratio), odds)

    @cached_property
    def effective_parameters(self) -> float:
        """Effective number of parameters and weights."""
        return float((self.jacobian * (self.jacobian @ self.covariance)).sum())

    @cached_property
    def configuration_index(self) -> Int64[np.ndarray, " rows"] | None:
        """Index of every row's configuration (joint values, frame, and optionally target); None if all rows differ."""
        group = self.problem.pose if self.problem.configuration is None else self.problem.configuration
        return None if group is None else renumber(group).cpu().numpy()

    @property
    def degrees_of_freedom(self) -> float:
        """Degrees of freedom after the calibration, with at most one pose per configuration, and no repeats."""
        values, columns = self.value_count, self.residual.shape[1]
        if self.configuration_index is not None:
            targets = np.unique([self.configuration_index, self.problem.target.cpu().numpy()], axis=1).shape[
                1
            ]
            configurations = int(self.configuration_index.max()) + 1
            values = min(values, _VALUES_PER_POSE * configurations, columns * targets)
        return values - self.effective_parameters


def _noise_and_sizes(
    rows: OrderedRows, kind: Int64[np.ndarray, " unknowns"]
) -> tuple[Float64[np.ndarray, " values"], Float64[np.ndarray, " kinds"]]:
    """Estimate the remaining noise and the prior scales of the joint errors alternately.

    Args:
        rows: the rows, with the initial prior scales.
        kind: index of the kind of joint errors of every weight; -1 for parameters, whose prior is kept.

    Returns:
        Noise of every column of values, and factors on the prior standard deviations, both relative to those of `rows`.
    """
    sensors, weights = rows.residual.shape[1] // 3, kind >= 0
    X, r = (
        np.moveaxis(values.reshape(len(values), sensors, 3, -1), 1, 0).reshape(sensors, 3 * len(values), -1)
        for values in (rows.jacobian, rows.clipped_residual)
    )
    measured, normal, descent = X.any(2).sum(1), X.swapaxes(1, 2) @ X, (X.swapaxes(1, 2) @ r)[..., 0]
    variance, sizes, held = np.ones(sensors), np.ones(kind.max() + 1), rows.prior_precision.copy()
    for _ in range(_MAX_ITERATIONS):
        before = np.concatenate([variance, sizes])
        covariance = inverse_of((normal / variance[:, None, None]).sum(0) + np.diag(held))
        x = covariance @ (descent / variance[:, None]).sum(0)
        used = (normal * covariance).sum((1, 2)) / variance
        left = np.square(r[..., 0] - X @ x).sum(1)
        variance = np.maximum(left / np.maximum(measured - used, 1.0), 1e-300)
        determined, squares = (
            np.bincount(kind[weights], values[weights], len(sizes))
            for values in (1 - held * covariance.diagonal(), np.square(x) * rows.prior_precision)
        )
        estimated = np.sqrt(squares / np.maximum(determined, _MIN_EFFECTIVE)).clip(_SMALLEST_SIZE)
        sizes = np.where(determined > _MIN_EFFECTIVE, estimated, sizes)
        held[weights] = rows.prior_precision[weights] / np.square(sizes[kind[weights]])
        if np.abs(np.concatenate([variance, sizes]) / before - 1).max() < _CONVERGENCE_TOLERANCE:
            break
    return np.repeat(np.sqrt(variance), 3), sizes


class Effect(NamedTuple):
    """An effect that residuals contain in addition to the parameters of the calibration.

    Attributes:
        effect_sizes: fitted sizes.
        error_increase_factor: ratio of the errors without and with the effect [1].
        log_bayes_factor: logarithm of the odds of the effect against none.
    """

    effect_sizes: Float64[np.ndarray, " sizes"]
    error_increase_factor: float
    log_bayes_factor: float


def inverse_of(
    normal_matrix: Float64[np.ndarray, "unknowns unknowns"],
) -> Float64[np.ndarray, "unknowns unknowns"]:
    """Return the inverse of a normal matrix, with column scaling; undetermined directions get variance 0."""
    scale = 1 / np.sqrt(np.maximum(normal_matrix.diagonal(), 1e-300))
    scales = scale * scale[:, None]
    scaled = normal_matrix * scales
    with contextlib.suppress(np.linalg.LinAlgError):
        root = np.linalg.cholesky(scaled)
        inverse: np.ndarray = np.linalg.inv(root)
        inverse = inverse.T @ inverse
        # Row sums bound the largest eigenvalues of both matrices, so that every direction is determined.
        if np.abs(scaled).sum(0).max() * np.abs(inverse).sum(0).max() * UNDETERMINED < 1:
            inverse *= scales
            return inverse
    inverse = np.linalg.pinv(scaled, rcond=UNDETERMINED, hermitian=True) * scales
    return inverse
