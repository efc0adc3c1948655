"""Detect fits that no geometric errors of the robot explain: another robot, wrong units, or swapped frame names."""

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.identifiability.sufficiency import CalibrationWarning
from pisigma.calibration.geometric.problem.least_squares import Linearisation
from pisigma.calibration.geometric.problem.noise import contributions_and_noise_of
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.files.errors import ImplausibleError, Place
from pisigma.robot.robot_class import plausible_error_per_reach

_DISTANCES = ("distance", "pair")
"""Sensors that measure distances, which are tested like positions."""

_LONG_SHARE = 0.1
"""Length of a link, as a share of the reach, above which the link is long."""
_RUINED_SHARE = 0.5
"""Relative change of the length of a long link above which the fit is implausible."""
_FAR_OFF = 10.0
"""Ratio of a residual to the median residual of the other frames above which the row does not fit."""
_NOTICED = 1e-6
"""Residual below which a row always fits [m]."""
_OFF_SHARE = 0.2
"""Share of a frame's rows that must not fit before a warning is given."""


def refuse_implausible(
    problem: CalibrationProblem, linearisation: Linearisation[Tensor], source: str
) -> None:
    """Refuse a fit of the arm if most positions or distances have large residuals, or if links are impossible.

    If no parameter of the arm is free (only base and tool), nothing is refused. Touches and corners are not tested.

    Args:
        problem: the problem with its free parameters.
        linearisation: linearisation of the problem at the solution.
        source: name of the measurements in error messages.

    Raises:
        ImplausibleError: the median residual of positions, balls in sockets or distances is more than 1 % of the
            reach, or a long link changed by more than half of its length.
    """
    _refuse_ruined_links(problem, linearisation.point, source)
    robot = problem.space.robot
    judged = [
        sensor.present
        for sensor in problem.sensors
        if sensor.unit == "m" and (sensor.components == 3 or sensor.name in _DISTANCES)
    ]
    if not judged or robot.reach == 0 or not bool((problem.active < problem.space.arm_parameter_count).any()):
        return
    sizes = residual_sizes(problem, linearisation)[torch.stack(judged).any(0)]
    size = float(sizes.median()) if len(sizes) else 0.0
    if size > plausible_error_per_reach(robot) * robot.reach:
        raise ImplausibleError(
            f"with the best fit, the median residual is still {size * 1e3:.3g} mm per axis "
            f"({100 * size / robot.reach:.1f} % of the reach of robot '{robot.name}'), more than any error of "
            "the robot explains",
            value=size,
            at=Place(source),
            remedy="check the units (millimetres in a _m column?), stated distances, order and directions of the "
            "joints, and whether this robot was measured",
        )


def _refuse_ruined_links(problem: CalibrationProblem, point: Tensor, source: str) -> None:
    """Refuse an arm whose long links changed by half, for example because a column of millimetres contains metres.

    Raises:
        ImplausibleError: a long link changed by more than half of its length.
    """
    robot = problem.space.robot
    is_length = problem.space.is_length.numpy()
    nominal, fitted = robot.dh.ravel(), point.cpu().numpy()[: problem.space.arm_parameter_count]
    long = is_length[: len(nominal)] & (np.abs(nominal) > _LONG_SHARE * robot.reach)
    ruined = long & (np.abs(fitted - nominal) > _RUINED_SHARE * np.abs(nominal))
    for number in np.flatnonzero(ruined)[:1].tolist():
        name = problem.space.names[number]
        raise ImplausibleError(
            f"the best fit makes {name} of robot '{robot.name}' {float(fitted[number]) * 1e3:.4g} mm instead of "
            f"{float(nominal[number]) * 1e3:.4g} mm, a difference that no error of the robot explains",
            value=name,
            at=Place(source),
            remedy="check the units (metres in a _mm column?), stated distances, order and directions of the joints, "
            "and whether this robot was measured",
        )


def misfitting_frames(
    problem: CalibrationProblem, linearisation: Linearisation[Tensor]
) -> tuple[CalibrationWarning, ...]:
    """Return warnings about frames whose residuals are far larger than those of the other frames.

    Args:
        problem: the problem with its free parameters.
        linearisation: linearisation of the problem at the solution.
    """
    frames = problem.space.frames
    if len(frames) < 2:
        return ()
    sizes = residual_sizes(problem, linearisation)
    off, others = [], []
    for number in range(len(frames)):
        theirs = sizes[(problem.frame == number) & torch.isfinite(sizes)]
        rest = sizes[(problem.frame != number) & torch.isfinite(sizes)]
        if len(theirs) == 0 or len(rest) == 0:
            continue
        usual = max(float(rest.median()), _NOTICED)
        wrong = theirs > _FAR_OFF * usual
        if float(wrong.double().mean()) > _OFF_SHARE:
            off.append((number, float(theirs[wrong].median()), int(wrong.sum()), len(theirs)))
            others.append(usual)
    return tuple(
        CalibrationWarning(
            "frame_misfit",
            frames[number],
            f"{wrong} of {count} rows of frame '{frames[number]}' are off by {size * 1e3:.3g} mm, while the median "
            f"error of the other frames is {usual * 1e3:.3g} mm; check whether rows have the wrong frame name, or "
            "whether this frame was moved.",
        )
        for (number, size, wrong, count), usual in zip(off, others, strict=True)
    )


def residual_sizes(
    problem: CalibrationProblem, linearisation: Linearisation[Tensor]
) -> Float64[Tensor, " rows"]:
    """Compute the length of every row's residual per component [m]; NaN if no length was measured."""
    sizes = problem.q.new_full((problem.rows,), torch.nan)
    for sensor, part in zip(
        problem.sensors, contributions_and_noise_of(linearisation).contributions, strict=True
    ):
        if sensor.unit == "m" and not sensor.are_values_given:
            size = part.residual.norm(dim=0) / sensor.components**0.5
            sizes = torch.where(sensor.present, size, sizes)
    return sizes
