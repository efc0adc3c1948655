"""Frames whose rows do not fit, though those of the others do: probably their names are mixed up."""

import torch
from torch import Tensor

from pisigma.identification.problem.least_squares import Linearisation
from pisigma.identification.problem.noise import view_of
from pisigma.identification.problem.problem import CalibrationProblem

FAR_OFF = 10.0
"""Times the other frames' residuals."""
NOTICED = 1e-6
"""[m] Smaller residuals are never far off."""
OFF_SHARE = 0.2
"""Share of a frame's rows that must be far off."""


def frames_mixed_up(problem: CalibrationProblem, here: Linearisation[Tensor]) -> tuple[str, ...]:
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


def residual_sizes(problem: CalibrationProblem, here: Linearisation[Tensor]) -> Tensor:
    """Length of every row's residual per component [m], NaN where no length was measured."""
    found = torch.full_like(problem.q[:, 0], torch.nan)
    for sensor, sums in zip(problem.sensors, view_of(here).sums, strict=True):
        if sensor.unit == "m" and sensor.name != "socket distance":
            size = sums.residual.norm(dim=0) / sensor.components**0.5
            found = torch.where(sensor.seen, size, found)
    return found
