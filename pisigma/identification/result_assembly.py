"""From a solved problem to a result that can be read: user's coordinates, standard errors, sentences."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.identification.identifiability.observability import find_weak_directions, observability_of
from pisigma.identification.identifiability.pairwise import find_pairwise_redundancy
from pisigma.identification.identifiability.plausibility import misfitting_frames
from pisigma.identification.identifiability.redundancy import Redundancy
from pisigma.identification.problem.information import Information
from pisigma.identification.problem.least_squares import Linearisation, Solution, covariance_of
from pisigma.identification.problem.noise import effective_parameters, values_used, view_of
from pisigma.identification.problem.problem import CalibrationProblem
from pisigma.identification.problem.setup import (
    CalibrationSetup,
    IdentifiedGeometry,
    identified_geometry,
    unknowns_in_frames,
)
from pisigma.identification.result import CalibrationResult, Outlier, ParameterEstimate, SensorNoise
from pisigma.measurement.dataset import Measurements
from pisigma.robot.row import FRAME_COLUMNS
from pisigma.se3 import wrap_to_pi

LOST = 1e-10
"""Information, columns scaled to 1, with a smaller eigenvalue does not determine some direction."""
UNUSUAL = 4.0
"""Errors that are surely more than so many times as large as the prior says are worth a warning. Healthy
robots have up to 4.6 times the default prior of 1 mrad. The estimate from n parameters has a relative standard
deviation of about `1 / sqrt(2 n)`, so `exp(-sqrt(2 / n))` times the estimate is two of these below it."""
HELD = 0.7
"""A parameter whose standard error is more than this share of its prior's is not determined by the data."""


@dataclass(frozen=True, eq=False)
class Findings:
    """What the rank analysis says about the parameters.

    Attributes:
        information: the condensed Jacobian of the candidates at the start.
        sizes: their values there.
        redundancy: what follows from both.
        extended: indices of parameters that were added later.
        warnings: sentences so far.
    """

    information: Information
    sizes: Float64[np.ndarray, " candidates"]
    redundancy: Redundancy
    extended: list[int]
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class SolvedCalibration:
    """A calibration problem with its solution.

    Attributes:
        measurements: all rows, also those that could not be used.
        setup: start, and what base and tool are relative to.
        problem: with its free parameters.
        solution: of it.
        findings: on the parameters.
    """

    measurements: Measurements
    setup: CalibrationSetup
    problem: CalibrationProblem
    solution: Solution[Tensor]
    findings: Findings

    def result(self) -> CalibrationResult:
        """The calibration in the user's coordinates; see `CalibrationResult` for its fields."""
        problem, findings, solution = self.problem, self.findings, self.solution
        here = problem.refined(solution.linearisation)
        geometry = identified_geometry(self.setup, here.point)
        covariance = _covariance(here, problem, geometry)
        gram = sum((sums.normal for sums in view_of(here).sums), torch.zeros_like(here.normal))
        usual = problem.step_scale * 1e3  # to rows in mm and mrad, columns per 1 mm and 1 mrad
        poses = int(torch.stack([sensor.present for sensor in problem.sensors]).any(0).sum())
        return CalibrationResult(
            robot=geometry.robot,
            bases=geometry.bases,
            tools=geometry.tools,
            unknowns=geometry.unknowns,
            parameters=_table(self, here, geometry, covariance),
            covariance=covariance,
            residuals=_residuals(self, here),
            outliers=_outliers(self, here),
            noise=_noise(problem, here),
            redundancy=findings.redundancy,
            pairwise=find_pairwise_redundancy(findings.information, findings.sizes),
            extended=tuple(problem.space.names[i] for i in findings.extended),
            weak_directions=find_weak_directions(problem, here),
            observability=observability_of(gram * usual * usual[:, None], poses),
            iterations=solution.iterations,
            cost=here.cost,
            status=solution.status,
            rms_path=tuple(view_of(passed).sums[0].rms for passed in solution.path),
            warnings=(*findings.warnings, *_warnings(self, here)),
        )


def _covariance(
    here: Linearisation[Tensor], problem: CalibrationProblem, geometry: IdentifiedGeometry
) -> Float64[np.ndarray, "parameters parameters"]:
    size = len(problem.space.parameters)
    full = torch.zeros(size, size, dtype=torch.float64)
    active = problem.active.cpu()
    full[active[:, None], active] = covariance_of(here.normal).cpu()
    return (geometry.change @ full @ geometry.change.mT).numpy()


def _warnings(solved: SolvedCalibration, here: Linearisation[Tensor]) -> tuple[str, ...]:
    """Sentences on the search, on errors far larger than the prior, and on frames that do not fit."""
    problem, status = solved.problem, solved.solution.status
    sentences = [] if status.good else [f"the search {status.value}."]
    view, group = view_of(here), problem.prior_group
    precision = problem.precision[problem.active]
    effective = effective_parameters(precision, group, view, covariance_of(here.normal))
    units = [problem.space.parameters[i].unit for i in problem.active[precision > 0].tolist()]
    groups = set(zip(group[precision > 0].tolist(), units, strict=True))
    for kind, unit in (("length", "m"), ("angle", "rad")):
        factors = [
            view.prior_scale[number]
            for number, of in groups
            if of == unit and effective[number] > 0
            if view.prior_scale[number] * math.exp(-((2 / effective[number]) ** 0.5)) > UNUSUAL
        ]
        if factors:
            sentences.append(
                f"the {kind} errors are about {max(factors):.2g} times as large as the prior says, so their size was "
                "taken from the data; check the nominal geometry and the robot, or give a wider prior."
            )
    return (*sentences, *misfitting_frames(problem, here))


def _table(
    solved: SolvedCalibration,
    here: Linearisation[Tensor],
    geometry: IdentifiedGeometry,
    covariance: np.ndarray,
) -> tuple[ParameterEstimate, ...]:
    setup, problem, findings = solved.setup, solved.problem, solved.findings
    space, robot = problem.space, problem.space.robot
    bases, tools = np.tile(robot.base, (len(space.frames), 1)), np.tile(robot.tool, (len(space.targets), 1))
    nominal = space.values(bases, tools, unknowns_in_frames(setup, setup.start))
    values = geometry.values()
    change = values - nominal
    angle = torch.tensor([parameter.unit == "rad" for parameter in space.parameters])
    change = torch.where(angle, wrap_to_pi(change), change)
    errors = np.sqrt(np.maximum(covariance.diagonal(), 0))
    held = errors * np.sqrt(_prior_precision(problem, here)) > HELD
    active = set(problem.active.tolist())
    silent = _without_rows(problem, here.normal.cpu(), findings)
    undetermined = (geometry.change[:, silent] != 0).any(1).tolist()
    rows = []
    columns = (nominal.tolist(), values.tolist(), change.tolist())
    for index, (parameter, before, after, moved) in enumerate(zip(space.parameters, *columns, strict=True)):
        free = index in active or bool(errors[index] > 0)
        remark, label = _remark(parameter.name, free, index in findings.extended, findings.redundancy)
        if free and held[index]:
            remark += "; the data hardly determine it, the prior holds it"
            label = "held by the prior" if label == "identified" else f"{label}; prior"
        if undetermined[index]:
            free, label = False, "outliers"
            remark = "too few rows that count show it, the others are outliers"
        error = float(errors[index]) if free else float("nan")
        name, unit = parameter.name, parameter.unit
        rows.append(ParameterEstimate(name, unit, before, after, moved, error, remark, label))
    return tuple(rows)


def _without_rows(
    problem: CalibrationProblem, normal: Float64[Tensor, "active active"], findings: Findings
) -> list[int]:
    """Free parameters that the rows left over do not hold: those that none shows, and bases not wholly determined.

    Not those that all rows together would not show either.
    """
    active = problem.active.cpu()
    names = [problem.space.names[i] for i in active.tolist()]
    shown = torch.tensor([name not in findings.redundancy.no_effect for name in names], dtype=torch.bool)
    lost = (normal.diagonal() <= 0) & shown
    bases = problem.space.of("base")
    for start in range(bases.start, bases.stop, len(FRAME_COLUMNS)):
        own = ((active >= start) & (active < start + len(FRAME_COLUMNS)) & shown).nonzero()[:, 0]
        at_start = findings.information
        columns = [at_start.names.index(names[k]) for k in own.tolist()]
        J = torch.from_numpy(at_start.jacobian[:, columns])
        if len(own) and _determines_all(J.t() @ J) and not _determines_all(normal[own[:, None], own]):
            lost[own] = True
    indices: list[int] = active[lost].tolist()
    return indices


def _determines_all(information: Float64[Tensor, "own own"]) -> bool:
    """Whether information holds its parameters in every direction."""
    scale = information.diagonal().clamp(min=1e-300).rsqrt()
    return float(torch.linalg.eigvalsh(information * scale * scale[:, None])[0]) >= LOST


def _prior_precision(problem: CalibrationProblem, here: Linearisation[Tensor]) -> np.ndarray:
    """1 / variance of all parameters by the prior, 0 where they are not free."""
    full = torch.zeros_like(problem.precision)
    full[problem.active] = view_of(here).scaled(problem.precision[problem.active], problem.prior_group)
    precision: np.ndarray = full.cpu().numpy()
    return precision


def _remark(name: str, free: bool, extended: bool, redundancy: Redundancy) -> tuple[str, str]:
    """What is to be said of a parameter, in full and in a few words."""
    if name not in redundancy.names:
        remark = "identified" if free else "fixed"
        return remark, remark
    if extended:
        remark = "identified at the solution, though redundant at the nominal geometry"
        return remark, "only at solution"
    if name in redundancy.no_effect:
        return "without effect on what was measured", "no effect"
    if (sentence := redundancy.group(name)) is not None:
        return sentence, "in a sum"
    remark = "identified" if free else "left out"
    return remark, remark


def _residuals(
    solved: SolvedCalibration, here: Linearisation[Tensor]
) -> dict[str, Float64[np.ndarray, "rows components"]]:
    """Residuals turned back into the measuring frames."""
    measurements, setup, problem = solved.measurements, solved.setup, solved.problem
    R = setup.anchors.bases[:, :3, :3].to(problem.frame.device)[problem.frame]
    residuals = {}
    for sensor, sums in zip(problem.sensors, view_of(here).sums, strict=True):
        own = sums.residual.t()
        if sensor.components == 3:
            own = (R @ own[..., None])[..., 0]
        values = torch.full((measurements.q.shape[0], sensor.components), torch.nan, dtype=own.dtype)
        values[setup.rows.cpu()] = torch.where(sensor.present[:, None], own, torch.nan).cpu()
        residuals[sensor.name] = values.numpy()
    return residuals


def _outliers(solved: SolvedCalibration, here: Linearisation[Tensor]) -> tuple[Outlier, ...]:
    measurements, setup, problem = solved.measurements, solved.setup, solved.problem
    outliers = []
    view = view_of(here)
    for number, (sensor, sums) in enumerate(zip(problem.sensors, view.sums, strict=True)):
        deviations = sums.distance / view.scale(number)
        for k in (
            (problem.loss_of(sensor).weight(deviations, sensor.components) < 0.5).nonzero()[:, 0].tolist()
        ):
            row = int(setup.rows[k])
            length = float(sums.residual[:, k].norm())
            outliers.append(
                Outlier(row, measurements.place(row), sensor.name, length, float(deviations[k]), sensor.unit)
            )
    return tuple(sorted(outliers, key=lambda outlier: -outlier.deviations))


def _noise(problem: CalibrationProblem, here: Linearisation[Tensor]) -> tuple[SensorNoise, ...]:
    noise = []
    view = view_of(here)
    used = values_used(view, covariance_of(here.normal))
    for k, (sensor, sums) in enumerate(zip(problem.sensors, view.sums, strict=True)):
        sigma = view.noise[k]
        unit = sensor.unit if sensor.sigma is None else "stated"
        noise.append(
            SensorNoise(
                sensor=sensor.name,
                sigma=sigma,
                unit=unit,
                values=problem.values_measured[k],
                used=used[k],
                rms=sums.rms,
                quantity=sensor.unit,
                components=sensor.components,
            )
        )
    return tuple(noise)
