"""Fit base, tool or both to few rows with the arm held fixed, and find undetermined directions and wrong rows."""

from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.frames.undetermined import (
    FrameDirections,
    Frames,
    hold_undetermined,
    initial_parameters,
)
from pisigma.calibration.frames.whitened_values import WhitenedValues
from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.identifiability.observability import direction_in_words
from pisigma.calibration.geometric.identifiability.sufficiency import floating_frames
from pisigma.calibration.geometric.problem.held_directions import LARGEST_DEVIATION
from pisigma.calibration.geometric.problem.least_squares import SolutionStatus
from pisigma.calibration.geometric.problem.parameters import Parameter
from pisigma.calibration.geometric.result import SolvedCalibration
from pisigma.estimation.held_out import most_deviating_row
from pisigma.estimation.loss import SquaredLoss
from pisigma.files.errors import IdentificationError, Phrase, Place
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot

FrameChoice = Literal["tool", "base", "hand-eye"]

_MAX_WRONG_SHARE = 0.25
"""Largest share of wrong rows: if one of four rows disagrees, it is not known which one is wrong."""
_HARDLY_DETERMINED = 1.0
"""Standard deviation [mm or mrad] above which a direction is reported, and above which undetermined directions leave a
coordinate without a standard error."""
_NO_FRAMES: Frames = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class WeakDirection:
    """A combination of coordinates that the rows determine poorly.

    Attributes:
        combination: the combination as text, in units of 1 mm and 1 mrad (0.057 deg).
        deviation: its standard deviation in these units; infinite if the rows contain no information on it.
        is_held: whether it keeps its previous value, because the rows do not determine it.
    """

    combination: str
    deviation: float
    is_held: bool


@dataclass(frozen=True, eq=False)
class FrameFit:
    """Base, tool or both, fitted with the arm held fixed.

    Attributes:
        only: what was fitted.
        solved: the least-squares problem of the rows used, with its solution.
        rows: all rows.
        used_rows: indices of the rows used.
        wrong_rows: indices of the rows left out, in the order in which they were found.
        bases: previous bases by frame; other frames use the base of the robot.
        tools: previous tools by target; other targets use the tool of the robot.
    """

    only: FrameChoice
    solved: SolvedCalibration
    rows: Measurements
    used_rows: tuple[int, ...]
    wrong_rows: tuple[int, ...]
    bases: Frames
    tools: Frames

    @property
    def frames(self) -> list[int]:
        """Indices of the coordinates of bases and tools that the fit was asked for."""
        return _frames(self.solved)

    @cached_property
    def values(self) -> WhitenedValues:
        """Measured values at the solution, linear in the fitted directions (see `basis`)."""
        values = WhitenedValues.at_solution(self.solved, self.solved.problem.active.tolist())
        return replace(values, X=values.X @ self.basis)

    @cached_property
    def basis(self) -> Float64[Tensor, "active fitted"]:
        """Fitted directions, in the coordinates of the problem: all except those that were held."""
        problem = self.solved.problem
        if problem.held_directions is None:
            return torch.diag(problem.step_scale)
        V = problem.held_directions.directions
        orthonormal: Tensor = torch.linalg.qr(V, mode="complete")[0][:, V.shape[1] :]
        return problem.step_scale[:, None] * orthonormal

    @property
    def covariance(self) -> Float64[np.ndarray, "frames frames"]:
        """Covariance of `frames` due to the noise of the rows, with the arm treated as exact [m² or rad²].

        The noise is that of the residuals. Directions that the rows do not determine have a standard deviation of at
        most 1 m or 1 rad.
        """
        covariance: np.ndarray = self.solved.covariance[np.ix_(self.frames, self.frames)]
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
    def undetermined(self) -> frozenset[int]:
        """Indices of the coordinates that are uncertain because of a direction that the rows do not determine."""
        vectors, deviation = self._directions
        held = vectors[:, : self._held] * deviation[: self._held].clamp(max=LARGEST_DEVIATION)
        uncertain = (held.norm(dim=1) > _HARDLY_DETERMINED).tolist()
        return frozenset(index for index, yes in zip(self.frames, uncertain, strict=True) if yes)

    @property
    def _held(self) -> int:
        """Number of directions that were held."""
        held = self.solved.problem.held_directions
        return 0 if held is None else held.directions.shape[1]

    @cached_property
    def _directions(self) -> tuple[Float64[Tensor, "frames frames"], Float64[Tensor, " frames"]]:
        """Return unit vectors in the user's coordinates, with standard deviations in mm and mrad, weakest first."""
        found, held = (
            FrameDirections.at_solution(self.solved, self.frames),
            self.solved.problem.held_directions,
        )
        if held is not None:  # with the deviation that was judged
            found = replace(found, deviation=torch.cat([held.deviation, found.deviation[self._held :]]))
        vectors, length = found.in_user_coordinates(self.solved)
        return vectors[self.frames], found.deviation * length

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Coordinates of bases and tools that the fit was asked for."""
        return tuple(self.solved.problem.space.parameters[index] for index in self.frames)

    @property
    def estimates(self) -> Float64[np.ndarray, " frames"]:
        """Values of `parameters` in the user's coordinates [m or rad]."""
        values: np.ndarray = self.solved.geometry.values_of(self.solved.problem.space).numpy()[self.frames]
        return values

    @property
    def before(self) -> Float64[np.ndarray, " frames"]:
        """Values of `parameters` before the fit [m or rad]."""
        values = initial_parameters(self.solved.problem.space, self.bases, self.tools)
        before: np.ndarray = values.numpy()[self.frames]
        return before


def fit_frames(
    robot: Robot,
    rows: Measurements,
    only: FrameChoice,
    bases: Frames = _NO_FRAMES,
    tools: Frames = _NO_FRAMES,
) -> FrameFit:
    """Fit base, tool or both by least squares, leaving out rows that all others contradict.

    The arm is not fitted. Directions that the rows do not determine keep their previous values; see
    `hold_undetermined`. A row is wrong if its error relative to the fit of the other rows is improbable (F-test of the
    deleted residual; see `most_deviating_row`).

    Args:
        robot: robot with the fixed arm, and with the base or tool that is not fitted.
        rows: touches, positions, poses or images; sockets are points at unknown positions.
        only: what to fit; the tool's orientation only if rows have orientations.
        bases: bases of named frames that differ from the base of the robot.
        tools: tools of named targets that differ from the tool of the robot.

    Raises:
        IdentificationError: there are too few rows, several frames or targets whose known base or tool is not stated,
            or a base without rows at stated positions.
        PoseError: the joint values do not fit the robot.
    """
    bases = {name: bases[name] for name in set(rows.frame) & set(bases)}
    if only == "tool":
        _refuse_several("frame", set(rows.frame), bases, rows)
    if only == "base":
        _refuse_several("target", set(rows.target), {}, rows)
        robot = robot.with_geometry(tool=tools.get(rows.target[0], robot.tool))
    turned = bool({"pose", "rotation"} & set(rows.kinds))
    calibrator = GeometricCalibrator(
        robot,
        free=(),
        base="fixed" if only == "tool" else "free",
        tool="fixed" if only == "base" else "free" if turned else "position",
        elimination="none",
        prior=None,
        loss=SquaredLoss(),
        base_guesses={name: tuple(base) for name, base in bases.items()} if only == "tool" else {},
    )
    used, wrong = list(range(rows.rows)), list[int]()
    while True:
        free = calibrator.solve(rows.select(torch.tensor(used)) if wrong else rows)
        if only != "tool" and (floating := floating_frames(free.setup)):
            raise IdentificationError(
                expected="rows at stated positions, which determine the base",
                value=Phrase(", ".join(sorted(rows.kinds))),
                at=Place(rows.source),
                option="only",
                remedy=f"measure positions or poses{f' in frame {floating[0]}' if floating[0] else ''}, or fit the "
                "tool only (--only tool)",
            )
        solved = hold_undetermined(free, _frames(free), bases, tools)
        fit = FrameFit(only, solved, rows, tuple(used), tuple(wrong), bases, tools)
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
    tested = most_deviating_row(values.X, values.y, values.row, values.exact)
    if tested is None or not tested.is_wrong:
        return None
    return fit.used_rows[int(fit.solved.setup.rows[tested.row])]
