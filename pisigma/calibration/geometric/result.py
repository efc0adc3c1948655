"""Result of a geometric calibration: robot, parameters with standard errors, and dependencies between parameters."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.identifiability.observability import (
    Observability,
    find_weak_directions,
    observability_of,
)
from pisigma.calibration.geometric.identifiability.pairwise import (
    PairwiseRedundancy,
    find_pairwise_redundancy,
)
from pisigma.calibration.geometric.identifiability.plausibility import misfitting_frames
from pisigma.calibration.geometric.identifiability.redundancy import RankFindings, Redundancy
from pisigma.calibration.geometric.identifiability.sufficiency import CalibrationWarning, measurement_advice
from pisigma.calibration.geometric.outliers import Outlier, outliers_of
from pisigma.calibration.geometric.parameter_table import (
    ParameterEstimate,
    PriorRatio,
    parameter_table,
    prior_ratios_of,
)
from pisigma.calibration.geometric.posterior import ParameterPosterior
from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.calibration.geometric.problem.least_squares import (
    Linearisation,
    Solution,
    SolutionStatus,
    covariance_of,
)
from pisigma.calibration.geometric.problem.noise import (
    contributions_and_noise_of,
    effective_parameters_by_sensor,
)
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.calibration.geometric.problem.setup import CalibrationSetup, IdentifiedGeometry
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.registry import measured_errors
from pisigma.robot.description import Robot

_DISAGREEING = 10.0
"""Factor on the variance of angles above which the calibration gives a warning."""


@dataclass(frozen=True)
class SensorNoise:
    """Noise of a kind of sensor, estimated from the residuals.

    Attributes:
        sensor: "position", "rotation", "touch", "socket", "distance", "pair", or the name of a registered sensor.
        sigma: standard deviation of one value [m or rad], or the factor on the standard deviations that the rows state.
        unit: "m" or "rad", or "stated" for a factor.
        values: number of measured values.
        effective_parameters: effective number of parameters that are estimated from the values.
        rms: root mean square length of the residuals of all rows [m or rad].
        residual_unit: "m" for lengths, "rad" for angles.
        components: number of values per row.
    """

    sensor: str
    sigma: float
    unit: str
    values: int
    effective_parameters: float
    rms: float
    residual_unit: Literal["m", "rad"]
    components: int


@dataclass(frozen=True, eq=False)
class SolvedCalibration:
    """A calibration problem with its solution.

    Attributes:
        measurements: all rows, including those that could not be used.
        setup: start values, and the frames to which bases and tools are relative.
        problem: the problem with its free parameters.
        solution: solution of the least-squares problem.
        findings: result of the rank analysis.
        geometry: the solution in the user's coordinates.
    """

    measurements: Measurements
    setup: CalibrationSetup
    problem: CalibrationProblem
    solution: Solution[Tensor]
    findings: RankFindings
    geometry: IdentifiedGeometry

    def result(self) -> "CalibrationResult":
        """Return the calibration in the user's coordinates."""
        geometry = self.geometry
        return CalibrationResult(geometry.robot, geometry.bases, geometry.tools, geometry.unknowns, self)

    @cached_property
    def refined_linearisation(self) -> Linearisation[Tensor]:
        """The problem linearised at its solution, with the noise estimated from all rows without outliers."""
        return self.problem.with_refined_noise(self.solution.linearisation)

    @cached_property
    def covariance(self) -> Float64[np.ndarray, "parameters parameters"]:
        """Covariance of all parameters in the user's coordinates (SI); 0 for parameters that were not free."""
        change, (own, held) = self._coordinate_change, self._covariances
        covariance: np.ndarray = (change @ (own + held @ held.mT) @ change.mT).numpy()
        return covariance

    @cached_property
    def covariance_root(self) -> Float64[Tensor, "parameters directions"]:
        """Root `R` of the covariance `R R^T` of all parameters in the user's coordinates."""
        covariance, held = self._covariances
        # Eigenvectors of the correlation matrix, because eigenvectors of the covariance would mix metres and radians.
        scale = covariance.diagonal().clamp(min=0.0).sqrt()
        inverse = torch.where(scale > 0, 1 / scale, 0.0)
        values, axes = torch.linalg.eigh(covariance * inverse * inverse[:, None])
        half = scale[:, None] * axes * values.clamp(min=0.0).sqrt()
        root: Tensor = self._coordinate_change @ torch.cat([half, held], 1)
        return root

    @property
    def _coordinate_change(self) -> Float64[Tensor, "parameters active"]:
        return self.geometry.coordinate_jacobian[:, self.problem.active.cpu()]

    @property
    def _covariances(self) -> tuple[Float64[Tensor, "active active"], Float64[Tensor, "active held"]]:
        """Return the covariance of the estimated directions, and a root of the covariance of the held directions."""
        estimated, held, scale = (
            covariance_of(self.refined_linearisation.normal).cpu(),
            self.problem.held_directions,
            self.problem.step_scale,
        )
        return estimated, scale.new_zeros(len(scale), 0).cpu() if held is None else held.covariance_root(
            scale.cpu()
        )


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """A geometric calibration; anything that predictions do not need is computed on demand.

    Attributes:
        robot: the calibrated robot, with the base of the first frame and the tool of the first target.
        bases: base in every frame: x, y, z [m], roll, pitch, yaw [rad].
        tools: tool of every target, in the same form.
        sensor_unknowns: estimated unknowns of the sensors by group and owner, in the owner's frame: for a "socket" x,
            y, z [m], for an "anchor" x, y, z and the reading of its sensor at distance zero [m].
        solved: the problem with its solution.
    """

    robot: Robot
    bases: dict[str, Float64[np.ndarray, " 6"]]
    tools: dict[str, Float64[np.ndarray, " 6"]]
    sensor_unknowns: dict[str, dict[str, Float64[np.ndarray, " columns"]]]
    solved: SolvedCalibration

    @cached_property
    def parameters(self) -> tuple[ParameterEstimate, ...]:
        """Table of all parameters, free or not."""
        solved = self.solved
        return parameter_table(
            solved.setup,
            solved.problem,
            solved.findings,
            solved.refined_linearisation,
            solved.geometry,
            solved.covariance,
        )

    @property
    def covariance(self) -> Float64[np.ndarray, "parameters parameters"]:
        """Covariance of all parameters in their order (SI); 0 for parameters that were not free."""
        return self.solved.covariance

    @cached_property
    def posterior(self) -> ParameterPosterior:
        """Joint posterior of all parameters in the user's coordinates; see `ParameterPosterior`."""
        solved = self.solved
        return ParameterPosterior.from_geometry(solved.problem.space, solved.geometry, solved.covariance_root)

    @cached_property
    def residuals(self) -> dict[str, Float64[np.ndarray, "rows components"]]:
        """Residuals of every row by sensor, measured minus predicted values [m or rad]; NaN in rows without a value."""
        return _residuals(self.solved)

    @cached_property
    def outliers(self) -> tuple[Outlier, ...]:
        """Rows with less than half of the full robust weight, worst first."""
        return _outliers(self.solved)

    @cached_property
    def noise(self) -> tuple[SensorNoise, ...]:
        """Noise of every sensor whose values are measured rather than given."""
        return _noise(self.solved)

    @property
    def redundancy(self) -> Redundancy:
        """Rank, identifiable parameters and dependencies at the start of the fit."""
        return self.solved.findings.redundancy

    @cached_property
    def pairwise_redundancy(self) -> PairwiseRedundancy:
        """Redundancy by the Pearson correlation of pairs, as in Park et al. 2022."""
        findings = self.solved.findings
        return find_pairwise_redundancy(findings.information, findings.nominal_values)

    @property
    def added_parameters(self) -> tuple[str, ...]:
        """Names of parameters that were added because the data determine them at the solution."""
        names = self.solved.problem.space.names
        return tuple(names[i] for i in self.solved.findings.added_parameters)

    @cached_property
    def weak_directions(self) -> tuple[str, ...]:
        """Sentences about weakly identifiable directions, which remain near their nominal values."""
        return find_weak_directions(self.solved.problem, self.solved.refined_linearisation)

    @cached_property
    def observability(self) -> Observability:
        """Indices O1 to O5 of the free parameters at the solution."""
        problem, here = self.solved.problem, self.solved.refined_linearisation
        gram = sum(
            (part.normal for part in contributions_and_noise_of(here).contributions),
            torch.zeros_like(here.normal),
        )
        usual = problem.step_scale * 1e3  # converted to rows in mm and mrad, and columns per 1 mm and 1 mrad
        poses = int(torch.stack([sensor.present for sensor in problem.sensors]).any(0).sum())
        return observability_of(gram * usual * usual[:, None], poses)

    @property
    def iterations(self) -> int:
        """Number of steps tried."""
        return self.solved.solution.iterations

    @property
    def cost(self) -> float:
        """Cost at the solution: sum of squared residuals divided by variances, with loss and prior."""
        return float(self.solved.refined_linearisation.cost)

    @property
    def status(self) -> SolutionStatus:
        """Reason why the search ended."""
        return self.solved.solution.status

    @cached_property
    def rms_path(self) -> tuple[float, ...]:
        """RMS residual length of the first sensor at the start and at every accepted point [m or rad]."""
        return self.solved.solution.rms_path

    @cached_property
    def warning_details(self) -> tuple[CalibrationWarning, ...]:
        """Warnings about what the measurements do not determine, what to measure next, and what does not fit."""
        return (
            *measurement_advice(self.solved.setup, self.solved.findings.estimated_count),
            *_warnings(self.solved),
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences of the warnings in `warning_details`."""
        return tuple(warning.sentence for warning in self.warning_details)

    @cached_property
    def prior_ratios(self) -> tuple[PriorRatio, ...]:
        """Ratios of estimated errors to their prior standard deviations, by group of parameters with a prior."""
        return prior_ratios_of(self.solved.problem, self.solved.refined_linearisation)

    @property
    def rank(self) -> int:
        """Number of independent combinations of the parameters that the data determine at the nominal geometry.

        Unknowns of sensors are eliminated and not counted.
        """
        return self.redundancy.rank

    @property
    def condition_number(self) -> float:
        """Condition number of the Jacobian of the free parameters, in mm and mrad."""
        return self.observability.condition_number

    @property
    def free_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that were estimated."""
        return tuple(parameter.name for parameter in self.parameters if parameter.free)

    def parameter(self, name: str) -> ParameterEstimate:
        """Return the parameter with the given name.

        Raises:
            KeyError: there is no such parameter.
        """
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise KeyError(name)

    def predicted_poses(self, measurements: Measurements) -> Float64[Tensor, "rows 4 4"]:
        """Return predicted poses of the targets, each in the frame of its row; see `prediction.predicted_poses`."""
        return predicted_poses(self.robot, self.bases, self.tools, measurements)

    def errors_of(self, measurements: Measurements) -> dict[str, Float64[Tensor, "rows components"]]:
        """Compute the errors of measurements, such as held-out rows, in calibrated frames with calibrated targets.

        Returns:
            Measured minus predicted values by sensor [m or rad]; NaN in rows without a value; see
            `pisigma.measurement.sensors.registry.measured_errors`. A socket that was not calibrated is at the mean
            predicted position of its rows.

        Raises:
            IdentificationError: a row has a frame, a target or an anchor that was not calibrated.
        """
        return measured_errors(self.predicted_poses(measurements), measurements, self.sensor_unknowns)


def _warnings(solved: SolvedCalibration) -> tuple[CalibrationWarning, ...]:
    """Return warnings about angles that disagree with lengths, and about frames that do not fit."""
    disagreement = float(contributions_and_noise_of(solved.refined_linearisation).angle_variance_factor.max())
    warnings = []
    if disagreement > _DISAGREEING:
        sentence = (
            "the measured angles disagree with the measured lengths by far more than the noise of either, so the "
            f"weight of the angles was reduced to 1/{disagreement:.2g}; check for a wobbling wrist, or an "
            "orientation error of the sensor that depends on the pose."
        )
        warnings.append(CalibrationWarning("angle_disagreement", "", sentence))
    return (*warnings, *misfitting_frames(solved.problem, solved.refined_linearisation))


def _residuals(solved: SolvedCalibration) -> dict[str, Float64[np.ndarray, "rows components"]]:
    """Return the residuals, rotated back into the measuring frames."""
    measurements, setup, problem = solved.measurements, solved.setup, solved.problem
    R = setup.reference_frames.bases[:, :3, :3].to(problem.frame.device)[problem.frame]
    residuals = {}
    for sensor, part in zip(
        problem.sensors, contributions_and_noise_of(solved.refined_linearisation).contributions, strict=True
    ):
        own = part.residual.t()
        if sensor.components == 3:
            own = (R @ own[..., None])[..., 0]
        values = torch.full((measurements.q.shape[0], sensor.components), torch.nan, dtype=own.dtype)
        values[setup.row_indices.cpu()] = torch.where(sensor.present[:, None], own, torch.nan).cpu()
        residuals[sensor.name] = values.numpy()
    return residuals


def _outliers(solved: SolvedCalibration) -> tuple[Outlier, ...]:
    found = []
    view = contributions_and_noise_of(solved.refined_linearisation)
    for number, (sensor, part) in enumerate(zip(solved.problem.sensors, view.contributions, strict=True)):
        deviations = part.residual_length / view.loss_scales[number]
        weight = solved.problem.loss_for_sensor(sensor).weight(deviations, sensor.components)
        rows = torch.arange(len(weight))
        found += outliers_of(
            solved.setup, solved.measurements, sensor, rows, part.residual.norm(dim=0), deviations, weight
        )
    return tuple(sorted(found, key=lambda outlier: -outlier.residual_in_sigmas))


def _noise(solved: SolvedCalibration) -> tuple[SensorNoise, ...]:
    noise = []
    problem, here = solved.problem, solved.refined_linearisation
    view = contributions_and_noise_of(here)
    used = effective_parameters_by_sensor(view, covariance_of(here.normal)).tolist()
    for k, (sensor, part) in enumerate(zip(problem.sensors, view.contributions, strict=True)):
        if sensor.are_values_given:
            continue
        sigma = float(view.noise[k])
        unit = sensor.unit if sensor.sigma is None else "stated"
        noise.append(
            SensorNoise(
                sensor=sensor.name,
                sigma=sigma,
                unit=unit,
                values=problem.measured_value_counts[k],
                effective_parameters=used[k],
                rms=float(part.rms),
                residual_unit=sensor.unit,
                components=sensor.components,
            )
        )
    return tuple(noise)
