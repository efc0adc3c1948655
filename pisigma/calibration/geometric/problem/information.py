"""Identification Jacobian of a data set, condensed to a small triangular matrix."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.noise import ContributionsAndNoise
from pisigma.calibration.geometric.problem.parameters import Parameter
from pisigma.calibration.geometric.problem.problem import CalibrationProblem

_DEPENDENT = 1e-10
"""Share of a column's length outside the span of other columns below which the column is treated as dependent."""


@dataclass(frozen=True, eq=False)
class Information:
    """Information of the data on the parameters, in units of their usual errors (1 mm, 1 mrad).

    With the identification Jacobian J of all rows (in mm and mrad, or in standard deviations) and the residuals r,
    `[J r 1] = Q · root`.

    Attributes:
        parameters: parameters of the columns of J.
        root: upper triangular matrix; its last column belongs to the ones, the previous column to the residuals.
        values: number of rows of J minus the number of eliminated directions.
        poses: number of measured rows.
    """

    parameters: tuple[Parameter, ...]
    root: Float64[np.ndarray, "rank columns"]
    values: int
    poses: int

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def jacobian(self) -> Float64[np.ndarray, "rank parameters"]:
        """Condensed Jacobian: a small matrix with the same Gram matrix as J."""
        return self.root[:, :-2]

    @property
    def residual(self) -> Float64[np.ndarray, " rank"]:
        """Condensed residuals: products with `jacobian` and with itself equal those of r with J and with itself."""
        return self.root[:, -2]

    @property
    def centred_jacobian(self) -> Float64[np.ndarray, "rank parameters"]:
        """Condensed Jacobian after subtraction of the mean of every column of J."""
        ones_first: np.ndarray = np.linalg.qr(np.roll(self.root, 1, axis=1), mode="r")  # type: ignore[assignment]
        return ones_first[1:, 1:-1]

    def without_parameter(self, column: int) -> "Information":
        """Return the information without one parameter."""
        parameters = self.parameters[:column] + self.parameters[column + 1 :]
        return replace(self, parameters=parameters, root=np.delete(self.root, column, 1))

    def eliminate(self, nuisance: list[int], zeroed: Sequence[int] = ()) -> "Information":
        """Eliminate nuisance parameters by projecting the other columns onto the complement of their columns.

        Args:
            nuisance: indices of columns that are eliminated and removed.
            zeroed: indices of columns that are eliminated and kept as zeros.
        """
        if not nuisance and not zeroed:
            return self
        taken = self.jacobian[:, [*nuisance, *zeroed]]
        # Columns have different units, so they are scaled before their rank is decided.
        lengths = np.linalg.norm(taken, axis=0)
        U, singular, _ = np.linalg.svd(taken / np.where(lengths > 0, lengths, 1.0), full_matrices=False)
        U = U[:, singular > _DEPENDENT * singular.max(initial=0.0)]
        kept = [i for i in range(len(self.parameters)) if i not in set(nuisance)]
        rest = np.delete(self.root, nuisance, 1)
        sizes = np.linalg.norm(rest, axis=0)
        for _ in range(2):  # one projection leaves rounding errors relative to the column's length
            rest = rest - U @ (U.T @ rest)
        # The remainder of a dependent column is a rounding error, which must not look identifiable.
        rest[:, np.linalg.norm(rest, axis=0) <= _DEPENDENT * sizes] = 0.0
        rest[:, [kept.index(column) for column in zeroed]] = 0.0
        root: np.ndarray = np.linalg.qr(rest, mode="r")  # type: ignore[assignment]
        parameters = tuple(self.parameters[i] for i in kept)
        return replace(self, parameters=parameters, root=root, values=self.values - U.shape[1])


def information(
    problem: CalibrationProblem,
    point: Float64[Tensor, " parameters"],
    candidates: list[int],
    view: ContributionsAndNoise | None = None,
) -> Information:
    """Condense the Jacobian at a point by QR factorisations, chunk by chunk.

    Normal equations are avoided, so that singular values down to 1e-15 of the largest value are accurate.

    Args:
        problem: rows and sensors; the prior is not used.
        point: values of all parameters.
        candidates: indices of the parameters to analyse.
        view: noise for weights of 1 / standard deviation; None for weights of 1/mm and 1/mrad.
    """
    index = torch.tensor(candidates, dtype=torch.int64, device=point.device)
    blocks: list[Tensor] = []
    unknowns = problem.space.sensor_unknowns(point)
    for rows in problem.chunks():
        motion = problem.motion(point, rows, index)
        for k, sensor in enumerate(problem.sensors):
            J, r = (
                problem.prediction_derivative(sensor, motion, unknowns, rows, index),
                sensor.residual(motion, unknowns, rows),
            )
            weight = torch.full_like(r[0], 1e3) if view is None else _row_weights(problem, view, k, rows)
            if not problem.measured_in_every_row[k]:
                present = sensor.present[rows]
                J, r, weight = J[..., present], r[:, present], weight[present]
            # Residual and weight are two further columns, so that R also contains misfit and weighted means.
            block = r.new_empty((len(candidates) + 2, *r.shape))
            torch.mul(J, weight, out=block[:-2])
            torch.mul(r, weight, out=block[-2])
            block[-1] = weight
            blocks.append(block.flatten(1))
        # R has the same J^T J as all rows so far and replaces them, so memory does not grow with the rows.
        blocks = [torch.linalg.qr(torch.cat(blocks, 1).t(), mode="r").R.t()]
    usual = np.append(problem.space.usual_errors[candidates], (1.0, 1.0))
    present = torch.stack([sensor.present for sensor in problem.sensors]).any(0)
    parameters = tuple(problem.space.parameters[i] for i in candidates)
    root = blocks[0].t().cpu().numpy() * usual
    return Information(parameters, root, sum(problem.measured_value_counts), int(present.sum()))


def _row_weights(
    problem: CalibrationProblem, view: ContributionsAndNoise, number: int, rows: slice
) -> Float64[Tensor, " poses"]:
    """Compute 1 / standard deviation of every row for a sensor [1/m or 1/rad]; 0 in rows without a value."""
    sensor = problem.sensors[number]
    distance = view.contributions[number].residual_length[rows] / view.loss_scales[number]
    root = problem.loss_for_sensor(sensor).weight(distance, sensor.components).sqrt()
    root = root / view.variances[number].sqrt()
    if sensor.sigma is not None:
        root = root / sensor.sigma[rows]
    return torch.where(sensor.present[rows], root, 0.0)
