"""Fit base, tool or both to few rows with the arm as given: standard errors, what is not determined, wrong rows."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.frames.whitened_values import WhitenedValues
from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.identifiability.observability import direction_in_words
from pisigma.calibration.geometric.problem.parameters import Parameter
from pisigma.calibration.geometric.result import SolvedCalibration
from pisigma.estimation.leave_one_out import RowTest, most_deviating_row
from pisigma.estimation.loss import SquaredLoss
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot

FrameChoice = Literal["tool", "base", "hand-eye"]

MAX_WRONG_SHARE = 0.25
"""Largest share of wrong rows: of four that disagree it is not known which one is wrong."""
UNDETERMINED = 1e-9
"""Information of a direction over that of the best determined one below which the rows do not determine it."""
INVOLVED = 0.05
"""Component of an undetermined direction above which its parameter has no standard error."""


@dataclass(frozen=True)
class WrongRow:
    """A row that was left out, because the other rows contradict it.

    Attributes:
        row: number in the measurements, from 0.
        place: file and line.
        distance: length of the error of the row under the fit to all other rows [m]; NaN if no length was measured.
        angle: angle of the same [rad]; NaN if it has none.
        probability: probability of an error of this size, or larger, of any row without a wrong one.
    """

    row: int
    place: str
    distance: float
    angle: float
    probability: float


@dataclass(frozen=True, eq=False)
class WeakDirection:
    """A combination of coordinates that the rows hardly determine.

    Attributes:
        words: the combination, in units of 1 mm and 1 mrad (0.057 deg).
        deviation: its standard deviation in these units; infinite if the rows do not determine it.
    """

    words: str
    deviation: float


@dataclass(frozen=True, eq=False)
class FrameFit:
    """Base, tool or both, fitted with the arm as given.

    Attributes:
        only: what was fitted.
        solved: the problem of the rows that were used, with its solution.
        rows: all rows.
        used: numbers of the rows that were used.
        wrong: rows that were left out, in the order in which they were found.
    """

    only: FrameChoice
    solved: SolvedCalibration
    rows: Measurements
    used: tuple[int, ...]
    wrong: tuple[WrongRow, ...]

    @cached_property
    def candidates(self) -> list[int]:
        """Indices of the parameters that were to be fitted: bases and tools, then points and zeros of sensors."""
        space, problem = self.solved.problem.space, self.solved
        turned = any(sensor.turning for sensor in problem.problem.sensors)
        bases = list(space.indices_of("base")) if self.only != "tool" else []
        tools = list(space.indices_of("tool")) if self.only != "base" else []
        return [
            *bases,
            *(i for k, i in enumerate(tools) if turned or k % 6 < 3),
            *problem.setup.free_unknowns,
        ]

    @property
    def frames(self) -> list[int]:
        """Indices of the coordinates of bases and tools that were to be fitted."""
        unknowns = set(self.solved.setup.free_unknowns)
        return [index for index in self.candidates if index not in unknowns]

    @cached_property
    def values(self) -> WhitenedValues:
        """Measured values at the solution, linear in `candidates` in the user's coordinates."""
        values = WhitenedValues.at_solution(self.solved, self.candidates)
        index = torch.tensor(self.candidates)
        change = self.solved.geometry.coordinate_jacobian[index[:, None], index]
        return WhitenedValues(
            values.X @ torch.linalg.pinv(change),
            values.joints,
            values.y,
            values.row,
            values.exact,
            values.sensors,
        )

    @cached_property
    def _directions(self) -> tuple[Float64[Tensor, " frames"], Float64[Tensor, "frames frames"], Tensor]:
        """Return the information of the frames along its eigenvectors, in units of usual errors, and these units."""
        X, count = self.values.X, len(self.frames)
        unit = torch.from_numpy(self.solved.problem.space.usual_errors[self.candidates])
        X = X * unit
        others = X[:, count:]
        if others.shape[1]:
            U, singular, _ = torch.linalg.svd(others, full_matrices=False)
            U = U[:, singular > 1e-12 * singular.max()]
            X = X - U @ (U.t() @ X)
        values, vectors = torch.linalg.eigh(X[:, :count].t() @ X[:, :count])
        return values, vectors, unit[:count]

    @cached_property
    def covariance(self) -> Float64[np.ndarray, "frames frames"]:
        """Covariance of `frames` by the noise of the rows, the arm taken as exact [m and rad].

        The noise is that of the residuals. Directions that the rows do not determine have the covariance 0.
        """
        values, vectors, unit = self._directions
        known = values > UNDETERMINED * values.max()
        root = vectors[:, known] * values[known].rsqrt() * unit[:, None]
        covariance: np.ndarray = (root @ root.t()).numpy()
        return covariance

    @cached_property
    def weak_directions(self) -> tuple[WeakDirection, ...]:
        """Directions with a standard deviation of more than 1 mm or 1 mrad, the weakest first."""
        values, vectors, _ = self._directions
        names = [self.solved.problem.space.names[i] for i in self.frames]
        largest = float(values.max())
        return tuple(
            WeakDirection(
                direction_in_words(vector, names),
                math.inf if value <= UNDETERMINED * largest else value**-0.5,
            )
            for value, vector in zip(values.tolist(), vectors.t(), strict=True)
            if value < max(1.0, UNDETERMINED * largest)
        )

    @property
    def undetermined(self) -> frozenset[int]:
        """Indices of the coordinates that are part of a direction that the rows do not determine."""
        values, vectors, _ = self._directions
        lost = vectors[:, values <= UNDETERMINED * values.max()].norm(dim=1) > INVOLVED
        return frozenset(index for index, yes in zip(self.frames, lost.tolist(), strict=True) if yes)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The coordinates of bases and tools that were to be fitted."""
        return tuple(self.solved.problem.space.parameters[index] for index in self.frames)

    @property
    def estimates(self) -> Float64[np.ndarray, " frames"]:
        """Their values in the user's coordinates [m or rad]."""
        values: np.ndarray = self.solved.geometry.values_of(self.solved.problem.space).numpy()[self.frames]
        return values


def fit_frames(
    robot: Robot, rows: Measurements, only: FrameChoice, bases: Mapping[str, Float64[np.ndarray, " 6"]]
) -> FrameFit:
    """Fit base, tool or both by least squares, without the rows that all others contradict.

    The arm is not fitted. A row is wrong if its error under the fit to the other rows is improbable (F-test of the
    deleted residual, see `most_deviating_row`).

    Args:
        robot: robot with the arm as given, and the base or tool that is not fitted.
        rows: touches, positions, poses or images; sockets are points at unknown positions.
        only: what to fit; the tool's orientation only if rows have orientations.
        bases: bases of named frames that are not fitted, if they are not that of the robot.

    Raises:
        IdentificationError: there are too few rows.
        PoseError: the joint values do not fit the robot.
    """
    turned = bool({"pose", "rotation"} & set(rows.kinds))
    calibrator = GeometricCalibrator(
        robot,
        free=(),
        base="fixed" if only == "tool" else "free",
        tool="fixed" if only == "base" else "free" if turned else "position",
        prior=None,
        loss=SquaredLoss(),
        frames={name: tuple(base) for name, base in bases.items()} if only == "tool" else {},
    )
    used, wrong = list(range(rows.rows)), list[WrongRow]()
    fit = FrameFit(only, calibrator.solve(rows), rows, tuple(used), ())
    while len(wrong) + 1 <= MAX_WRONG_SHARE * rows.rows:
        values = fit.values
        tested = most_deviating_row(values.X, values.y, values.row, values.exact)
        if tested is None or not tested.is_wrong:
            break
        number = used[int(fit.solved.setup.rows[tested.row])]
        used.remove(number)
        fit = FrameFit(only, calibrator.solve(rows.select(torch.tensor(used))), rows, tuple(used), ())
        wrong.append(_wrong_row(fit, number, tested))
    return FrameFit(only, fit.solved, rows, tuple(used), tuple(wrong))


def _wrong_row(fit: FrameFit, number: int, tested: RowTest) -> WrongRow:
    """Return a row that was left out, with its error under the fit to all other rows."""
    row = fit.rows.select(torch.tensor([number]))
    errors = fit.solved.result().errors_of(row)
    size = {"m": math.nan, "rad": math.nan}
    for name, error in errors.items():
        if bool(torch.isfinite(error).all()):
            size["rad" if name == "rotation" else "m"] = float(error.norm())
    return WrongRow(number, fit.rows.place(number), size["m"], size["rad"], tested.probability)
