"""From a solved problem to a result that can be read: user's coordinates, standard errors, sentences."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.identification.covariance import covariance_of
from pisigma.identification.information import Information
from pisigma.identification.least_squares import Linearisation, Solution
from pisigma.identification.mixed_frames import frames_mixed_up
from pisigma.identification.noise import values_used
from pisigma.identification.observability import observability_of
from pisigma.identification.problem import CalibrationProblem, view_of
from pisigma.identification.redundancy import Redundancy
from pisigma.identification.result import CalibrationResult, Outlier, ParameterEstimate, SensorNoise
from pisigma.identification.setup import CalibrationSetup
from pisigma.identification.unseen import unseen_directions
from pisigma.measurement.dataset import Measurements
from pisigma.se3 import rotation_from_rpy, rpy_from_rotation, wrap_to_pi

HELD = 0.7
"""A parameter whose standard error is more than this share of its prior's is not told by the data."""


@dataclass(frozen=True, eq=False)
class _Estimate:
    """Parameters in the user's coordinates.

    Attributes:
        bases: per frame, in its own coordinates.
        tools: per target.
        sockets: places of the sockets in their frames [m].
        anchors: places of the anchors in their frames, and their zeros [m].
        change: d(user's parameters) / d(problem's parameters).
    """

    bases: Float64[Tensor, "frames 6"]
    tools: Float64[Tensor, "targets 6"]
    sockets: Float64[Tensor, "sockets 3"]
    anchors: Float64[Tensor, "anchors 4"]
    change: Float64[Tensor, "parameters parameters"]


@dataclass(frozen=True, eq=False)
class Findings:
    """What was found out about the parameters on the way.

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


def assemble_result(
    measurements: Measurements,
    setup: CalibrationSetup,
    problem: CalibrationProblem,
    solution: Solution[Tensor],
    findings: Findings,
) -> CalibrationResult:
    """Make the result; see `CalibrationResult` for its parts."""
    here = problem.refined(solution.linearisation)
    space, point = problem.space, here.point.cpu()
    estimate = _user_coordinates(setup, point, problem)
    dh = space.split(point)[0].numpy()
    covariance = _covariance(here, problem, estimate)
    gram = sum((sums.normal for sums in view_of(here).sums), torch.zeros_like(here.normal))
    usual = problem.step_scale * 1e3  # to rows in mm and mrad, columns per 1 mm and 1 mrad
    poses = int(torch.stack([sensor.seen for sensor in problem.sensors]).any(0).sum())
    return CalibrationResult(
        robot=space.robot.with_geometry(
            dh=dh, base=estimate.bases[0].numpy(), tool=estimate.tools[0].numpy()
        ),
        bases={name: base.numpy() for name, base in zip(space.frames, estimate.bases, strict=True)},
        tools={name: tool.numpy() for name, tool in zip(space.targets, estimate.tools, strict=True)},
        sockets={name: place.numpy() for name, place in zip(space.sockets, estimate.sockets, strict=True)},
        anchors={name: end[:3].numpy() for name, end in zip(space.anchors, estimate.anchors, strict=True)},
        zeros={name: float(end[3]) for name, end in zip(space.anchors, estimate.anchors, strict=True)},
        parameters=_table(setup, problem, here, estimate, covariance, findings),
        covariance=covariance,
        residuals=_residuals(measurements, setup, problem, here),
        outliers=_outliers(measurements, setup, problem, here),
        noise=_noise(problem, here),
        redundancy=findings.redundancy,
        information=findings.information,
        sizes=findings.sizes,
        extended=tuple(space.names[i] for i in findings.extended),
        unseen=unseen_directions(problem, here),
        observability=observability_of(gram * usual * usual[:, None], poses),
        iterations=solution.iterations,
        cost=here.cost,
        status=solution.status,
        rms_path=tuple(view_of(passed).sums[0].rms for passed in solution.path),
        warnings=(*findings.warnings, *_warnings(problem, here, solution)),
    )


def _user_coordinates(setup: CalibrationSetup, point: Tensor, problem: CalibrationProblem) -> _Estimate:
    """Put the anchors back; as rotation vectors, small turns mean the same with and without them."""
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
    sockets, ends = space.own(point).sockets.t().clone(), space.own(point).anchors.t().clone()
    for places, numbers, group, size in (
        (sockets, setup.socket_frame, "socket", 3),
        (ends, setup.anchor_frame, "anchor", 4),
    ):
        for k, number in enumerate(numbers.tolist()):
            anchor = anchors.bases[number].cpu()
            places[k, :3] = anchor[:3, :3] @ places[k, :3] + anchor[:3, 3]
            place = space.of(group).start + size * k
            change[place : place + 3, place : place + 3] = anchor[:3, :3]
    return _Estimate(bases, tools, sockets, ends, change)


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


def _warnings(
    problem: CalibrationProblem, here: Linearisation[Tensor], solution: Solution[Tensor]
) -> tuple[str, ...]:
    """Sentences on the search and on a prior that was too narrow."""
    found = []
    if not solution.status.good:
        found.append(f"the search {solution.status.value}.")
    sizes = view_of(here).widening
    units = [problem.space.parameters[i].unit for i in problem.active.tolist()]
    groups = list(zip(units, problem.prior_group.tolist(), strict=True))
    for kind, unit in (("length", "m"), ("angle", "rad")):
        factor = max((sizes[group] for of, group in groups if of == unit), default=1.0)
        if factor > 2 and bool((problem.precision > 0).any()):
            found.append(
                f"the {kind} errors are about {factor:.2g} times as large as the prior says, so their size was "
                "taken from the data; check the nominal geometry and the robot, or give a wider prior."
            )
    return (*found, *frames_mixed_up(problem, here))


def _table(
    setup: CalibrationSetup,
    problem: CalibrationProblem,
    here: Linearisation[Tensor],
    estimate: _Estimate,
    covariance: np.ndarray,
    findings: Findings,
) -> tuple[ParameterEstimate, ...]:
    space, robot = problem.space, problem.space.robot
    bases, tools = np.tile(robot.base, (len(space.frames), 1)), np.tile(robot.tool, (len(space.targets), 1))
    start = _user_coordinates(setup, setup.start.cpu(), problem)
    nominal = space.values(bases, tools, start.sockets.numpy(), start.anchors.numpy())
    arm = here.point.cpu()[: space.arm_size]
    others = (estimate.bases, estimate.tools, estimate.sockets, estimate.anchors)
    values = torch.cat([arm, *(part.flatten() for part in others)])
    change = values - nominal
    angle = torch.tensor([parameter.unit == "rad" for parameter in space.parameters])
    change = torch.where(angle, wrap_to_pi(change), change)
    errors = np.sqrt(np.maximum(covariance.diagonal(), 0))
    held = errors * np.sqrt(_prior_precision(problem, here)) > HELD
    active = set(problem.active.tolist())
    rows = []
    for index, parameter in enumerate(space.parameters):
        free = index in active or bool(errors[index] > 0)
        remark = _remark(parameter.name, free, index in findings.extended, findings.redundancy)
        if free and held[index]:
            remark += "; the data hardly see it, the prior holds it"
        numbers = (float(nominal[index]), float(values[index]), float(change[index]))
        error = float(errors[index]) if free else float("nan")
        rows.append(ParameterEstimate(parameter.name, parameter.unit, *numbers, error, remark))
    return tuple(rows)


def _prior_precision(problem: CalibrationProblem, here: Linearisation[Tensor]) -> np.ndarray:
    """1 / variance of all parameters by the prior, 0 where they are not free."""
    full = torch.zeros_like(problem.precision)
    full[problem.active] = view_of(here).widened(problem.precision[problem.active], problem.prior_group)
    found: np.ndarray = full.cpu().numpy()
    return found


def _remark(name: str, free: bool, extended: bool, redundancy: Redundancy) -> str:
    if name not in redundancy.names:
        return "identified" if free else "fixed"
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
        own = sums.residual.t()
        if sensor.components == 3:
            own = (R @ own[..., None])[..., 0]
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
    for number, (sensor, sums) in enumerate(zip(problem.sensors, view.sums, strict=True)):
        deviations = sums.distance / view.scale(number)
        for k in (
            (problem.loss_of(sensor).weight(deviations, sensor.components) < 0.5).nonzero()[:, 0].tolist()
        ):
            row = int(setup.rows[k])
            length = float(sums.residual[:, k].norm())
            found.append(Outlier(row, measurements.place(row), sensor.name, length, float(deviations[k])))
    return tuple(sorted(found, key=lambda outlier: -outlier.deviations))


def _noise(problem: CalibrationProblem, here: Linearisation[Tensor]) -> tuple[SensorNoise, ...]:
    found = []
    view = view_of(here)
    used = values_used(view, covariance_of(here.normal))
    for k, (sensor, sums) in enumerate(zip(problem.sensors, view.sums, strict=True)):
        sigma = view.noise[k]
        unit = sensor.unit if sensor.sigma is None else "given"
        found.append(SensorNoise(sensor.name, sigma, unit, problem.values_seen[k], used[k], sums.rms))
    return tuple(found)
