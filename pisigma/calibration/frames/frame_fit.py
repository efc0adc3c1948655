"""Fit base, tool or both to few rows with the arm held fixed, and find undetermined directions and wrong rows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.frames.whitened_values import FrameUncertaintyDirections, WhitenedValues
from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.identifiability.observability import direction_in_words
from pisigma.calibration.geometric.identifiability.sufficiency import floating_frames
from pisigma.calibration.geometric.problem.held_directions import LARGEST_DEVIATION, HeldDirections
from pisigma.calibration.geometric.problem.least_squares import SolutionStatus, levenberg_marquardt
from pisigma.calibration.geometric.problem.noise import contributions_and_noise_of
from pisigma.calibration.geometric.problem.parameters import Parameter, ParameterSpace
from pisigma.calibration.geometric.problem.setup import identified_geometry
from pisigma.calibration.geometric.result import SolvedCalibration
from pisigma.estimation.held_out import most_deviating_row
from pisigma.estimation.loss import SquaredLoss
from pisigma.files.errors import IdentificationError, Phrase, Place
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot

FrameChoice = Literal["tool", "base", "hand-eye"]
Frames = Mapping[str, Float64[np.ndarray, " 6"]]

_MAX_WRONG_SHARE = 0.25
"""Largest share of wrong rows: if one of four rows disagrees, it is not known which one is wrong."""
_HARDLY_DETERMINED = 1.0
"""Standard deviation [mm or mrad] above which a direction is reported, and above which undetermined directions leave a
coordinate without a standard error."""
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
_CONTRADICTED = 3.0
"""Ratio of the residuals with and without holding a direction above which the rows contradict its previous value.
Rotations due to noise raise the residuals by a factor of at most 1 + distance / 400 mm."""
_MAX_SHIFTS, _SMALL = 10, 1e-6
"""Largest number of shifts to the previous values, and the remaining distance [mm or mrad] at which they end; one shift
is sufficient for tools, while undetermined rotations of a base are nonlinear."""
_NO_FRAMES: Frames = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class WeakDirection:
    """A combination of coordinates that the rows determine poorly.

    Attributes:
        combination: the combination as text, in units of 1 mm and 1 mrad (0.057 deg).
        sigma: its standard deviation in these units; infinite if the rows contain no information on it.
        is_held: whether it keeps its previous value, because the rows do not determine it.
    """

    combination: str
    sigma: float
    is_held: bool


@dataclass(frozen=True, eq=False)
class FrameFit:
    """Base, tool or both, fitted with the arm held fixed.

    Attributes:
        frame_choice: what was fitted.
        solved: the least-squares problem of the rows used, with its solution.
        rows: all rows.
        used_rows: indices of the rows used.
        wrong_rows: indices of the rows left out, in the order in which they were found.
        bases: previous bases by frame; other frames use the base of the robot.
        tools: previous tools by target; other targets use the tool of the robot.
    """

    frame_choice: FrameChoice
    solved: SolvedCalibration
    rows: Measurements
    used_rows: tuple[int, ...]
    wrong_rows: tuple[int, ...]
    bases: Frames
    tools: Frames

    @property
    def frame_indices(self) -> list[int]:
        """Indices of the coordinates of bases and tools that the fit was asked for."""
        return _frames(self.solved)

    @cached_property
    def values(self) -> WhitenedValues:
        """Measured values at the solution, linear in the `fitted_directions`."""
        values = WhitenedValues.at_solution(self.solved, self.solved.problem.active.tolist())
        return replace(values, X=values.X @ self.fitted_directions)

    @cached_property
    def fitted_directions(self) -> Float64[Tensor, "active fitted"]:
        """Fitted directions, in the coordinates of the problem: all except those that were held."""
        problem = self.solved.problem
        if problem.held_directions is None:
            return torch.diag(problem.step_scale)
        V = problem.held_directions.directions
        orthonormal: Tensor = torch.linalg.qr(V, mode="complete")[0][:, V.shape[1] :]
        return problem.step_scale[:, None] * orthonormal

    @property
    def covariance(self) -> Float64[np.ndarray, "frames frames"]:
        """Covariance of `frame_indices` due to the noise of the rows, with the arm treated as exact [m² or rad²].

        The noise is that of the residuals. Directions that the rows do not determine have a standard deviation of at
        most 1 m or 1 rad.
        """
        covariance: np.ndarray = self.solved.covariance[np.ix_(self.frame_indices, self.frame_indices)]
        return covariance

    @cached_property
    def weak_directions(self) -> tuple[WeakDirection, ...]:
        """Directions that were held, and those with a standard deviation of more than 1 mm or 1 mrad, weakest first."""
        names = [parameter.name for parameter in self.parameters]
        vectors, deviation = self._directions
        return tuple(
            WeakDirection(direction_in_words(vector, names), size, number < self._held)
            for number, (vector, size) in enumerate(zip(vectors.t(), deviation.tolist(), strict=True))
            if number < self._held or size > _HARDLY_DETERMINED
        )

    @property
    def undetermined_indices(self) -> frozenset[int]:
        """Indices of the coordinates that are uncertain because of a direction that the rows do not determine."""
        vectors, deviation = self._directions
        held = vectors[:, : self._held] * deviation[: self._held].clamp(max=LARGEST_DEVIATION)
        uncertain = (held.norm(dim=1) > _HARDLY_DETERMINED).tolist()
        return frozenset(index for index, yes in zip(self.frame_indices, uncertain, strict=True) if yes)

    @property
    def _held(self) -> int:
        """Number of directions that were held."""
        held = self.solved.problem.held_directions
        return 0 if held is None else held.directions.shape[1]

    @cached_property
    def _directions(self) -> tuple[Float64[Tensor, "frames frames"], Float64[Tensor, " frames"]]:
        """Return unit vectors in the user's coordinates, with standard deviations in mm and mrad, weakest first."""
        found, held = (
            FrameUncertaintyDirections.at_solution(self.solved, self.frame_indices),
            self.solved.problem.held_directions,
        )
        if held is not None:  # with the deviation that was judged
            found = replace(found, sigma=torch.cat([held.sigma, found.sigma[self._held :]]))
        vectors, length = found.in_user_coordinates(self.solved)
        return vectors[self.frame_indices], found.sigma * length

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Coordinates of bases and tools that the fit was asked for."""
        return tuple(self.solved.problem.space.parameters[index] for index in self.frame_indices)

    @property
    def estimates(self) -> Float64[np.ndarray, " frames"]:
        """Values of `parameters` in the user's coordinates [m or rad]."""
        values: np.ndarray = self.solved.geometry.values_of(self.solved.problem.space).numpy()[
            self.frame_indices
        ]
        return values

    @property
    def previous_values(self) -> Float64[np.ndarray, " frames"]:
        """Values of `parameters` before the fit [m or rad]."""
        values = initial_parameters(self.solved.problem.space, self.bases, self.tools)
        before: np.ndarray = values.numpy()[self.frame_indices]
        return before


def fit_frames(
    robot: Robot,
    rows: Measurements,
    frame_choice: FrameChoice,
    previous_bases: Frames = _NO_FRAMES,
    previous_tools: Frames = _NO_FRAMES,
) -> FrameFit:
    """Fit base, tool or both by least squares, leaving out rows that all others contradict.

    The arm is not fitted. Directions that the rows do not determine keep their previous values; see
    `hold_undetermined`. A row is wrong if its error relative to the fit of the other rows is improbable (F-test of the
    deleted residual; see `most_deviating_row`).

    Args:
        robot: robot with the fixed arm, and with the base or tool that is not fitted.
        rows: touches, positions, poses or images; sockets are points at unknown positions.
        frame_choice: what to fit; the tool's orientation only if rows have orientations.
        previous_bases: bases of named frames that differ from the base of the robot.
        previous_tools: tools of named targets that differ from the tool of the robot.

    Raises:
        IdentificationError: there are too few rows, several frames or targets whose known base or tool is not stated,
            or a base without rows at stated positions.
        PoseError: the joint values do not fit the robot.
    """
    previous_bases = {name: previous_bases[name] for name in set(rows.frame) & set(previous_bases)}
    if frame_choice == "tool":
        _refuse_several("frame", set(rows.frame), previous_bases, rows)
    if frame_choice == "base":
        _refuse_several("target", set(rows.target), {}, rows)
        robot = robot.with_geometry(tool=previous_tools.get(rows.target[0], robot.tool))
    turned = bool({"pose", "rotation"} & set(rows.kinds))
    calibrator = GeometricCalibrator(
        robot,
        free=(),
        base="fixed" if frame_choice == "tool" else "free",
        tool="fixed" if frame_choice == "base" else "free" if turned else "position",
        elimination="none",
        prior=None,
        loss=SquaredLoss(),
        base_guesses={name: tuple(base) for name, base in previous_bases.items()}
        if frame_choice == "tool"
        else {},
    )
    used, wrong = list(range(rows.rows)), list[int]()
    while True:
        free = calibrator.solve(rows.select(torch.tensor(used)) if wrong else rows)
        if frame_choice != "tool" and (floating := floating_frames(free.setup)):
            raise IdentificationError(
                expected="rows at stated positions, which determine the base",
                value=Phrase(", ".join(sorted(rows.kinds))),
                at=Place(rows.source),
                option="only",
                remedy=f"measure positions or poses{f' in frame {floating[0]}' if floating[0] else ''}, or fit the "
                "tool only (--only tool)",
            )
        solved = hold_undetermined(free, _frames(free), previous_bases, previous_tools)
        fit = FrameFit(frame_choice, solved, rows, tuple(used), tuple(wrong), previous_bases, previous_tools)
        if (number := _wrong_row(fit)) is None:
            return fit
        used.remove(number)
        wrong.append(number)


def _frames(solved: SolvedCalibration) -> list[int]:
    """Return the indices of the free coordinates of bases and tools."""
    unknowns = set(solved.setup.free_unknowns)
    return [index for index in solved.problem.active.tolist() if index not in unknowns]


def _refuse_several(column: str, names: set[str], known: Frames, rows: Measurements) -> None:
    """Refuse rows of several frames or targets whose bases or tools are neither fitted nor known.

    Raises:
        IdentificationError: there are several names, not all of which are known.
    """
    if len(names) > 1 and not names <= set(known):
        raise IdentificationError(
            expected=f"rows of one {column}",
            value=sorted(names),
            at=Place(rows.source, column=column),
            option="only",
            remedy=f"give a file for each {column}",
        )


def _wrong_row(fit: FrameFit) -> int | None:
    """Return the index of the row that the others contradict; None if there is none, or if too many rows are wrong."""
    if (
        len(fit.wrong_rows) + 1 > _MAX_WRONG_SHARE * fit.rows.rows
        or fit.solved.solution.status == SolutionStatus.EXACT
    ):
        return None
    values = fit.values
    tested = most_deviating_row(values.X, values.y, values.row, values.has_exact_noise)
    if tested is None or not tested.is_wrong:
        return None
    return fit.used_rows[int(fit.solved.setup.row_indices[tested.row])]


def hold_undetermined(
    solved: SolvedCalibration,
    coordinate_indices: Sequence[int],
    previous_bases: Frames,
    previous_tools: Frames,
) -> SolvedCalibration:
    """Fit again, with all directions that the rows do not determine held at their previous values.

    A direction is not determined if its standard deviation is infinite, or if it is larger than `_LARGEST_SPREAD`
    allows for the number of rows and the rows do not contradict the previous value. The standard deviation of a held
    value includes its distance from the estimate of the rows, the only indication of its error.

    Args:
        solved: fit in which all coordinates were free.
        coordinate_indices: indices of the coordinates of bases and tools.
        previous_bases: previous bases by frame; other frames use the base of the robot.
        previous_tools: previous tools by target; other targets use the tool of the robot.

    Returns:
        The fit; `problem.held_directions` contains the held directions, if any.
    """
    found, space = FrameUncertaintyDirections.at_solution(solved, coordinate_indices), solved.problem.space
    unknown = int(torch.isinf(found.sigma).sum())
    before, rows = initial_parameters(space, previous_bases, previous_tools), solved.problem.rows
    distance = found.distances(solved, before).abs()
    plausible = distance <= _IMPROBABLE * found.sigma + rows * found.sigma**2 / _LEVER
    # The least determined directions come first, so once one is not held, none of the following are.
    weak = int(((found.sigma * rows**0.5 > _LARGEST_SPREAD) & plausible).cumprod(0).sum())
    deviation = found.sigma.hypot(distance)
    for count in range(weak, 0, -1):
        held = _with_held(solved, coordinate_indices, deviation[:count], before)
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
        found = FrameUncertaintyDirections.at_solution(solved, frames)
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
    variances = contributions_and_noise_of(free.refined_linearisation).variances
    squares = [
        float(
            (
                torch.stack([part.residual_length.square().sum() for part in view.contributions]) / variances
            ).sum()
        )
        for view in (
            contributions_and_noise_of(held.solution.linearisation),
            contributions_and_noise_of(free.solution.linearisation),
        )
    ]
    return held.solution.status != SolutionStatus.EXACT and squares[0] > _CONTRADICTED**2 * squares[1]
