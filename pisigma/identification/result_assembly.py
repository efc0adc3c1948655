"""From a solved problem to a result that can be read: user's coordinates, standard errors, sentences."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.identification.information import Information, information
from pisigma.identification.least_squares import Linearisation, Solution
from pisigma.identification.observability import observability_of
from pisigma.identification.parameters import Prior
from pisigma.identification.problem import ALWAYS_GOOD, CalibrationProblem, covariance_of, view_of
from pisigma.identification.redundancy import Redundancy
from pisigma.identification.result import CalibrationResult, Outlier, ParameterEstimate, SensorNoise
from pisigma.identification.setup import CalibrationSetup
from pisigma.identification.unseen import unseen_directions
from pisigma.measurement.dataset import Measurements
from pisigma.se3 import rotation_from_rpy, rpy_from_rotation, wrap_to_pi


@dataclass(frozen=True, eq=False)
class _Estimate:
    """Parameters in the user's coordinates.

    Attributes:
        bases: per frame, in its own coordinates.
        tools: per target.
        change: d(user's parameters) / d(problem's parameters).
    """

    bases: Float64[Tensor, "frames 6"]
    tools: Float64[Tensor, "targets 6"]
    change: Float64[Tensor, "parameters parameters"]


def assemble_result(
    measurements: Measurements,
    setup: CalibrationSetup,
    problem: CalibrationProblem,
    solution: Solution[Tensor],
    seen: Information,
    sizes: Float64[np.ndarray, " candidates"],
    redundancy: Redundancy,
    extended: list[int],
    prior: Prior | None,
    warnings: tuple[str, ...],
) -> CalibrationResult:
    """Make the result; see `CalibrationResult` for its parts."""
    here = problem.refined(solution.linearisation)
    space, point = problem.space, here.point.cpu()
    estimate = _user_coordinates(setup, point, problem)
    dh = space.split(point)[0].numpy()
    covariance = _covariance(here, problem, estimate)
    active = problem.active.tolist()
    now = information(problem, here.point, active)
    return CalibrationResult(
        robot=space.robot.with_geometry(dh=dh, base=estimate.bases[0].numpy(), tool=estimate.tools[0].numpy()),
        bases={name: base.numpy() for name, base in zip(space.frames, estimate.bases, strict=True)},
        tools={name: tool.numpy() for name, tool in zip(space.targets, estimate.tools, strict=True)},
        parameters=_table(problem, point, estimate, covariance, redundancy, extended),
        covariance=covariance,
        residuals=_residuals(measurements, setup, problem, here),
        outliers=_outliers(measurements, setup, problem, here),
        noise=_noise(problem, here),
        redundancy=redundancy,
        information=seen,
        sizes=sizes,
        extended=tuple(space.names[i] for i in extended),
        unseen=unseen_directions(problem, here, prior is not None),
        observability=observability_of(now, now.names),
        iterations=solution.iterations,
        cost=here.cost,
        status=solution.status,
        rms_path=tuple(_rms(problem, passed) for passed in solution.path),
        warnings=warnings if solution.status.good else (*warnings, f"the search {solution.status.value}."),
    )


def _user_coordinates(setup: CalibrationSetup, point: Tensor, problem: CalibrationProblem) -> _Estimate:
    """Put the anchors back; small turns keep their meaning as rotation vectors, which links both sets of angles."""
    space = problem.space
    _, bases, tools = (part.clone() for part in space.split(point))
    change = torch.eye(len(point), dtype=point.dtype)
    anchors = setup.anchors
    for k, anchor in enumerate(anchors.bases.cpu()):
        axes = turning_axes(bases[k, 3:])
        place = space.arm_size + 6 * k
        bases[k, :3] = anchor[:3, :3] @ bases[k, :3] + anchor[:3, 3]
        bases[k, 3:] = rpy_from_rotation(anchor[:3, :3] @ rotation_from_rpy(bases[k, 3:]))
        change[place : place + 3, place : place + 3] = anchor[:3, :3]
        back = torch.linalg.pinv(turning_axes(bases[k, 3:]), rtol=1e-9)
        change[place + 3 : place + 6, place + 3 : place + 6] = back @ anchor[:3, :3] @ axes
    for k, R_anchor in enumerate(anchors.tools.cpu()):
        axes = turning_axes(tools[k, 3:])
        place = space.arm_size + 6 * (len(space.frames) + k) + 3
        tools[k, 3:] = rpy_from_rotation(rotation_from_rpy(tools[k, 3:]) @ R_anchor)
        back = torch.linalg.pinv(turning_axes(tools[k, 3:]), rtol=1e-9)
        change[place : place + 3, place : place + 3] = back @ axes
    return _Estimate(bases, tools, change)


def turning_axes(rpy: Float64[Tensor, " 3"]) -> Float64[Tensor, "3 3"]:
    """The axes that roll, pitch and yaw turn about, as columns: `RotZ(roll) · RotY(pitch) · RotX(yaw)`."""
    roll, pitch, _ = rpy.unbind()
    zero, one = torch.zeros_like(roll), torch.ones_like(roll)
    z = torch.stack([zero, zero, one])
    y = torch.stack([-roll.sin(), roll.cos(), zero])
    x = torch.stack([roll.cos() * pitch.cos(), roll.sin() * pitch.cos(), -pitch.sin()])
    return torch.stack([z, y, x], 1)


def _covariance(
    here: Linearisation[Tensor], problem: CalibrationProblem, estimate: _Estimate
) -> Float64[np.ndarray, "parameters parameters"]:
    size = len(problem.space.parameters)
    full = torch.zeros(size, size, dtype=torch.float64)
    active = problem.active.cpu()
    full[active[:, None], active] = covariance_of(here.normal).cpu()
    return (estimate.change @ full @ estimate.change.mT).numpy()


def _table(
    problem: CalibrationProblem,
    point: Tensor,
    estimate: _Estimate,
    covariance: np.ndarray,
    redundancy: Redundancy,
    extended: list[int],
) -> tuple[ParameterEstimate, ...]:
    space, robot = problem.space, problem.space.robot
    bases, tools = np.tile(robot.base, (len(space.frames), 1)), np.tile(robot.tool, (len(space.targets), 1))
    nominal = space.values(bases, tools)
    values = torch.cat([point[: space.arm_size], estimate.bases.flatten(), estimate.tools.flatten()])
    change = values - nominal
    angle = torch.tensor([parameter.unit == "rad" for parameter in space.parameters])
    change = torch.where(angle, wrap_to_pi(change), change)
    errors = np.sqrt(np.maximum(covariance.diagonal(), 0))
    active = set(problem.active.tolist())
    rows = []
    for index, parameter in enumerate(space.parameters):
        free = index in active or errors[index] > 0
        remark = _remark(parameter.name, free, index in extended, redundancy)
        numbers = (float(nominal[index]), float(values[index]), float(change[index]))
        error = float(errors[index]) if free else float("nan")
        rows.append(ParameterEstimate(parameter.name, parameter.unit, *numbers, error, remark))
    return tuple(rows)


def _remark(name: str, free: bool, extended: bool, redundancy: Redundancy) -> str:
    if name not in redundancy.names:
        return "fixed"
    if extended:
        return "identified at the solution, though redundant at the nominal geometry"
    if name in redundancy.no_effect:
        return "without effect on what was measured"
    return redundancy.group(name) or ("identified" if free else "left out")


def _residuals(
    measurements: Measurements,
    setup: CalibrationSetup,
    problem: CalibrationProblem,
    here: Linearisation[Tensor],
) -> dict[str, Float64[np.ndarray, "rows components"]]:
    """Residuals turned back into the measuring frames."""
    R = setup.anchors.bases[:, :3, :3].to(problem.frame.device)[problem.frame]
    found = {}
    for sensor, sums in zip(problem.sensors, view_of(here).sums, strict=True):
        own = (R @ sums.residual.t()[..., None])[..., 0]
        values = torch.full((measurements.q.shape[0], sensor.components), torch.nan, dtype=own.dtype)
        values[setup.rows.cpu()] = torch.where(sensor.seen[:, None], own, torch.nan).cpu()
        found[sensor.name] = values.numpy()
    return found


def _outliers(
    measurements: Measurements,
    setup: CalibrationSetup,
    problem: CalibrationProblem,
    here: Linearisation[Tensor],
) -> tuple[Outlier, ...]:
    found = []
    view = view_of(here)
    for sensor, sums, sigma in zip(problem.sensors, view.sums, view.noise, strict=True):
        deviations = sums.distance / max(sigma, ALWAYS_GOOD)
        for k in (problem.loss.weight(deviations, sensor.components) < 0.5).nonzero()[:, 0].tolist():
            row = int(setup.rows[k])
            length = float(sums.residual[:, k].norm())
            found.append(Outlier(row, measurements.place(row), sensor.name, length, float(deviations[k])))
    return tuple(sorted(found, key=lambda outlier: -outlier.deviations))


def _noise(problem: CalibrationProblem, here: Linearisation[Tensor]) -> tuple[SensorNoise, ...]:
    found = []
    view, used = view_of(here), problem.used(here)
    for k, (sensor, sums) in enumerate(zip(problem.sensors, view.sums, strict=True)):
        sigma = view.noise[k]
        if sensor.sigma is not None:
            sigma = problem.loss.deviation(sums.distance[sensor.seen], sensor.components, used[k], 1.0)
        rms = float(sums.residual[:, sensor.seen].square().sum(0).mean().sqrt())
        unit = sensor.unit if sensor.sigma is None else "given"
        found.append(SensorNoise(sensor.name, sigma, unit, problem.values_seen[k], used[k], rms))
    return tuple(found)


def _rms(problem: CalibrationProblem, passed: Linearisation[Tensor]) -> float:
    """Root mean square of the position residuals' lengths [m]."""
    sensor, sums = problem.sensors[0], view_of(passed).sums[0]
    return float(sums.residual[:, sensor.seen].square().sum(0).mean().sqrt())
