"""Corrected inverse kinematics: joint values that really reach a pose."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pisigma.correction.calibrated_model import CalibratedModel
from pisigma.correction.model_folder import load_model
from pisigma.correction.solution import Solution
from pisigma.correction.turns import turn_near
from pisigma.errors import ModelError, PoseError, nearest_choice
from pisigma.kinematics.closed_form import closed_form_solver
from pisigma.kinematics.forward import forward_kinematics
from pisigma.kinematics.joint_limits import turn_into_limits
from pisigma.kinematics.numeric import SINGULAR_TOLERANCE, solve_numeric
from pisigma.kinematics.singularity import singularity_measure
from pisigma.kinematics.status import Status
from pisigma.robot.description import Robot
from pisigma.se3 import check_transforms, wrap_to_pi

PoseLike = Tensor | np.ndarray | Sequence[Any]
"""Matrices `(*batch, 4, 4)`: a tensor, an array or nested lists."""

JointLike = Tensor | np.ndarray | Sequence[Any]
"""Joint values `(*batch, dof)`: a tensor, an array or nested lists."""

NUMERIC = "numeric"
"""Name of the only branch of a robot without closed-form inverse: the one of the nearest training rows."""

_ATTEMPTS = 4
"""Starts that the numeric inverse tries for a pose, nearest first."""

_CHUNK = 4096
"""Poses whose distances to all starts are computed at once."""


class CorrectedIK:
    """The corrected inverse kinematics of a model: call it with poses.

    Attributes:
        model: what it was made from.
        branches: names of the branches it knows.
    """

    def __init__(self, model: CalibratedModel) -> None:
        """Prepare a model for calls.

        Raises:
            ModelError: the model names branches that its robot does not have, or gives the numeric inverse no
                start.
        """
        self.model = model
        self._solver = closed_form_solver(model.robot)
        self.branches: tuple[str, ...] = self._solver.branches if self._solver else (NUMERIC,)
        for name in model.branches:
            if name not in self.branches:
                choices = nearest_choice(name, self.branches)
                raise ModelError(f"model '{model.name}': its robot has no branch '{name}'; {choices}")
        if self._solver is None and not len(model.starts):
            raise ModelError(
                f"model '{model.name}': its robot has no closed-form inverse, and the model holds no joint "
                "values to start from; train it again."
            )
        trained = [self.branches.index(name) for name in model.branches] or list(range(len(self.branches)))
        self._default = trained[0]
        self._trained = torch.tensor(trained)
        self._start_poses = forward_kinematics(model.robot, model.starts)
        dof = model.robot.dof
        bounds = model.starts.aminmax(dim=0) if len(model.starts) else (torch.zeros(dof), torch.zeros(dof))
        self._centre = (bounds[0] + bounds[1]).double() / 2

    def __call__(
        self, T_base_tool: PoseLike, *, near: JointLike | None = None, branch: str | None = None
    ) -> Solution:
        """Find corrected joint values for poses.

        Args:
            T_base_tool: `(*batch, 4, 4)` wanted poses of the tool in the base frame [m].
            near: joint values `(*batch, dof)` [rad or m], such as the robot's present ones; of the branches
                that reach a pose the nearest is taken, and revolute joints come as near as full turns within
                the limits bring them. Distances count radians and metres alike.
            branch: name of the branch to take; with `near` too, that only chooses the turns. With neither it
                is the branch that most training rows lie on.

        Returns:
            One solution per pose, computed on the CPU in float64 (the closed form in the dtype of the poses)
            and given in the dtype and on the device of `T_base_tool`.

        Raises:
            PoseError: a matrix is no pose, `near` does not fit, or the branch is unknown.
        """
        if branch is not None and branch not in self.branches:
            raise PoseError(f"there is no branch '{branch}'; {nearest_choice(branch, self.branches)}")
        T, given = _as_poses(T_base_tool)
        start = None if near is None else self._as_near(near, T.shape[:-2])
        if self._solver is None:
            return self._numeric(T, start).like(given)
        every = self._every_branch(T, given, start)
        if branch is not None:
            index = torch.full(T.shape[:-2], self.branches.index(branch))
        elif start is not None:
            index = self._nearest(every, start)
        else:
            index = torch.full(T.shape[:-2], self._default)
        return every.on_branch(index).like(given)

    def all_branches(self, T_base_tool: PoseLike) -> Solution:
        """Solutions on every branch, as `(*batch, branches)`; one for a robot without closed-form inverse."""
        T, given = _as_poses(T_base_tool)
        if self._solver is not None:
            return self._every_branch(T, given, None).like(given)
        return self._numeric(T, None).with_branch_axis().like(given)

    def _as_near(self, near: JointLike, batch: tuple[int, ...]) -> Tensor:
        """Joint values for every pose, float64 on the CPU."""
        values = _as_numbers(near, "near", "joint values of shape (*batch, joints)").to("cpu", torch.float64)
        self.model.robot.check_joint_count(values.shape[-1] if values.ndim else 0)
        if not torch.isfinite(values).all():
            raise PoseError(
                "near holds joint values that are no finite numbers; give a number for every joint."
            )
        try:
            return values.expand(*batch, values.shape[-1])
        except RuntimeError:
            raise PoseError(
                f"near has the batch shape {tuple(values.shape[:-1])}, which does not broadcast to "
                f"{tuple(batch)} of the poses; give one row of joint values for each pose, or one for all."
            ) from None

    def _every_branch(self, T: Tensor, given: Tensor, near: Tensor | None) -> Solution:
        assert self._solver is not None
        found = self._solver.solve(given.detach().to("cpu"))
        count = len(self.branches)
        branch = torch.arange(count).expand(*T.shape[:-2], count)
        each = T.unsqueeze(-3).expand(*T.shape[:-2], count, 4, 4)
        beside = None if near is None else near.unsqueeze(-2).expand(*T.shape[:-2], count, -1)
        return self._finish(each, found.q.double(), found.status, branch, beside)

    def _numeric(self, T: Tensor, near: Tensor | None) -> Solution:
        """Numeric inverse from `near`, or from the training rows whose poses are nearest."""
        flat = T.reshape(-1, 4, 4)
        dof = self.model.robot.dof
        starts = self._nearest_starts(flat) if near is None else near.reshape(-1, 1, dof)
        found = solve_numeric(self.model.robot, flat, starts[:, 0])
        q, status = found.q.clone(), found.status.clone()
        for attempt in range(1, starts.shape[1]):
            left = (status == Status.NOT_CONVERGED).nonzero()[:, 0]
            if not len(left):
                break
            again = solve_numeric(self.model.robot, flat[left], starts[left, attempt])
            q[left], status[left] = again.q, again.status
        lost = status == Status.NOT_CONVERGED
        q[lost], status[lost] = torch.nan, int(Status.UNREACHABLE)
        shape = T.shape[:-2]
        branch = torch.zeros(shape, dtype=torch.int64)
        return self._finish(T, q.reshape(*shape, dof), status.reshape(shape), branch, near)

    def _nearest_starts(self, T: Tensor) -> Tensor:
        """For every pose the joint values of the training rows whose poses are nearest, nearest first."""
        count = min(_ATTEMPTS, len(self.model.starts))
        poses, rows = self._as_points(T), self._as_points(self._start_poses)
        nearest = [torch.zeros((0, count), dtype=torch.int64)]
        for first in range(0, len(poses), _CHUNK):
            distance = torch.cdist(poses[first : first + _CHUNK], rows)
            nearest.append(distance.topk(count, largest=False).indices)
        return self.model.starts[torch.cat(nearest)]

    def _as_points(self, T: Tensor) -> Tensor:
        """Poses as points; their distance is that of the tools [m], plus half a reach per radian of turn."""
        lever = self.model.robot.reach / 2 / 2**0.5  # a small turn changes R by sqrt(2) times its angle
        return torch.cat([T[:, :3, 3], lever * T[:, :3, :3].flatten(1)], -1)

    def _finish(self, T: Tensor, q: Tensor, status: Tensor, branch: Tensor, near: Tensor | None) -> Solution:
        """Add the correction to nominal joint values, and everything that limits the trust in it."""
        robot = self.model.robot
        found = torch.isfinite(q).all(-1)
        safe = torch.where(found[..., None], q, torch.zeros_like(q))
        seen = turn_near(robot, safe, self._centre, within_limits=False)  # as the training rows were turned
        correction = torch.where(found[..., None], self.model.correction(T, seen), torch.nan)
        status = self._without_limits(safe, status)
        if self.model.calibrated is not None:
            correction, status, found = self._on_calibrated(self.model.calibrated, T, safe, status, found)
        corrected = q + correction
        commanded, inside = turn_into_limits(robot, corrected)
        if near is not None:
            commanded = turn_near(robot, commanded, near, within_limits=True)
        measure = torch.full(status.shape, torch.nan, dtype=torch.float64)
        if self.model.network is not None and self.model.domain is not None:
            measure = self.model.domain.measure(self.model.network.scaled_inputs(T, seen)).where(
                found, measure
            )
            outside = ~(measure <= 1) | ~torch.isin(branch, self._trained)
            status[(status == Status.REACHED) & outside] = int(Status.OUTSIDE_DOMAIN)
        status[~inside & (status != Status.UNREACHABLE)] = int(Status.OUTSIDE_JOINT_LIMITS)
        turned = commanded - corrected  # 0 where no turn was made
        return Solution(commanded, q + turned, correction, branch, self.branches, status, measure)

    def _on_calibrated(
        self, calibrated: Robot, T: Tensor, q: Tensor, status: Tensor, found: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Correction that reaches the poses on the identified geometry, from the nominal joint values on."""
        reached = solve_numeric(calibrated, T, q)
        arrived = found & (reached.status != Status.NOT_CONVERGED)
        difference = reached.q - q
        turns = torch.tensor(calibrated.revolute)
        difference = torch.where(turns, wrap_to_pi(difference), difference)
        status = torch.where(found & (reached.status == Status.SINGULAR), int(Status.SINGULAR), status)
        status = torch.where(arrived, status, int(Status.UNREACHABLE))
        return torch.where(arrived[..., None], difference, torch.nan), status, arrived

    def _without_limits(self, q: Tensor, status: Tensor) -> Tensor:
        """A copy of the status as if there were no joint limits, which bind the corrected values only."""
        status = status.clone()
        limited = status == Status.OUTSIDE_JOINT_LIMITS
        if limited.any():
            singular = singularity_measure(self.model.robot, q[limited]) < SINGULAR_TOLERANCE
            status[limited] = torch.where(singular, int(Status.SINGULAR), int(Status.REACHED))
        return status

    def _nearest(self, every: Solution, near: Tensor) -> Tensor:
        """Index of the branch nearest to `near`: of those that reach, else of those outside limits."""
        distance = (every.q - near.unsqueeze(-2)).square().sum(-1)
        lost = every.status == Status.UNREACHABLE
        rank = (every.status == Status.OUTSIDE_JOINT_LIMITS).long() + 2 * lost.long()
        distance = torch.where(rank == rank.amin(-1, keepdim=True), distance, torch.inf)
        return torch.where(lost.all(-1), self._default, distance.argmin(-1))


def load(folder: str | os.PathLike[str]) -> CorrectedIK:
    """Load a model folder as corrected inverse kinematics.

    Args:
        folder: what `pisigma train` wrote.

    Raises:
        ModelError: the folder is no whole model; the message says what is wrong with which file.
    """
    return CorrectedIK(load_model(folder))


def _as_numbers(values: PoseLike | JointLike, name: str, wanted: str) -> Tensor:
    """A floating-point tensor; float32 stays, integers become float64."""
    if isinstance(values, Tensor):
        given = values
    else:
        try:
            array = np.asarray(values)
            given = torch.as_tensor(array if array.dtype == np.float32 else array.astype(np.float64))
        except (TypeError, ValueError):
            raise PoseError(f"{name} is no array of numbers; give {wanted}.") from None
    if given.dtype not in (torch.float32, torch.float64):
        raise PoseError(f"{name} holds {given.dtype}; give float64 or float32.")
    return given


def _as_poses(poses: PoseLike) -> tuple[Tensor, Tensor]:
    """The poses as float64 on the CPU, and as they were given."""
    given = _as_numbers(poses, "T_base_tool", "homogeneous transforms of shape (*batch, 4, 4)")
    check_transforms(given, "T_base_tool", tolerance=1e-6 if given.dtype == torch.float64 else 1e-4)
    return given.detach().to("cpu", torch.float64), given
