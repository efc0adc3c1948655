"""Find the directions of bases and tools that the rows do not determine, and hold these at their previous values."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.frames.whitened_values import WhitenedValues
from pisigma.calibration.geometric.problem.held_directions import HeldDirections
from pisigma.calibration.geometric.problem.least_squares import SolutionStatus, levenberg_marquardt
from pisigma.calibration.geometric.problem.noise import sensor_view_of
from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.problem.setup import identified_geometry
from pisigma.calibration.geometric.result import SolvedCalibration
from pisigma.estimation.cholesky import orthonormal_columns
from pisigma.robot.se3 import wrap_to_pi

_LARGEST_SPREAD = 60.0
"""Standard deviation [mm or mrad], times the square root of the number of rows, above which a direction is not
determined. Noise that shifts the tool also rotates it, by the shift divided by a lever of about 400 mm. These rotations
look like information, even on directions that no row determines, with a standard deviation of 400 mm per row regardless
of the noise. Below 60 mm per row, errors are at most 1.25 times the stated ones for 4 to 12 touches."""
_LEVER = 400.0
"""Length of this lever [mm]. Noise shifts an estimate by about this length times the share of information it
imitates."""
_IMPROBABLE = 5.0
"""Number of standard deviations, in addition to this shift, beyond which the rows contradict a previous value."""
_ROUNDING = 1e-9
"""Information on a direction, relative to that on the best determined one, below which it is a rounding error."""
_CONTRADICTED = 3.0
"""Ratio of the residuals with and without holding a direction above which the rows contradict its previous value.
Rotations due to noise raise the residuals by a factor of at most 1 + distance / 400 mm."""
_MAX_SHIFTS, _SMALL = 10, 1e-6
"""Largest number of shifts to the previous values, and the remaining distance [mm or mrad] at which they end; one shift
is sufficient for tools, while undetermined rotations of a base are nonlinear."""

Frames = Mapping[str, Float64[np.ndarray, " 6"]]


@dataclass(frozen=True, eq=False)
class FrameDirections:
    """Independent directions in the coordinates of frames, least determined first.

    Attributes:
        directions: the directions, orthonormal in units of 1 mm and 1 mrad, in the coordinates of the problem.
        deviation: standard deviation of every direction in these units; infinite if the rows contain no information.
    """

    directions: Float64[Tensor, "active frames"]
    deviation: Float64[Tensor, " frames"]

    @staticmethod
    def at_solution(solved: SolvedCalibration, frames: Sequence[int]) -> "FrameDirections":
        """Return the directions at a solution, with the noise estimated from its residuals.

        Args:
            solved: the solution.
            frames: indices of the coordinates; the other free parameters are eliminated.
        """
        active = solved.problem.active.tolist()
        X = WhitenedValues.at_solution(solved, active).X * solved.problem.step_scale
        ours = torch.tensor([index in set(frames) for index in active])
        U, own = orthonormal_columns(X[:, ~ours]), X[:, ours]
        own = own - U @ (U.t() @ own)
        information, vectors = torch.linalg.eigh(own.t() @ own)
        directions = X.new_zeros(len(active), len(information))
        directions[ours] = vectors
        is_known = information > _ROUNDING * information.max()
        return FrameDirections(directions, torch.where(is_known, information.clamp(min=0) ** -0.5, torch.inf))

    def in_user_coordinates(
        self, solved: SolvedCalibration
    ) -> tuple[Float64[Tensor, "parameters frames"], Float64[Tensor, " frames"]]:
        """Return the directions in the user's coordinates as unit vectors, and their lengths before normalisation.

        Both are in units of 1 mm and 1 mrad.
        """
        problem, units = solved.problem, torch.from_numpy(solved.problem.space.usual_errors)
        change = solved.geometry.coordinate_jacobian[:, problem.active]
        vectors = change @ (problem.step_scale[:, None] * self.directions) / units[:, None]
        length = vectors.norm(dim=0)
        return vectors / length, length

    def distances(
        self, solved: SolvedCalibration, before: Float64[Tensor, " parameters"]
    ) -> Float64[Tensor, " frames"]:
        """Return the distances of the previous values from a solution along all directions, per 1 mm and 1 mrad."""
        space, units = solved.problem.space, torch.from_numpy(solved.problem.space.usual_errors)
        vectors, length = self.in_user_coordinates(solved)
        off = before - solved.geometry.values_of(space)
        off = torch.where(space.is_length, off, wrap_to_pi(off)) / units
        return (vectors.t() @ off) / length


def hold_undetermined(
    solved: SolvedCalibration, frames: Sequence[int], bases: Frames, tools: Frames
) -> SolvedCalibration:
    """Fit again, with all directions that the rows do not determine held at their previous values.

    A direction is not determined if its standard deviation is infinite, or if it is larger than `_LARGEST_SPREAD`
    allows for the number of rows and the rows do not contradict the previous value. The standard deviation of a held
    value includes its distance from the estimate of the rows, the only indication of its error.

    Args:
        solved: fit in which all coordinates were free.
        frames: indices of the coordinates of bases and tools.
        bases: previous bases by frame; other frames use the base of the robot.
        tools: previous tools by target; other targets use the tool of the robot.

    Returns:
        The fit; `problem.held_directions` contains the held directions, if any.
    """
    found, space = FrameDirections.at_solution(solved, frames), solved.problem.space
    unknown = int(torch.isinf(found.deviation).sum())
    before, rows = initial_parameters(space, bases, tools), solved.problem.rows
    distance = found.distances(solved, before).abs()
    plausible = distance <= _IMPROBABLE * found.deviation + rows * found.deviation**2 / _LEVER
    # The least determined directions come first, so once one is not held, none of the following are.
    weak = int(((found.deviation * rows**0.5 > _LARGEST_SPREAD) & plausible).cumprod(0).sum())
    deviation = found.deviation.hypot(distance)
    for count in range(weak, 0, -1):
        held = _with_held(solved, frames, deviation[:count], before)
        if count <= unknown or not _contradicts(held, solved):
            return held
    return solved


def initial_parameters(space: ParameterSpace, bases: Frames, tools: Frames) -> Float64[Tensor, " parameters"]:
    """Return the parameters before the fit, in the user's coordinates; see `hold_undetermined` for bases and tools."""
    return space.values(
        np.stack([bases.get(name, space.robot.base) for name in space.frames]),
        np.stack([tools.get(name, space.robot.tool) for name in space.targets]),
    )


def _with_held(
    solved: SolvedCalibration,
    frames: Sequence[int],
    deviation: Float64[Tensor, " held"],
    before: Float64[Tensor, " parameters"],
) -> SolvedCalibration:
    """Shift the least determined directions to their previous values, and refit the others, until nothing changes."""
    for _ in range(_MAX_SHIFTS):
        found = FrameDirections.at_solution(solved, frames)
        held = HeldDirections(found.directions[:, : len(deviation)], deviation)
        missing = found.distances(solved, before)[: len(deviation)]
        if solved.problem.held_directions is not None and float(missing.abs().max()) < _SMALL:
            break
        problem = replace(solved.problem, held_directions=held)
        step = problem.step_scale * (held.directions @ missing)
        start = problem.apply_step(solved.solution.linearisation.point, step)
        solution = solved.solution.continued_by(levenberg_marquardt(problem, start))
        geometry = identified_geometry(solved.setup, solution.linearisation.point)
        solved = replace(solved, problem=problem, solution=solution, geometry=geometry)
    return solved


def _contradicts(held: SolvedCalibration, free: SolvedCalibration) -> bool:
    """Return whether the residuals are much larger with directions held than with all directions free."""
    variances = sensor_view_of(free.refined).variances
    squares = [
        float((torch.stack([part.distance.square().sum() for part in view.contributions]) / variances).sum())
        for view in (sensor_view_of(held.solution.linearisation), sensor_view_of(free.solution.linearisation))
    ]
    return held.solution.status != SolutionStatus.EXACT and squares[0] > _CONTRADICTED**2 * squares[1]
