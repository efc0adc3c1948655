"""What compiled inverse kinematics gives back."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from pisigma.kinematics.status import Status


class CompiledSolution(NamedTuple):
    """What the robot has to be commanded to reach poses; see `correction.solution.Solution`.

    Attributes:
        q: `(*batch, dof)`: corrected joint values [rad or m], NaN where, and only where, the status is UNREACHABLE or
            INVALID_POSE.
        q_nominal: the same of the nominal robot, on the same turns; NaN too where it does not reach the pose.
        branch: index into `branches`: an int, or `(*batch,)`.
        branches: names of the branches.
        status: a `Status` as a number: an int, or `(*batch,)`.
        position_residual: distance of the tool from the wanted position [m], as far as the model knows.
        rotation_residual: angle of the tool to the wanted orientation [rad].
        domain_measure: above 1 the correction is extrapolated. For a hybrid 1 where every joint value was measured, up
            to 2 where only the geometric calibration holds; for a network the distance to the training rows over their
            spacing. NaN where nothing is learned or there is no solution.
        owner: the `CorrectedIK` that found it, which knows how accurate it is.
    """

    q: Any
    q_nominal: Any
    branch: Any
    branches: tuple[str, ...]
    status: Any
    position_residual: Any
    rotation_residual: Any
    domain_measure: Any
    owner: Any = None

    @property
    def correction(self) -> Any:
        """`q - q_nominal` [rad or m]."""
        return self.q - self.q_nominal

    @property
    def accuracy(self) -> Any:
        """Predicted standard deviation of the tool's position [m], `(*batch,)`; NaN where the model does not know it.

        It is computed with torch when it is asked for.
        """
        return np.full(np.shape(self.status), np.nan) if self.owner is None else self.owner.accuracy(self.q)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What every status means and what to do about it, all batch axes in a row."""
        return tuple(Status(status).sentence for status in np.ravel(self.status).tolist())

    def select(self, index: Any) -> "CompiledSolution":
        """The solutions at an index of the first batch axes."""
        return self._each(lambda values: values[index])

    def reshaped(self, batch: tuple[int, ...]) -> "CompiledSolution":
        """The same with other batch axes."""
        axes = np.ndim(self.status)
        return self._each(lambda values: values.reshape(*batch, *values.shape[axes:]))

    def _each(self, change: Callable[[Any], Any]) -> "CompiledSolution":
        return CompiledSolution(
            q=change(self.q),
            q_nominal=change(self.q_nominal),
            branch=change(self.branch),
            branches=self.branches,
            status=change(self.status),
            position_residual=change(self.position_residual),
            rotation_residual=change(self.rotation_residual),
            domain_measure=change(self.domain_measure),
            owner=self.owner,
        )


def width(dof: int) -> int:
    """How many numbers of a solution the kernels write."""
    return 2 * dof + 5


def solution_of_row(row: Any, dof: int, branches: tuple[str, ...]) -> CompiledSolution:
    """The solution of one pose, `(width,)`."""
    position, rotation, measure, status, branch = row[2 * dof :].tolist()
    q, nominal = row[:dof], row[dof : 2 * dof]
    return CompiledSolution(q, nominal, int(branch), branches, int(status), position, rotation, measure)


def solution_of_rows(rows: Any, dof: int, branches: tuple[str, ...]) -> CompiledSolution:
    """The solutions of poses, `(*batch, width)`."""
    position, rotation, measure, status, branch = np.moveaxis(rows[..., 2 * dof :], -1, 0)
    q, nominal = rows[..., :dof], rows[..., dof : 2 * dof]
    return CompiledSolution(
        q, nominal, branch.astype(int), branches, status.astype(int), position, rotation, measure
    )
