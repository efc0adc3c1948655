"""Estimated parameters with standard errors and a remark, and the sizes of their errors compared with the prior."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.identifiability.redundancy import RankFindings, Redundancy
from pisigma.calibration.geometric.problem.least_squares import Linearisation, covariance_of
from pisigma.calibration.geometric.problem.noise import contributions_and_noise_of
from pisigma.calibration.geometric.problem.prior_scales import LENGTH_GROUPS, PriorGroup, effective_parameters
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.calibration.geometric.problem.setup import (
    CalibrationSetup,
    IdentifiedGeometry,
    unknowns_in_frames,
)
from pisigma.robot.row import FRAME_COLUMNS
from pisigma.robot.se3 import wrap_to_pi


@dataclass(frozen=True)
class PriorRatio:
    """Ratio of the estimated size of the errors of a group of parameters to their prior standard deviation.

    Attributes:
        kind: "length" or "angle".
        group: the group of parameters.
        smallest_prior_sigma: smallest prior standard deviation of a parameter of the group [m or rad].
        value: the estimated ratio [1].
        lower_bound: the ratio minus two standard deviations. An estimate from n effective parameters has a relative
            standard deviation of about `1 / sqrt(2 n)`, so this is `exp(-sqrt(2 / n))` times the estimate.
    """

    kind: Literal["length", "angle"]
    group: PriorGroup
    smallest_prior_sigma: float
    value: float
    lower_bound: float

    @property
    def error_sigma(self) -> float:
        """Estimated standard deviation of the errors [m or rad]."""
        return self.value * self.smallest_prior_sigma

    @property
    def error_sigma_lower_bound(self) -> float:
        """The estimated standard deviation of the errors minus two of its own standard deviations [m or rad]."""
        return self.lower_bound * self.smallest_prior_sigma


def prior_ratios_of(
    problem: CalibrationProblem, linearisation: Linearisation[Tensor]
) -> tuple[PriorRatio, ...]:
    """Return the ratios of all groups of parameters with a prior.

    Args:
        problem: the problem with its free parameters.
        linearisation: the problem linearised at its solution.
    """
    view = contributions_and_noise_of(linearisation)
    precision, group = problem.precision[problem.active], problem.prior_group
    effective = effective_parameters(
        precision, group, view.prior_scale, covariance_of(linearisation.normal)
    ).tolist()
    ratios = []
    for number in sorted(set(group[precision > 0].tolist())):
        if effective[number] > 0:
            scale = float(view.prior_scale[number])
            prior = float(precision[(group == number) & (precision > 0)].max()) ** -0.5
            at_least = scale * math.exp(-((2 / effective[number]) ** 0.5))
            kind: Literal["length", "angle"] = "length" if number in LENGTH_GROUPS else "angle"
            ratios.append(PriorRatio(kind, PriorGroup(number), prior, scale, at_least))
    return tuple(ratios)


LOST = 1e-10
"""Eigenvalue of the scaled information (unit diagonal) below which a direction is undetermined."""
_IN_A_SUM = 1e-3
"""Component of an undetermined direction, relative to the largest one in mm and mrad, above which it contains a
coordinate of a base."""
_HELD = 0.7
"""Ratio of standard error to prior standard deviation above which the data hardly determine a parameter."""


@dataclass(frozen=True)
class ParameterEstimate:
    """One row of the parameter table, in SI units.

    Attributes:
        name: name of the parameter, such as "theta_1".
        unit: "m" or "rad".
        nominal: nominal value.
        estimated: estimated value.
        change: estimated minus nominal value.
        standard_error: standard error of the estimate; NaN if it was not estimated.
        remark: "identified", the combination that is identified, or the reason why it was not estimated.
        short_remark: the remark in a few words, for tables.
    """

    name: str
    unit: str
    nominal: float
    estimated: float
    change: float
    standard_error: float
    remark: str
    short_remark: str

    @property
    def free(self) -> bool:
        """Whether the parameter was estimated."""
        return not np.isnan(self.standard_error)


def parameter_table(
    setup: CalibrationSetup,
    problem: CalibrationProblem,
    findings: RankFindings,
    linearisation: Linearisation[Tensor],
    geometry: IdentifiedGeometry,
    covariance: Float64[np.ndarray, "parameters parameters"],
) -> tuple[ParameterEstimate, ...]:
    """Return all parameters with their nominal and estimated values, standard errors and a remark.

    Args:
        setup: the problem at its start.
        problem: the problem with its free parameters.
        findings: result of the rank analysis.
        linearisation: linearisation of the problem at the solution.
        geometry: the solution in the user's coordinates.
        covariance: covariance of all parameters in the user's coordinates.
    """
    space, robot = problem.space, problem.space.robot
    bases, tools = np.tile(robot.base, (len(space.frames), 1)), np.tile(robot.tool, (len(space.targets), 1))
    nominal = space.values(bases, tools, unknowns_in_frames(setup, setup.start))
    values = geometry.values_of(space)
    change = values - nominal
    angle = torch.tensor([parameter.unit == "rad" for parameter in space.parameters])
    change = torch.where(angle, wrap_to_pi(change), change)
    errors = np.sqrt(np.maximum(covariance.diagonal(), 0))
    held = errors * np.sqrt(_prior_precision(problem, linearisation)) > _HELD
    active = set(problem.active.tolist())
    silent = _without_rows(problem, linearisation.normal.cpu(), findings)
    undetermined = (geometry.coordinate_jacobian[:, silent] != 0).any(1).tolist()
    sums = _sums_with_bases(problem, findings, geometry)
    rows = []
    columns = (nominal.tolist(), values.tolist(), change.tolist())
    for index, (parameter, before, after, moved) in enumerate(zip(space.parameters, *columns, strict=True)):
        free = index in active or bool(errors[index] > 0)
        remark, label = _remark(parameter.name, free, index in findings.added_parameters, findings.redundancy)
        if free and label == "identified" and index in sums:
            remark, label = f"identified only in a sum with {' and '.join(sums[index])}", "in a sum"
        if free and held[index]:
            remark += "; the data hardly determine it, so it stays near its prior value"
            label = "held by the prior" if label == "identified" else f"{label}; prior"
        if undetermined[index]:
            free, label = False, "outliers"
            remark = "too few rows determine it, because the others are outliers"
        error = float(errors[index]) if free else float("nan")
        name, unit = parameter.name, parameter.unit
        rows.append(ParameterEstimate(name, unit, before, after, moved, error, remark, label))
    return tuple(rows)


def _sums_with_bases(
    problem: CalibrationProblem, findings: RankFindings, geometry: IdentifiedGeometry
) -> dict[int, list[str]]:
    """Return the removed parameters on which coordinates of bases depend, by the index of the coordinate.

    The dependencies are those in the axes of the robot's base; here they are converted to those of the measuring frame.
    """
    space, redundancy = problem.space, findings.redundancy
    extended = {space.names[index] for index in findings.added_parameters}
    left = [name for name in redundancy.removed if name not in extended]
    unchanged = torch.zeros(len(space.parameters), len(left), dtype=torch.float64)
    for number, name in enumerate(left):
        unchanged[space.index(name), number] = 1.0
    for one in redundancy.dependencies:
        for name, coefficient in zip(one.names[1:], one.coefficients[1:], strict=True):
            if name in left:
                unchanged[space.index(one.names[0]), left.index(name)] = -coefficient
    shift = (geometry.coordinate_jacobian @ unchanged) / torch.from_numpy(space.usual_errors)[:, None]
    parts = shift.abs() > _IN_A_SUM * shift.abs().amax(0, keepdim=True)
    return {
        index: [name for name, part in zip(left, parts[index].tolist(), strict=True) if part]
        for index in space.indices_of("base")
        if bool(parts[index].any())
    }


def _without_rows(
    problem: CalibrationProblem, normal: Float64[Tensor, "active active"], findings: RankFindings
) -> list[int]:
    """Return free parameters that the rows without outliers do not determine, although all rows together would.

    These are parameters without effect in the rows without outliers, and bases that they determine only partially.
    """
    active = problem.active.cpu()
    names = [problem.space.names[i] for i in active.tolist()]
    shown = torch.tensor([name not in findings.redundancy.no_effect for name in names], dtype=torch.bool)
    lost = (normal.diagonal() <= 0) & shown
    bases = problem.space.indices_of("base")
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
    """Return whether an information matrix determines its parameters in every direction."""
    scale = information.diagonal().clamp(min=1e-300).rsqrt()
    return float(torch.linalg.eigvalsh(information * scale * scale[:, None])[0]) >= LOST


def _prior_precision(problem: CalibrationProblem, linearisation: Linearisation[Tensor]) -> np.ndarray:
    """Return the prior precision (1 / variance) of all parameters; 0 for parameters that are not free."""
    full = torch.zeros_like(problem.precision)
    full[problem.active] = contributions_and_noise_of(linearisation).scaled_precision(
        problem.precision[problem.active], problem.prior_group
    )
    precision: np.ndarray = full.cpu().numpy()
    return precision


def _remark(name: str, free: bool, extended: bool, redundancy: Redundancy) -> tuple[str, str]:
    """Return the remark on a parameter, as a clause and in a few words."""
    if name not in redundancy.names:
        remark = "identified" if free else "fixed"
        return remark, remark
    if extended:
        remark = "identified at the solution, though redundant at the nominal geometry"
        return remark, "only at solution"
    if name in redundancy.no_effect:
        return "without effect on the measured values", "no effect"
    if (sentence := redundancy.dependency_sentence_of(name)) is not None:
        return sentence, "in a sum"
    remark = "identified" if free else "left out"
    return remark, remark
