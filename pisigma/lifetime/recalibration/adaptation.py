"""Adaptation of a model to new rows: posterior of all unknowns and sizes of their drift, by iterated linearisation."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.initial_guess.initial_guess import randomly_chosen_rows
from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.calibration.geometric.problem.joint_repeatability import corner_sigma_factor
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry, identified_geometry
from pisigma.calibration.hybrid.design import LinearisedRows
from pisigma.calibration.hybrid.noise import JOINT, CalibrationNoise, median_stated_sigmas
from pisigma.calibration.hybrid.refinement import correction_from_weights, linearise_rows
from pisigma.estimation.drift import Drift, DriftGroup, DriftSearch, LinearValues, PosteriorUpdate
from pisigma.estimation.wrong_rows import ExplainedRows, mark_wrong_rows
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.lifetime.recalibration.recalibration_problem import RecalibrationProblem
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import held_out_groups
from pisigma.measurement.sensors.registry import measured_errors

_MAX_LINEARISATIONS = 5
_CONVERGENCE_TOLERANCE = 0.05
"""RMS change of predicted values, relative to their noise, below which linearisation ends."""
MAX_VALUES = 360
"""Largest number of values from which the sizes of the drift are estimated; the posterior uses all values."""
_FIRST_NOISE = {"m": 1e-4, "rad": 1e-4}
"""Initial noise of sensors that the calibration did not have [m or rad]."""


@dataclass(frozen=True, eq=False)
class AdaptedArm:
    """Geometry, frames and joint correction at given values of the unknowns.

    Attributes:
        geometry: identified geometry in the user's coordinates.
        correction: joint correction; None if the model has none.
    """

    geometry: IdentifiedGeometry
    correction: JointCorrection | None

    @staticmethod
    def from_unknowns(problem: RecalibrationProblem, x: Float64[Tensor, " unknowns"]) -> "AdaptedArm":
        """Return the arm at the unknowns x of a problem, with parameters relative to `design.problem.prior_mean`."""
        design = problem.design
        point = design.problem.prior_mean.index_add(0, design.problem.active, x[: design.active_count])
        return AdaptedArm(
            identified_geometry(problem.setup, point),
            correction_from_weights(design, x) if design.features else None,
        )

    def errors_of(self, measurements: Measurements) -> dict[str, Float64[Tensor, "rows components"]]:
        """Compute measured minus predicted values; see `CalibrationResult.errors_of`."""
        moved = measurements
        if self.correction is not None:
            with torch.no_grad():
                moved = replace(moved, q=moved.q + self.correction.for_rows(moved))
        geometry = self.geometry
        T = predicted_poses(geometry.robot, geometry.bases, geometry.tools, moved)
        return measured_errors(T, measurements, geometry.unknowns)


@dataclass(frozen=True, eq=False)
class Adaptation:
    """A model adapted to new rows.

    Attributes:
        problem: the problem that was solved.
        arm: geometry, frames and joint correction.
        drift: sizes of the drift of each group, and the noise.
        shift: change of all unknowns, with parameters relative to the anchors.
        effective_unknowns: number of directions that the new rows determine.
        rounds: number of linearisations.
        search: evidence at the solution, from which movements are estimated.
        values: values in use at the solution.
        update: posterior update at the solution.
    """

    problem: RecalibrationProblem
    arm: AdaptedArm
    drift: Drift
    shift: Float64[Tensor, " unknowns"]
    effective_unknowns: float
    rounds: int
    search: DriftSearch
    values: LinearValues
    update: PosteriorUpdate = field(repr=False)

    @property
    def wrong_rows(self) -> list[int]:
        """Rows that are not used, because the loss rejects them or the evidence shows that they are wrong."""
        rows: list[int] = self.problem.setup.row_indices[self.problem.wrong_rows(self.values)].tolist()
        return rows

    @cached_property
    def covariance_root(self) -> Float64[Tensor, "unknowns directions"]:
        """Root of the posterior covariance of all unknowns in the user's coordinates, parameters first."""
        root = torch.cat([self.update.covariance_root(), self.problem.held_covariance_root], 1)
        active = self.problem.design.active_count
        return torch.cat([self.problem.coordinate_jacobian @ root[:active], root[active:]])

    @property
    def noise(self) -> CalibrationNoise:
        """Noise of the sensors of the new rows."""
        sensors = self.problem.design.problem.sensors
        value = {sensor.name: sigma for sensor, sigma in zip(sensors, self.drift.noise.tolist(), strict=True)}
        setup = self.problem.setup
        if setup.joint_repeatability and "corner" in value:
            value[JOINT] = setup.joint_repeatability * corner_sigma_factor(
                setup.measurements, value["corner"]
            )
        return CalibrationNoise(value, median_stated_sigmas(sensors))

    def errors_of(self, measurements: Measurements) -> dict[str, Float64[Tensor, "rows components"]]:
        """Compute measured minus predicted values; see `CalibrationResult.errors_of`."""
        return self.arm.errors_of(measurements)


def adapt(
    problem: RecalibrationProblem,
    initial_noise: Float64[Tensor, " sensors"] | None = None,
    start: Drift | None = None,
) -> Adaptation:
    """Adapt a model to new rows.

    Args:
        problem: rows and prior.
        initial_noise: noise of each sensor [m or rad], or a factor if rows state it; None for that of the calibration.
        start: initial sizes and noise, for example from other rows of the session; None for zero drift.
    """
    design, mean = problem.design, problem.mean
    initial_noise = noise_of_calibration(problem) if initial_noise is None else initial_noise
    group = held_out_groups(problem.setup.measurements)
    x, effective = mean, 0.0
    wrong: Mapping[int, float] = {}
    drift = start or Drift(problem.groups, initial_noise)
    drift = replace(drift, groups=_with_sizes(problem.groups, drift.groups))
    rounds = 0
    while rounds < _MAX_LINEARISATIONS:
        rounds += 1
        rows = linearise_rows(design, x, effective, group)
        values = replace(linear_values(problem, rows), wrong_configurations=wrong)
        # Sizes of the drift and wrong rows are estimated first, because both determine how far the posterior may follow
        # the values.
        search = _searched(problem, values, drift, initial_noise)
        drift, wrong = search.drift, search.values.wrong_configurations
        values = replace(values, wrong_configurations=wrong)
        update = PosteriorUpdate(problem.covariance_root, values, drift)
        # Convergence is assessed with predicted values, because poorly determined unknowns may still wander.
        step = values.X @ (mean + update.shift - x) / values.sigma(drift.noise)
        x, effective = mean + update.shift, update.effective_unknowns
        if float(step.square().mean().sqrt()) < _CONVERGENCE_TOLERANCE:
            break
    return Adaptation(
        problem=problem,
        arm=AdaptedArm.from_unknowns(problem, x),
        drift=drift,
        shift=update.shift,
        effective_unknowns=effective,
        rounds=rounds,
        search=search,
        values=values,
        update=update,
    )


def noise_of_calibration(problem: RecalibrationProblem) -> Float64[Tensor, " sensors"]:
    """Return the noise of all sensors of a problem in the calibration [m or rad]; a factor if the new rows state it.

    Raises:
        MeasurementError: see `CalibrationNoise.noise_of_earlier_rows`.
    """
    known = problem.posterior.noise
    sensors = problem.design.problem.sensors
    first = [1.0 if sensor.sigma is not None else _FIRST_NOISE[sensor.unit] for sensor in sensors]
    usual = [known.noise_of_earlier_rows(sensor) for sensor in sensors]
    chosen = [new if old is None else old for old, new in zip(usual, first, strict=True)]
    return torch.tensor(chosen, dtype=torch.float64)


def linear_values(problem: RecalibrationProblem, rows: LinearisedRows) -> LinearValues:
    """Concatenate the values of all sensors, with residuals relative to the model."""
    X, y, sensor, configuration = [], [], [], []
    for number, one in enumerate(rows.values):
        columns = (problem.design.columns(one, slice(None)) * one.weight_root[:, None, None]).flatten(0, 1)
        X.append(columns)
        y.append((one.residual * one.weight_root[:, None]).flatten() - columns @ problem.mean)
        sensor.append(torch.full((len(columns),), number))
        configuration.append(problem.configuration[one.row].repeat_interleave(one.components))
    found = LinearValues(
        torch.cat(X), torch.cat(y), torch.cat(sensor), torch.cat(configuration), rows.sensors
    )
    return replace(found, rejected=rows.rejected)


def _with_sizes(groups: tuple[DriftGroup, ...], like: tuple[DriftGroup, ...]) -> tuple[DriftGroup, ...]:
    """Return the groups with the sizes of groups that have the same names."""
    sizes = {one.name: one.drift_size for one in like}
    return tuple(
        one if one.fixed_size else replace(one, drift_size=sizes.get(one.name, 0.0)) for one in groups
    )


def _searched(
    problem: RecalibrationProblem, values: LinearValues, drift: Drift, usual: Float64[Tensor, " sensors"]
) -> DriftSearch:
    """Estimate sizes of the drift and find wrong rows by evidence, from a selection of the values if there are many."""
    if len(values.y) > MAX_VALUES:
        values = values.select(randomly_chosen_rows(len(values.y), MAX_VALUES).sort().values)
    A = values.X @ problem.covariance_root

    def explain(wrong: Mapping[int, float]) -> ExplainedRows[DriftSearch]:
        there = replace(values, wrong_configurations=wrong)
        search = DriftSearch(there, A, drift.groups, drift.noise, usual)
        search.estimate_sizes()
        return ExplainedRows(search, there, search.log_evidence, search.covariance, search.sigma)

    return mark_wrong_rows(explain(values.wrong_configurations), explain).explanation
