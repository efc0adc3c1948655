"""Corrected inverse kinematics: joint values that really reach a pose."""

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from pisigma.correction.calibrated_model import CalibratedModel
from pisigma.correction.model_folder import load_model
from pisigma.errors import PoseError, nearest_choice
from pisigma.kinematics.closed_form import closed_form_solver
from pisigma.kinematics.forward import forward_kinematics
from pisigma.kinematics.numeric import solve_numeric
from pisigma.kinematics.status import Status
from pisigma.se3 import check_transforms, pose_error, wrap_to_pi

PoseLike = Tensor | np.ndarray | Sequence[Sequence[float]]

NUMERIC = "numeric"
"""Name of the only branch of a robot without closed-form inverse: the one of the nearest training rows."""

_ATTEMPTS = 4
"""Starts that the numeric inverse tries for a pose, nearest first."""


@dataclass(frozen=True, eq=False)
class Solution:
    """What the robot has to be commanded to reach poses, and how far that can be trusted.

    Attributes:
        q: corrected joint values [rad or m], NaN where the status is `UNREACHABLE`.
        q_nominal: joint values of the nominal robot.
        correction: `q - q_nominal`.
        branch: index into `branches`.
        branches: names of the branches.
        status: a `Status` per pose; the most serious finding counts, in the order unreachable, not converged, outside
            joint limits, singular, outside the domain.
        domain_measure: distance to the training data over their spacing; above 1 the correction is extrapolated.
            NaN where there is no network.
    """

    q: Float[Tensor, "*batch dof"]
    q_nominal: Float[Tensor, "*batch dof"]
    correction: Float[Tensor, "*batch dof"]
    branch: Int64[Tensor, "*batch"]
    branches: tuple[str, ...]
    status: Int64[Tensor, "*batch"]
    domain_measure: Float[Tensor, "*batch"]

    def select(self, index: int | Tensor | slice) -> "Solution":
        """The solutions at an index of the first batch axis."""
        return Solution(
            self.q[index],
            self.q_nominal[index],
            self.correction[index],
            self.branch[index],
            self.branches,
            self.status[index],
            self.domain_measure[index],
        )


class CorrectedIK:
    """The corrected inverse kinematics of a model: call it with poses.

    Attributes:
        model: what it was made from.
        branches: names of the branches it knows.
    """

    def __init__(self, model: CalibratedModel) -> None:
        self.model = model
        self._solver = closed_form_solver(model.robot)
        self.branches: tuple[str, ...] = self._solver.branches if self._solver else (NUMERIC,)
        trained = [self.branches.index(name) for name in model.branches]
        self._default = trained[0] if trained else 0
        self._trained = torch.tensor(trained or list(range(len(self.branches))))
        self._start_poses = forward_kinematics(model.robot, model.starts)

    def __call__(
        self,
        T_base_tool: PoseLike,
        *,
        near: Float[Tensor, "... dof"] | None = None,
        branch: str | None = None,
    ) -> Solution:
        """Find corrected joint values for poses.

        Args:
            T_base_tool: `(*batch, 4, 4)` wanted poses of the tool in the base frame [m].
            near: joint values [rad or m]; of the branches that reach a pose the nearest is taken.
            branch: name of the branch to take; without `near` and `branch` it is the one the model was trained on.

        Returns:
            One solution per pose, in the dtype and on the device of `T_base_tool`.

        Raises:
            PoseError: a matrix is no pose, or the branch is unknown.
        """
        T, like = self._check(T_base_tool)
        if self._solver is None:
            return _cast(self._finish(T, *self._solve_from_starts(T, near)), like)
        every = self._all_branches(T)
        if branch is not None:
            if branch not in self.branches:
                raise PoseError(f"there is no branch '{branch}'; {nearest_choice(branch, self.branches)}")
            index = torch.full(T.shape[:-2], self.branches.index(branch))
        elif near is not None:
            index = self._nearest(every, near.to(T))
        else:
            index = torch.full(T.shape[:-2], self._default)
        return _cast(_pick(every, index), like)

    def all_branches(self, T_base_tool: PoseLike) -> Solution:
        """Solutions on every branch, as `(*batch, branches)`; one for a robot without closed-form inverse."""
        T, like = self._check(T_base_tool)
        if self._solver is not None:
            return _cast(self._all_branches(T), like)
        one = self._finish(T, *self._solve_from_starts(T, None))
        parts = (one.q, one.q_nominal, one.correction)
        q, q_nominal, correction = (part.unsqueeze(-2) for part in parts)
        branch, status, measure = (part.unsqueeze(-1) for part in (one.branch, one.status, one.domain_measure))
        return _cast(Solution(q, q_nominal, correction, branch, one.branches, status, measure), like)

    def _check(self, poses: PoseLike) -> tuple[Tensor, Tensor]:
        try:
            given = poses if isinstance(poses, Tensor) else torch.as_tensor(np.asarray(poses, dtype=np.float64))
        except (TypeError, ValueError):
            raise PoseError("the poses are no array of numbers; give matrices of shape (..., 4, 4).") from None
        if given.shape[-2:] != (4, 4):
            raise PoseError(f"poses of shape (..., 4, 4) were wanted, got {tuple(given.shape)}.")
        if not given.is_floating_point():
            raise PoseError(f"poses of floating-point numbers were wanted, got {given.dtype}.")
        check_transforms(given, "the pose", tolerance=1e-6 if given.dtype == torch.float64 else 1e-4)
        return given.detach().to("cpu", torch.float64), given

    def _all_branches(self, T: Tensor) -> Solution:
        assert self._solver is not None
        found = self._solver.solve(T)
        count = len(self.branches)
        index = torch.arange(count).expand(*T.shape[:-2], count)
        return self._finish(T.unsqueeze(-3).expand(*T.shape[:-2], count, 4, 4), found.q, found.status, index)

    def _solve_from_starts(self, T: Tensor, near: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Numeric inverse from `near`, or from the training rows whose poses are nearest."""
        flat = T.reshape(-1, 4, 4)
        if near is not None:
            starts = near.to(T).expand(*T.shape[:-2], -1).reshape(-1, 1, self.model.robot.dof)
        else:
            error = pose_error(flat[:, None], self._start_poses[None])
            distance = error[..., :3].norm(dim=-1) + self.model.robot.reach / 2 * error[..., 3:].norm(dim=-1)
            nearest = distance.topk(min(_ATTEMPTS, distance.shape[-1]), largest=False).indices
            starts = self.model.starts[nearest]
        found = solve_numeric(self.model.robot, flat, starts[:, 0])
        q, status = found.q.clone(), found.status.clone()
        for attempt in range(1, starts.shape[1]):
            open_rows = (status == Status.NOT_CONVERGED).nonzero()[:, 0]
            if not len(open_rows):
                break
            again = solve_numeric(self.model.robot, flat[open_rows], starts[open_rows, attempt])
            q[open_rows], status[open_rows] = again.q, again.status
        lost = status == Status.NOT_CONVERGED
        q[lost] = torch.nan
        status[lost] = Status.UNREACHABLE
        shape = T.shape[:-2]
        return q.reshape(*shape, -1), status.reshape(shape), torch.zeros(shape, dtype=torch.int64)

    def _finish(self, T: Tensor, q_nominal: Tensor, status: Tensor, branch: Tensor) -> Solution:
        """Add the correction and everything that limits the trust in it."""
        found = torch.isfinite(q_nominal).all(-1)
        safe = torch.where(found[..., None], q_nominal, torch.zeros_like(q_nominal))
        correction = torch.where(found[..., None], self.model.correction(T, safe), torch.nan)
        q = q_nominal + correction
        status = status.clone()
        measure = torch.full(status.shape, torch.nan, dtype=torch.float64)
        if self.model.network is not None and self.model.domain is not None:
            measure = self.model.domain.measure(self.model.network.scaled_inputs(T, safe)).where(found, measure)
            foreign = ~torch.isin(branch, self._trained)
            status[(status == Status.REACHED) & ((measure > 1) | foreign)] = Status.OUTSIDE_DOMAIN
        limits = torch.from_numpy(self.model.robot.limits)
        beyond = ((q < limits[:, 0]) | (q > limits[:, 1])).any(-1)
        status[beyond & (status != Status.UNREACHABLE)] = Status.OUTSIDE_JOINT_LIMITS
        return Solution(q, q_nominal, correction, branch, self.branches, status, measure)

    def _nearest(self, every: Solution, near: Tensor) -> Tensor:
        """Index of the reaching branch whose joint values are nearest to `near`."""
        difference = every.q - near.unsqueeze(-2)
        revolute = torch.tensor(self.model.robot.revolute)
        difference = torch.where(revolute, wrap_to_pi(difference), difference)
        distance = difference.square().sum(-1)
        usable = (every.status != Status.UNREACHABLE) & (every.status != Status.OUTSIDE_JOINT_LIMITS)
        distance = torch.where(usable & torch.isfinite(distance), distance, torch.inf)
        return distance.argmin(-1)


def load(folder: str | os.PathLike[str]) -> CorrectedIK:
    """Load a model folder as corrected inverse kinematics.

    Args:
        folder: what `pisigma train` or `pisigma calibrate` wrote.

    Raises:
        ModelError: the folder is no whole model; the message says what is wrong with which file.
    """
    return CorrectedIK(load_model(folder))


def _pick(every: Solution, index: Tensor) -> Solution:
    def along(values: Tensor) -> Tensor:
        extra = index[..., None, None].expand(*index.shape, 1, values.shape[-1])
        return values.gather(-2, extra)[..., 0, :]

    def single(values: Tensor) -> Tensor:
        return values.gather(-1, index[..., None])[..., 0]

    return Solution(
        along(every.q),
        along(every.q_nominal),
        along(every.correction),
        single(every.branch),
        every.branches,
        single(every.status),
        single(every.domain_measure),
    )


def _cast(solution: Solution, like: Tensor) -> Solution:
    """Give the solution in the dtype and on the device of the poses."""
    return Solution(
        solution.q.to(like),
        solution.q_nominal.to(like),
        solution.correction.to(like),
        solution.branch.to(like.device),
        solution.branches,
        solution.status.to(like.device),
        solution.domain_measure.to(like),
    )
