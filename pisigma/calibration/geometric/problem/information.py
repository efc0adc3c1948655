"""The identification Jacobian of a whole data set, condensed to a small triangular matrix."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.noise import SensorView
from pisigma.calibration.geometric.problem.parameters import Parameter
from pisigma.calibration.geometric.problem.problem import CalibrationProblem

SEEN = 1e-10
"""Columns that lie in others but for this share are taken to lie in them."""


@dataclass(frozen=True, eq=False)
class Information:
    """What the data say of each parameter, in units of its usual error (1 mm, 1 mrad).

    With J the identification Jacobian of all rows (in mm and mrad, or in standard deviations) and r the
    residuals, `[J r 1] = Q · root`.

    Attributes:
        parameters: what the columns of J belong to.
        root: upper triangular; its last column belongs to ones, that before it to the residuals.
        values: number of rows of J, less those that other parameters took.
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
        """A small matrix with the same Gram matrix as J."""
        return self.root[:, :-2]

    @property
    def residual(self) -> Float64[np.ndarray, " rank"]:
        """A small vector with the same products with `jacobian` and itself as r has with J and itself."""
        return self.root[:, -2]

    @property
    def centred(self) -> Float64[np.ndarray, "rank parameters"]:
        """The same after the mean of every column of J was taken off."""
        ones_first: np.ndarray = np.linalg.qr(np.roll(self.root, 1, axis=1), mode="r")  # type: ignore[assignment]
        return ones_first[1:, 1:-1]

    def without(self, column: int) -> "Information":
        """The same without one parameter."""
        parameters = self.parameters[:column] + self.parameters[column + 1 :]
        return replace(self, parameters=parameters, root=np.delete(self.root, column, 1))

    def after(self, nuisance: list[int], silent: Sequence[int] = ()) -> "Information":
        """What is left for the other parameters when these columns may take any value.

        Args:
            nuisance: numbers of the columns; they are left out.
            silent: numbers of more of them, which stay, as zeros.
        """
        if not nuisance and not silent:
            return self
        taken = self.jacobian[:, [*nuisance, *silent]]
        lengths = np.linalg.norm(taken, axis=0)
        U, singular, _ = np.linalg.svd(taken / np.where(lengths > 0, lengths, 1.0), full_matrices=False)
        U = U[:, singular > SEEN * singular.max(initial=0.0)]
        kept = [i for i in range(len(self.parameters)) if i not in set(nuisance)]
        rest = np.delete(self.root, nuisance, 1)
        sizes = np.linalg.norm(rest, axis=0)
        for _ in range(2):
            rest = rest - U @ (U.T @ rest)
        rest[:, np.linalg.norm(rest, axis=0) <= SEEN * sizes] = 0.0
        rest[:, [kept.index(column) for column in silent]] = 0.0
        root: np.ndarray = np.linalg.qr(rest, mode="r")  # type: ignore[assignment]
        parameters = tuple(self.parameters[i] for i in kept)
        return replace(self, parameters=parameters, root=root, values=self.values - U.shape[1])


def information(
    problem: CalibrationProblem,
    point: Float64[Tensor, " parameters"],
    candidates: list[int],
    view: SensorView | None = None,
) -> Information:
    """Condense the Jacobian at a point by QR factorisations, chunk by chunk.

    No normal equations are formed, so that singular values down to 1e-15 of the largest stay right.

    Args:
        problem: rows and sensors; the prior does not enter.
        point: values of all parameters.
        candidates: indices of the parameters to look at.
        view: gives the rows' weights, in 1 / standard deviations; in 1/mm and 1/mrad where None.
    """
    index = torch.tensor(candidates, dtype=torch.int64, device=point.device)
    blocks: list[Tensor] = []
    unknowns = problem.space.sensor_unknowns(point)
    for rows in problem.chunks():
        motion = problem.motion(point, rows, index)
        for k, sensor in enumerate(problem.sensors):
            J, r = (
                problem.derivative(sensor, motion, unknowns, rows, index),
                sensor.residual(motion, unknowns, rows),
            )
            weight = torch.full_like(r[0], 1e3) if view is None else _row_weights(problem, view, k, rows)
            if not problem.measured_everywhere[k]:
                present = sensor.present[rows]
                J, r, weight = J[..., present], r[:, present], weight[present]
            block = r.new_empty((len(candidates) + 2, *r.shape))
            torch.mul(J, weight, out=block[:-2])
            torch.mul(r, weight, out=block[-2])
            block[-1] = weight
            blocks.append(block.flatten(1))
        blocks = [torch.linalg.qr(torch.cat(blocks, 1).t(), mode="r").R.t()]
    usual = np.append(problem.space.usual_errors[candidates], (1.0, 1.0))
    present = torch.stack([sensor.present for sensor in problem.sensors]).any(0)
    parameters = tuple(problem.space.parameters[i] for i in candidates)
    root = blocks[0].t().cpu().numpy() * usual
    return Information(parameters, root, sum(problem.values_measured), int(present.sum()))


def _row_weights(
    problem: CalibrationProblem, view: SensorView, number: int, rows: slice
) -> Float64[Tensor, " poses"]:
    """1 / standard deviation of each row for a sensor, 0 where it saw nothing [1/m or 1/rad]."""
    sensor = problem.sensors[number]
    distance = view.sums[number].distance[rows] / view.scales[number]
    root = problem.loss_of(sensor).weight(distance, sensor.components).sqrt()
    root = root / view.variances[number].sqrt()
    if sensor.sigma is not None:
        root = root / sensor.sigma[rows]
    return torch.where(sensor.present[rows], root, 0.0)
