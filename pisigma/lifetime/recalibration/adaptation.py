"""A model adapted to new rows: the posterior of all unknowns, its drift by evidence, in rounds of linearisations."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.initial_guess.initial_guess import chosen_rows
from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry, identified_geometry
from pisigma.calibration.hybrid.design import Rows
from pisigma.calibration.hybrid.refinement import linearised, network
from pisigma.estimation.drift import Drift, DriftGroup, DriftSearch, LinearValues
from pisigma.estimation.posterior_update import PosteriorUpdate
from pisigma.estimation.wrong_rows import Explained, with_wrong_rows
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.lifetime.recalibration.recalibration_problem import RecalibrationProblem
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import held_out_groups
from pisigma.measurement.sensors.registry import measured_errors

MOST_ROUNDS = 5
SETTLED = 0.05
"""Rounds end when predicted values move by less than this share of the noise."""
MOST_VALUES = 360
"""Sizes of the drift are estimated from so many values at most; all values count in the end."""
FIRST_NOISE = {"m": 1e-4, "rad": 1e-4}
"""[m or rad] Of sensors that the calibration did not have, to start from."""


@dataclass(frozen=True, eq=False)
class AdaptedArm:
    """Geometry, frames and correction for some values of the unknowns.

    Attributes:
        geometry: in the user's coordinates.
        correction: of the joints; None where the model has none.
    """

    geometry: IdentifiedGeometry
    correction: JointCorrection | None

    @staticmethod
    def at(problem: RecalibrationProblem, x: Float64[Tensor, " unknowns"]) -> "AdaptedArm":
        """Put unknowns of a problem into the arm, parameters counted from `design.problem.nominal`."""
        design = problem.design
        point = design.problem.nominal.index_add(0, design.problem.active, x[: design.active])
        return AdaptedArm(
            identified_geometry(problem.setup, point), network(design, x) if design.features else None
        )

    def errors_of(self, measurements: Measurements) -> dict[str, Float64[Tensor, "rows components"]]:
        """Measured - predicted values of any measurements; see `CalibrationResult.errors_of`."""
        moved = measurements
        if self.correction is not None:
            with torch.no_grad():
                moved = replace(moved, q=moved.q + self.correction.of_rows(moved))
        geometry = self.geometry
        T = predicted_poses(geometry.robot, geometry.bases, geometry.tools, moved)
        return measured_errors(T, measurements, geometry.unknowns)


@dataclass(frozen=True, eq=False)
class Adaptation:
    """A model as new rows have it.

    Attributes:
        problem: that it solves.
        arm: geometry, frames and correction.
        drift: sizes of what has drifted, and the noise.
        shift: change of all unknowns, parameters relative to the anchors.
        effective: how many directions the new rows determine.
        rounds: linearisations made.
        search: the evidence at the solution, for what moved.
        values: all that count at the solution.
    """

    problem: RecalibrationProblem
    arm: AdaptedArm
    drift: Drift
    shift: Float64[Tensor, " unknowns"]
    effective: float
    rounds: int
    search: DriftSearch
    values: LinearValues
    update: PosteriorUpdate = field(repr=False)

    @property
    def wrong_rows(self) -> list[int]:
        """Rows of the measurements that do not count: so far off that the loss drops them, or wrong by evidence."""
        rows: list[int] = self.problem.setup.rows[self.problem.wrong_rows(self.values)].tolist()
        return rows

    @cached_property
    def root(self) -> Float64[Tensor, "unknowns directions"]:
        """Root of the covariance of all unknowns in the user's coordinates, parameters first."""
        root = torch.cat([self.update.root(), self.problem.standing], 1)
        active = self.problem.design.active
        return torch.cat([self.problem.change @ root[:active], root[active:]])

    @property
    def noise(self) -> dict[str, float]:
        """Per sensor, its noise [m or rad], or a factor where the rows state it."""
        names = (sensor.name for sensor in self.problem.design.problem.sensors)
        return dict(zip(names, self.drift.noise.tolist(), strict=True))

    def errors_of(self, measurements: Measurements) -> dict[str, Float64[Tensor, "rows components"]]:
        """Measured - predicted values of any measurements; see `CalibrationResult.errors_of`."""
        return self.arm.errors_of(measurements)


def adapt(
    problem: RecalibrationProblem, usual_noise: Mapping[str, float], start: Drift | None = None
) -> Adaptation:
    """Adapt a model to new rows.

    Args:
        problem: the rows and the prior.
        usual_noise: per sensor, that of the calibration.
        start: sizes and noise to start from, such as those of other rows of the session.
    """
    design, mean = problem.design, problem.mean
    usual = noise_of_sensors(problem, usual_noise)
    group = held_out_groups(problem.setup.measurements)
    x, effective = mean, 0.0
    wrong: Mapping[int, float] = {}
    drift = start or Drift(problem.groups, usual)
    drift = replace(drift, groups=_with_sizes(problem.groups, drift.groups))
    rounds = 0
    while rounds < MOST_ROUNDS:
        rounds += 1
        rows = linearised(design, x, effective, group)
        values = replace(linear_values(problem, rows), wrong=wrong)
        search = _searched(problem, values, drift, usual)
        drift, wrong = search.drift, search.values.wrong
        values = replace(values, wrong=wrong)
        update = PosteriorUpdate(problem.root, values, drift)
        step = values.X @ (mean + update.shift - x) / values.deviation(drift.noise)
        x, effective = mean + update.shift, update.effective
        if float(step.square().mean().sqrt()) < SETTLED:
            break
    return Adaptation(
        problem=problem,
        arm=AdaptedArm.at(problem, x),
        drift=drift,
        shift=update.shift,
        effective=effective,
        rounds=rounds,
        search=search,
        values=values,
        update=update,
    )


def noise_of_sensors(
    problem: RecalibrationProblem, usual_noise: Mapping[str, float]
) -> Float64[Tensor, " sensors"]:
    """Usual noise of all sensors of a problem [m or rad], or a factor where the rows state it."""
    return torch.tensor(
        [
            usual_noise.get(sensor.name, 1.0 if sensor.sigma is not None else FIRST_NOISE[sensor.unit])
            for sensor in problem.design.problem.sensors
        ],
        dtype=torch.float64,
    )


def linear_values(problem: RecalibrationProblem, rows: Rows) -> LinearValues:
    """Put the values of all sensors together, their residuals those of the model."""
    X, y, sensor, configuration = [], [], [], []
    for number, one in enumerate(rows.values):
        columns = (problem.design.columns(one, slice(None)) * one.root[:, None, None]).flatten(0, 1)
        X.append(columns)
        y.append((one.residual * one.root[:, None]).flatten() - columns @ problem.mean)
        sensor.append(torch.full((len(columns),), number))
        configuration.append(problem.configuration[one.row].repeat_interleave(one.components))
    return LinearValues(torch.cat(X), torch.cat(y), torch.cat(sensor), torch.cat(configuration), rows.sensors)


def _with_sizes(groups: tuple[DriftGroup, ...], like: tuple[DriftGroup, ...]) -> tuple[DriftGroup, ...]:
    """The groups with the sizes that those of the same names have."""
    sizes = {one.what: one.size for one in like}
    return tuple(one if one.fixed_size else replace(one, size=sizes.get(one.what, 0.0)) for one in groups)


def _searched(
    problem: RecalibrationProblem, values: LinearValues, drift: Drift, usual: Float64[Tensor, " sensors"]
) -> DriftSearch:
    """The sizes of the drift and the wrong rows by evidence, of some of the values where there are many."""
    if len(values.y) > MOST_VALUES:
        values = values.select(chosen_rows(len(values.y), MOST_VALUES).sort().values)
    A = values.X @ problem.root

    def explain(wrong: Mapping[int, float]) -> Explained[DriftSearch]:
        there = replace(values, wrong=wrong)
        search = DriftSearch(there, A, drift.groups, drift.noise, usual)
        search.estimate()
        return Explained(search, there, search.log_evidence, search.covariance, search.deviation)

    return with_wrong_rows(explain(values.wrong), explain).what
