"""Reasons why a hand-eye calibration does not fit: the camera, the board, the arm or the joint readings."""

import math

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.frames.arm_uncertainty import ArmUncertainty
from pisigma.calibration.frames.frame_fit import FrameFit
from pisigma.calibration.frames.whitened_values import WhitenedValues
from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.noise import contributions_and_noise_of
from pisigma.calibration.geometric.result import SolvedCalibration
from pisigma.calibration.hybrid.sensor_values import joint_value_parameters
from pisigma.estimation.alternatives import Cause, FitResiduals
from pisigma.estimation.loss import SquaredLoss
from pisigma.measurement.camera.camera import INTRINSICS, USUAL_DEVIATIONS
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.intrinsics import (
    INTRINSICS_COLUMN,
    SCALE_COLUMN,
    ImageIntrinsics,
    boards,
    cameras,
    texts_of,
    without_stated_priors,
)
from pisigma.measurement.sensors.sensor import distinct_names

_UNIT = 1e-3
"""Errors of arm and joints [m or rad], and of the board as a share, at size 1: 1 mm, 1 mrad, 0.1 %."""
_CAMERA_UNIT = 3.0
"""Errors of the intrinsics at size 1, in standard deviations of a typical calibration."""
_MIN_ROWS = 6
"""Number of rows below which causes are not compared: six rows have 36 values, of which base and tool absorb 12."""

CAUSES = {
    "arm": "arm (lengths, angles and zeros of all joints)",
    "joint zeros": "joint readings (zeros)",
    "joint noise": "joint readings (noise or timing)",
    "camera": "camera (intrinsics and distortion)",
    "board": "board (scale)",
}
"""Part of the setup that each cause concerns."""


def misfit_causes(fit: FrameFit, uncertainty: ArmUncertainty | None = None) -> tuple[Cause, ...]:
    """Compare the possible causes of the residuals of a hand-eye calibration.

    The cause "joint noise" stands for errors of the joint readings that differ from row to row: noise, backlash, or a
    delay between the image and the reading. Camera and board can be distinguished from the arm only with the corners of
    images.

    Args:
        fit: base and tool that were fitted with the arm held fixed.
        uncertainty: uncertainty of the arm, if a calibration states it; the arm is a cause only if its errors are
            larger.

    Returns:
        The causes, those supported by the evidence first; none if there are fewer than `_MIN_ROWS` poses.
    """
    rows = fit.rows.select(torch.tensor(fit.used_rows))
    if fit.frame_choice != "hand-eye" or rows.rows < _MIN_ROWS or not fit.solved.problem.needs_rotation:
        return ()
    counted = {"camera": set(cameras(rows) or ()), "board": set(boards(rows) or ())}
    robot = fit.solved.problem.space.robot
    calibrator = GeometricCalibrator(robot, free=(), prior=None, loss=SquaredLoss())
    solved = calibrator.solve(without_stated_priors(rows, counted))
    return _residuals(solved, fit, rows, uncertainty).compare()


def _residuals(
    solved: SolvedCalibration, fit: FrameFit, rows: Measurements, uncertainty: ArmUncertainty | None
) -> FitResiduals:
    """Return the residuals with the stated intrinsics, linearised in everything that may cause them."""
    space, setup = solved.problem.space, solved.setup
    unknowns = setup.free_unknowns
    arm = list(range(space.arm_parameter_count))
    frames = [*space.indices_of("base"), *space.indices_of("tool")]
    values = WhitenedValues.at_solution(solved, [*arm, *frames, *unknowns])
    X_arm, X_frames, X_unknowns = torch.split(values.X, [len(arm), len(frames), len(unknowns)], 1)
    moved = solved.solution.linearisation.point[unknowns] - setup.start[unknowns]
    unit = _noise_units(solved, values)
    zeros = X_arm[:, joint_value_parameters(space)]
    causes = {"arm": _UNIT * X_arm, "joint zeros": _UNIT * zeros, "joint noise": _UNIT * _per_row(values)}
    groups = [space.parameters[index].group for index in unknowns]
    for kind in ("camera", "board"):
        chosen = [k for k, group in enumerate(groups) if group == kind]
        if chosen:
            sizes = [_usual_error(kind, space.names[unknowns[k]]) for k in chosen]
            causes[kind] = X_unknowns[:, chosen] * torch.tensor(sizes, dtype=torch.float64)
    known = X_unknowns * _stated_deviations(solved, rows)
    if uncertainty is not None:
        known = torch.cat(
            [known, uncertainty.value_covariance_root(solved, fit.used_rows, {*frames, *unknowns})], 1
        )
    return FitResiduals.from_fit(
        y=unit * (values.y + X_unknowns @ moved),
        fitted_columns=unit[:, None] * X_frames,
        stated_covariance_root=unit[:, None] * known,
        has_exact_noise=values.has_exact_noise,
        has_stated_noise=bool(rows.is_measured("corner").any()),
        causes={name: unit[:, None] * Z for name, Z in causes.items()},
    )


def _usual_error(kind: str, name: str) -> float:
    """Return the error of an unknown of a camera or a board at size 1."""
    if kind == "board":
        return _UNIT
    return _CAMERA_UNIT * USUAL_DEVIATIONS[INTRINSICS.index(name.rsplit("_", 1)[-1])]


def _noise_units(solved: SolvedCalibration, values: WhitenedValues) -> Float64[Tensor, " values"]:
    """Return the factors that undo the estimated noise in rows that state their own noise (corners of images)."""
    deviation = contributions_and_noise_of(solved.refined_linearisation).variances.sqrt()
    noise = solved.setup.measurements.readings.get("corner_noise")
    factors = []
    for (one, _), sigma in zip(values.sensors, deviation, strict=True):
        factor = torch.ones(len(one.row), dtype=torch.float64)
        if one.name == "corner" and isinstance(noise, Tensor):
            factor = float(sigma) / noise[one.row]
        factors.append(factor.repeat_interleave(one.components))
    return torch.cat(factors)


def _per_row(values: WhitenedValues) -> Float64[Tensor, "values _joints"]:
    """Return the derivatives with respect to the joint values of every row separately."""
    rows, dof = int(values.row.max()) + 1, values.joint_derivatives.shape[1]
    columns = values.joint_derivatives.new_zeros(len(values.y), rows, dof)
    columns[torch.arange(len(values.y)), values.row] = values.joint_derivatives
    return columns.flatten(1)


def _stated_deviations(solved: SolvedCalibration, rows: Measurements) -> Float64[Tensor, " unknowns"]:
    """Return the stated standard deviation of every unknown of cameras and boards; 0 where none is stated."""
    space, unknowns = solved.problem.space, solved.setup.free_unknowns
    images = ImageIntrinsics.from_csv_cells(texts_of(rows, INTRINSICS_COLUMN))
    stated = {
        ("camera", name): images.prior_sigma[(cameras(rows) or ()).index(name)].tolist()
        for name in distinct_names(cameras(rows))
    }
    for name in distinct_names(boards(rows)):
        text = texts_of(rows, SCALE_COLUMN)[(boards(rows) or ()).index(name)]
        stated["board", name] = [float(text) if text else 0.0]
    columns = {own.name: own.columns for own in space.unknowns}
    deviations = []
    for one in (space.parameters[index] for index in unknowns):
        known = stated.get((one.group, one.owner))
        number = columns[one.group].index(one.name.rsplit("_", 1)[-1])
        deviations.append(0.0 if known is None else known[number])
    return torch.tensor(deviations, dtype=torch.float64)


def size_text(cause: Cause) -> str:
    """Describe the size of a cause."""
    error = cause.size * _UNIT
    if cause.name == "camera":
        return f"{cause.size * _CAMERA_UNIT:.2g} times the error of a typical calibration"
    if cause.name == "board":
        return f"{error * 100:.2g} %"
    angle = f"{math.degrees(error):.2g} deg"
    return f"{error * 1e3:.2g} mm, {angle}" if cause.name == "arm" else angle
