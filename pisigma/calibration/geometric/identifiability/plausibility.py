"""Fits that no calibration error explains: of another robot, in other units, with swapped frame names."""

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.least_squares import Linearisation
from pisigma.calibration.geometric.problem.noise import view_of
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.files.errors import ImplausibleError

IMPLAUSIBLE_SHARE = 0.01
"""Share of the robot's reach that half of the rows must be within, once the arm was fitted."""

DISTANCES = ("distance", "pair")
"""Sensors of distances, which are judged like positions."""

LONG_SHARE = 0.1
"""Links longer than this share of the reach are long."""
RUINED_SHARE = 0.5
"""A long link that changes by more than this share was not that long."""
FAR_OFF = 10.0
"""Times the other frames' residuals."""
NOTICED = 1e-6
"""[m] Smaller residuals are never far off."""
OFF_SHARE = 0.2
"""Share of a frame's rows that must be far off."""


def refuse_implausible(problem: CalibrationProblem, here: Linearisation[Tensor], source: str) -> None:
    """Refuse a fit of the arm that leaves most positions or distances far from their prediction, or ruins the arm.

    Where no parameter of the arm is free (base and tool alone), nothing is refused: the arm may be far off. Touches and
    corners are not judged here.

    Args:
        problem: with its free parameters.
        here: its linearisation at the solution.
        source: what complaints call the measurements.

    Raises:
        ImplausibleError: the median residual of positions, balls in sockets or distances is more than 1 % of the
            reach, or a link is half as long again as drawn, or less than half as long.
    """
    _refuse_ruined_links(problem, here.point, source)
    robot = problem.space.robot
    judged = [
        sensor.present
        for sensor in problem.sensors
        if sensor.unit == "m" and (sensor.components == 3 or sensor.name in DISTANCES)
    ]
    if not judged or robot.reach == 0 or not bool((problem.active < problem.space.arm_size).any()):
        return
    sizes = residual_sizes(problem, here)[torch.stack(judged).any(0)]
    size = float(sizes.median()) if len(sizes) else 0.0
    if size > IMPLAUSIBLE_SHARE * robot.reach:
        raise ImplausibleError(
            f"{source}: with the best fit a typical row is still {size * 1e3:.3g} mm per axis from where robot "
            f"'{robot.name}' says, {size / robot.reach:.1%} of its reach, which no calibration error explains; "
            "check the units (millimetres in a _m column?), stated distances, order and directions of the joints, "
            "and whether this robot was measured."
        )


def _refuse_ruined_links(problem: CalibrationProblem, point: Tensor, source: str) -> None:
    """Refuse an arm whose long lengths changed by half, as where metres stand in a column of millimetres.

    Raises:
        ImplausibleError: see above.
    """
    robot = problem.space.robot
    is_length = problem.space.is_length.numpy()
    drawn, fitted = robot.dh.ravel(), point.cpu().numpy()[: problem.space.arm_size]
    long = is_length[: len(drawn)] & (np.abs(drawn) > LONG_SHARE * robot.reach)
    ruined = long & (np.abs(fitted - drawn) > RUINED_SHARE * np.abs(drawn))
    for number in np.flatnonzero(ruined)[:1].tolist():
        raise ImplausibleError(
            f"{source}: the best fit makes {problem.space.names[number]} of robot '{robot.name}' "
            f"{float(fitted[number]) * 1e3:.4g} mm instead of {float(drawn[number]) * 1e3:.4g} mm, which no "
            "calibration error explains; check the units (metres in a _mm column?), stated distances, order and "
            "directions of the joints, and whether this robot was measured."
        )


def misfitting_frames(problem: CalibrationProblem, here: Linearisation[Tensor]) -> tuple[str, ...]:
    """Say which frames' residuals are far off those of the others.

    Args:
        problem: with its free parameters.
        here: its linearisation at the solution.
    """
    frames = problem.space.frames
    if len(frames) < 2:
        return ()
    sizes = residual_sizes(problem, here)
    off, others = [], []
    for number in range(len(frames)):
        theirs = sizes[(problem.frame == number) & torch.isfinite(sizes)]
        rest = sizes[(problem.frame != number) & torch.isfinite(sizes)]
        if len(theirs) == 0 or len(rest) == 0:
            continue
        usual = max(float(rest.median()), NOTICED)
        wrong = theirs > FAR_OFF * usual
        if float(wrong.double().mean()) > OFF_SHARE:
            off.append((number, float(theirs[wrong].median()), int(wrong.sum()), len(theirs)))
            others.append(usual)
    return tuple(
        f"{wrong} of {count} rows of frame '{frames[number]}' are off by {size * 1e3:.3g} mm, where "
        f"{usual * 1e3:.3g} mm is usual in the other frames; check whether rows of it are named after another "
        "frame, or whether what it stands on was moved."
        for (number, size, wrong, count), usual in zip(off, others, strict=True)
    )


def residual_sizes(problem: CalibrationProblem, here: Linearisation[Tensor]) -> Float64[Tensor, " rows"]:
    """Length of every row's residual per component [m], NaN where no length was measured."""
    sizes = problem.q.new_full((problem.rows,), torch.nan)
    for sensor, sums in zip(problem.sensors, view_of(here).sums, strict=True):
        if sensor.unit == "m" and not sensor.certain:
            size = sums.residual.norm(dim=0) / sensor.components**0.5
            sizes = torch.where(sensor.present, size, sizes)
    return sizes
