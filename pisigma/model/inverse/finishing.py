"""From joint values that reach poses to solutions: turns, limits, the correction, and how far all that holds."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.inverse.identified_arm import search
from pisigma.model.inverse.solution import Solution
from pisigma.model.stored_starts import middle_of_starts
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.joint_limits import wrap_into_limits
from pisigma.robot.kinematics.singularity import singularity_measure
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.task_axes import TaskAxes
from pisigma.robot.kinematics.tolerances import LIMIT_TOLERANCE, SINGULAR_TOLERANCE


class Finishing:
    """The last steps to solutions of one model, the same for all ways that lead to joint values."""

    def __init__(
        self, model: CalibratedModel, branches: tuple[str, ...], trained: Sequence[int], axes: TaskAxes
    ) -> None:
        """Prepare for a model.

        Args:
            model: the model.
            branches: names of all branches.
            trained: indices of those that training rows lie on.
            axes: which axes of the tool count.
        """
        self._model, self._branches, self._axes = model, branches, axes
        self._trained = torch.tensor(trained)

    def of_nominal(
        self, T: Tensor, q: Tensor, status: Tensor, branch: Tensor, near: Tensor | None
    ) -> Solution:
        """Add the correction to nominal joint values, and everything that limits the trust in it."""
        known = torch.isfinite(q).all(-1)
        safe = torch.where(known[..., None], q, torch.zeros_like(q))
        turned = as_trained(self._model, safe)
        correction = torch.where(known[..., None], self._model.correction(T, turned), torch.nan)
        status = self._without_limits(safe, status)
        corrected = q + correction
        commanded, inside = self._turned(corrected, near)
        measure = torch.full(status.shape, torch.nan, dtype=torch.float64)
        if self._model.network is not None and self._model.domain is not None:
            measure = self._model.domain.measure(self._model.network.scaled_inputs(T, turned)).where(
                known, measure
            )
            outside = ~(measure <= 1) | ~torch.isin(branch, self._trained)
            status[(status == Status.REACHED) & outside] = int(Status.OUTSIDE_DOMAIN)
        status[~inside & (status != Status.UNREACHABLE)] = int(Status.OUTSIDE_JOINT_LIMITS)
        return self._solution(commanded, q + (commanded - corrected), branch, status, measure)

    def of_identified(
        self, T: Tensor, q: Tensor, q_nominal: Tensor, status: Tensor, branch: Tensor, near: Tensor | None
    ) -> Solution:
        """Put joint values of the identified arm beside the nominal ones, on the same turns."""
        known = torch.isfinite(q).all(-1)
        status = self._without_limits(torch.where(known[..., None], q, 0.0), status)
        commanded, inside = self._turned(q, near)
        measure = torch.full(status.shape, torch.nan, dtype=torch.float64)
        if self._model.hybrid is not None:
            commanded, inside = self._on_turn(T, commanded, inside)
            coverage = self._model.hybrid.coverage
            measure = 1 + coverage.beyond(commanded).amax(-1)
            outside = known & ~coverage.contains(commanded)
            status[(status == Status.REACHED) & outside] = int(Status.OUTSIDE_DOMAIN)
        status[~inside & known] = int(Status.OUTSIDE_JOINT_LIMITS)
        q_nominal = torch.where(known[..., None], q_nominal, torch.nan)
        q_nominal = nearest_turn(self._model.robot, q_nominal, commanded, within_limits=False)
        return self._solution(commanded, q_nominal, branch, status, measure)

    def _solution(
        self, q: Tensor, q_nominal: Tensor, branch: Tensor, status: Tensor, measure: Tensor
    ) -> Solution:
        """A solution whose residuals are still to be computed."""
        nothing = torch.full(status.shape, torch.nan, dtype=torch.float64)
        return Solution(q, q_nominal, branch, self._branches, status, nothing, nothing, measure)

    def _on_turn(self, T: Tensor, q: Tensor, inside: Tensor) -> tuple[Tensor, Tensor]:
        """Solve again on the turns to command where a correction is not the same on all turns."""
        hybrid = self._model.hybrid
        assert hybrid is not None
        if hybrid.correction.is_periodic:
            return q, inside
        flat = q.reshape(-1, 1, q.shape[-1])
        solved, status = search(self._model.identified, T.reshape(-1, 4, 4), flat, hybrid, axes=self._axes)
        settled = torch.where((status == Status.UNREACHABLE)[:, None], flat[:, 0], solved).reshape(q.shape)
        turned, within = wrap_into_limits(self._model.robot, settled)
        return settled, within & (turned == settled).all(-1)

    def _turned(self, q: Tensor, near: Tensor | None) -> tuple[Tensor, Tensor]:
        """Joint values on the turn to command, and whether they are inside the limits."""
        commanded, inside = wrap_into_limits(self._model.robot, q)
        if near is not None:
            commanded = nearest_turn(self._model.robot, commanded, near, within_limits=True)
        return commanded, inside

    def _without_limits(self, q: Tensor, status: Tensor) -> Tensor:
        """A copy of the status as if there were no joint limits, which bind the corrected values only."""
        status = status.clone()
        limited = status == Status.OUTSIDE_JOINT_LIMITS
        if limited.any():
            singular = singularity_measure(self._model.identified, q[limited]) < SINGULAR_TOLERANCE
            status[limited] = torch.where(singular, int(Status.SINGULAR), int(Status.REACHED))
        return status


def nearest_turn(
    robot: Robot, q: Float[Tensor, "*batch dof"], near: Float[Tensor, "... dof"], within_limits: bool
) -> Float[Tensor, "*batch dof"]:
    """Move revolute joints by full turns as near to given values as they can come.

    Args:
        robot: the robot.
        q: joint values [rad or m]; NaN stays NaN.
        near: where they shall come near to [rad or m]; broadcasts.
        within_limits: only to turns inside the joint limits; a joint that no turn brings inside stays.
    """
    turns = torch.round((near - q) / (2 * torch.pi))
    if within_limits:
        limits = torch.from_numpy(robot.limits).to(q)
        lowest = torch.ceil((limits[:, 0] - LIMIT_TOLERANCE - q) / (2 * torch.pi))
        highest = torch.floor((limits[:, 1] + LIMIT_TOLERANCE - q) / (2 * torch.pi))
        nearest = torch.maximum(torch.minimum(turns, highest), lowest)
        turns = torch.where(lowest <= highest, nearest, torch.zeros_like(turns))
    revolute = torch.tensor(robot.revolute, device=q.device)
    return torch.where(revolute & (turns != 0), q + 2 * torch.pi * turns, q)


def as_trained(model: CalibratedModel, q: Tensor) -> Tensor:
    """Joint values `(*batch, dof)` turned as those of the training rows, which a network knows."""
    if not len(model.starts):
        return q
    return nearest_turn(model.robot, q, middle_of_starts(model.starts), within_limits=False)
