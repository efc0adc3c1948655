"""Check whether the errors of held-out rows are far larger than the errors of calibrated robots."""

import math
from collections.abc import Iterator

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.registry import SENSORS
from pisigma.robot.frame_fits import best_base_and_tool
from pisigma.robot.robot_class import SERVO, plausible_error_per_reach
from pisigma.validation.checks.check import FITTED_PARAMETERS, CheckedCalibration, RowsUnderModel
from pisigma.validation.checks.rounding import joint_rounding
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.setup_faults import unexplained_diagnostic

_LARGE = 1e-3
"""Size of errors, as a share of the reach, above which calibration must have reduced them; measured arms (UR5, UR10,
FANUC, Panda, FR3) have 2e-4 to 6e-4."""
_HARDLY = 1.3
"""Ratio of the errors of the nominal and the calibrated robot below which the calibration hardly helped."""
_NOISE = 0.5
"""Share of the errors above which the stated noise of the sensor explains them."""


def check_unexplained(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Compare the errors of held-out positions, or else of the calibration, with those of calibrated robots.

    Errors that other checks explain are not reported again; for example, rounded joint values are errors of the
    rows, not of the robot.
    """
    if not set(checked.rows.kinds) <= {"position", "rotation"}:
        return
    figures = checked.figures if checked.validation is None else checked.validation.figures()
    errors = {} if figures is None else {name: one.rms_mm for name, one in figures.models.items()}
    left, nominal = list(errors.values())[-1] if errors else None, errors.get("nominal")
    if left is None or nominal is None or _explained(checked, left):
        return
    reach = checked.robot.reach * 1e3
    usual = checked.robot_class
    far = left > usual.max_calibrated_error_per_reach * reach
    large = _LARGE if usual is not SERVO else usual.max_calibrated_error_per_reach
    if far or (left > large * reach and nominal < _HARDLY * left):
        what = "rows of the calibration" if checked.validation is None else "held-out rows"
        yield Diagnostic(
            kind="unexplained",
            severity="implausible",
            sentence=f"The errors of the {what} are {left:.3g} mm RMS ({nominal:.3g} mm for the nominal robot), but "
            f"robots of class {usual.name} and this size have less than "
            f"{(usual.max_calibrated_error_per_reach if far else large) * reach:.2g} mm after a "
            f"calibration{'' if far else ', and calibration hardly helped'}. Mixed populations, a moved frame "
            "or tool, joint values that were logged too early or rounded, and a wrong scale do not explain "
            "them; check the sensor, and what else differs between the rows.",
            values={"rms_mm": left, "nominal_rms_mm": nominal},
        )


def _explained(checked: CheckedCalibration, left: float) -> bool:
    """Return whether rounding or the stated noise of the sensor causes errors of this size [mm]."""
    sigma = checked.rows.sigma_position
    noise = 0.0 if sigma is None else 3**0.5 * float(sigma.nanmedian()) * 1e3
    return noise > _NOISE * left or joint_rounding(checked.geometric, checked.rows) is not None


MAX_ITERATIONS = 8
MAX_STEP = 0.3
"""Largest step of a joint zero in an iteration [rad, or share of the reach]."""


def check_unexplained_rows(judged: RowsUnderModel) -> Iterator[Diagnostic]:
    """Fit all joint zeros, a base and a tool to rows whose errors are too large for a calibrated robot."""
    limit = plausible_error_per_reach(judged.model.robot) * judged.model.robot.reach
    if judged.has_large_errors and not judged.setup_faults and not _can_fit(judged, limit):
        yield unexplained_diagnostic(judged.model)


def _can_fit(judged: RowsUnderModel, limit: float) -> bool:
    """Return whether the fit leaves an RMS residual of at most `limit` [m], corrected for the degrees of freedom."""
    known, robot = judged.renamed_rows, judged.model.robot
    zeros = torch.zeros(known.dof, dtype=torch.float64)
    largest = (
        MAX_STEP * torch.tensor([1.0 if revolute else robot.reach for revolute in robot.revolute]).double()
    )
    moves = "joint_zero" in judged.allowed_moves
    values = 3 * known.rows
    limit *= math.sqrt(max(values - FITTED_PARAMETERS - (known.dof if moves else 0), 1) / values)
    for _ in range(MAX_ITERATIONS if moves else 1):
        T, derivative = judged.poses_with_moved_zeros(zeros)
        # Base and tool have a closed form for given zeros; a Gauss-Newton step of the zeros follows.
        base, tool = best_base_and_tool(T, judged.measured)
        error = judged.measured.position - (base @ T @ tool)[:, :3, 3]
        if float(error.square().sum(1).mean().sqrt()) <= limit:
            return True
        J = (base @ derivative @ tool)[..., :3, 3].flatten(1).t()
        step = torch.linalg.lstsq(J, error.flatten(), driver="gelsd").solution
        zeros = zeros + step.clamp(-largest, largest)
    return False


_UNRELATED_SHARE = 0.5
"""Ratio of the residuals to the spread of the positions above which the joints explain less than three quarters of
the variance. For a healthy robot the ratio is below 0.01."""


def check_residual_size(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Compare the residuals of every sensor with the robot's reach, and those of positions with the positions' spread.

    Half of the measured lengths must be within `plausible_error_per_reach` of the reach per axis, 1 % of most robots,
    and half of the measured angles within as many radians, which move a point at the distance of the reach equally far.
    Geometric errors of a robot do not exceed these limits.
    """
    robot, by_images = checked.robot, "corner" in checked.rows.kinds
    share = plausible_error_per_reach(robot)
    rows = "images and joint values" if by_images else "rows and positions"
    for sensor, errors in checked.final_errors.items():
        typical = _typical(errors)
        if SENSORS[sensor].unit == "rad":
            limit, size = share, f"{typical:.3g} rad"
        else:
            limit, size = share * robot.reach, f"{typical * 1e3:.3g} mm"
            if sensor == "position":
                limit = min(limit, _UNRELATED_SHARE * _spread(checked.rows))
        if typical > limit > 0:
            before = _typical(checked.errors["nominal"][sensor]) / typical
            yield Diagnostic(
                kind="residual",
                severity="implausible",
                sentence=f"With the best fit, the median residual of {sensor} is still {size} per axis ({before:.3g} "
                f"times as large for the nominal robot '{robot.name}'), more than geometric errors of "
                f"the robot explain; check units, order, signs and zeros of the joint columns, whether {rows} belong "
                f"together, {'the lengths of the board, ' if by_images else ''}and whether this robot was "
                "measured.",
                cause=sensor,
                values={f"residual_{SENSORS[sensor].unit}": typical},
            )


def _typical(errors: Float64[Tensor, "rows components"]) -> float:
    """Compute the median length of the errors per component [m or rad]."""
    length: float = errors.norm(dim=-1).nanmedian().item()
    return length / math.sqrt(errors.shape[-1])


def _spread(rows: Measurements) -> float:
    """Compute the standard deviation of the coordinates of the positions about their mean in each frame [m]."""
    assert rows.position is not None
    squares = []
    for name in dict.fromkeys(rows.frame):
        position = rows.position[torch.tensor([frame == name for frame in rows.frame])]
        squares.append((position - position.nanmean(0)).square())
    return float(torch.cat(squares).nanmean().sqrt())
