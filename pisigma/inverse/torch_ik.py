"""Corrected inverse kinematics in torch: batches of tensors, with gradients."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from pisigma.errors import ModelError, PoseError, nearest_choice
from pisigma.inverse.fast_arm import FastArm
from pisigma.inverse.fast_rows import FastRows
from pisigma.inverse.fast_solver import FastSolver
from pisigma.inverse.pose_gradients import differentiable
from pisigma.inverse.pose_input import JointLike, PoseLike, as_numbers, as_poses
from pisigma.inverse.reference import ReferenceIK
from pisigma.inverse.solution import Solution
from pisigma.kinematics.closed_form import closed_form_solver
from pisigma.model.calibrated_model import CalibratedModel

NUMERIC = "numeric"
"""Name of the only branch of a robot without closed-form inverse: the one of the nearest training rows."""


class TorchIK:
    """The corrected inverse kinematics of a model: call it with poses.

    Attributes:
        model: what it was made from.
        branches: names of the branches it knows.
        order: indices of the branches: those that training rows lie on, most frequent first, then the others.
    """

    def __init__(self, model: CalibratedModel) -> None:
        """Prepare a model for calls.

        Raises:
            ModelError: the model names branches that its robot does not have, or gives the numeric inverse no
                start.
        """
        self.model = model
        solver = closed_form_solver(model.robot)
        self.branches: tuple[str, ...] = solver.branches if solver else (NUMERIC,)
        for name in model.branches:
            if name not in self.branches:
                choices = nearest_choice(name, self.branches)
                raise ModelError(f"model '{model.name}': its robot has no branch '{name}'; {choices}")
        if solver is None and not len(model.starts):
            raise ModelError(
                f"model '{model.name}': its robot has no closed-form inverse, and the model holds no joint "
                "values to start from; train it again."
            )
        trained = [self.branches.index(name) for name in model.branches] or list(range(len(self.branches)))
        self.order = (*trained, *(index for index in range(len(self.branches)) if index not in trained))
        self._reference = ReferenceIK(model, solver, self.branches, trained)
        self._fast: FastSolver | None = None
        if self._reference.arm is not None and FastArm.suits(model.robot):
            self._fast = FastSolver(self._reference.arm)

    def __call__(
        self, T_base_tool: PoseLike, *, near: JointLike | None = None, branch: str | None = None
    ) -> Solution:
        """Find corrected joint values for poses.

        Args:
            T_base_tool: `(*batch, 4, 4)` wanted poses of the tool in the base frame [m].
            near: joint values `(*batch, dof)` [rad or m], such as the robot's present ones; of the branches
                that reach a pose the nearest is taken, and revolute joints come as near as full turns within
                the limits bring them. Distances count radians and metres alike.
            branch: name of the branch to take; with `near` too, that only chooses the turns.

        With neither it is the first branch in `order` on which the corrected arm, followed from the nominal one,
        reaches the pose inside the joint limits; where there is none the first on which it does outside them. Where
        no branch leads there, and none was asked for, it is looked for from stored joint values too, and the branch
        given is that whose nominal joint values are nearest.

        Returns:
            One solution per pose, computed on the CPU in float64 (where that takes care, the closed form in the
            dtype of the poses) and given in the dtype and on the device of `T_base_tool`. Where these require
            gradients, gradients of `q`, `q_nominal` and `correction` flow to them; see `pose_gradients`.

        Raises:
            PoseError: a matrix is no pose, `near` does not fit, or the branch is unknown.
        """
        if branch is not None and branch not in self.branches:
            raise PoseError(f"there is no branch '{branch}'; {nearest_choice(branch, self.branches)}")
        T, given = as_poses(T_base_tool)
        start = None if near is None else self._as_near(near, T.shape[:-2])
        order = self.order if branch is None else (self.branches.index(branch),)
        if self._fast is None:
            return self._given(self._reference.solve(T, given, start, order), T, given)
        flat, beside = T.reshape(-1, 4, 4), None if start is None else start.reshape(-1, start.shape[-1])
        rows = self._fast.solve(flat, beside, order)
        found = self._of_rows(rows)
        left = (~rows.done).nonzero()[:, 0]
        if len(left):
            part = given.detach().reshape(-1, 4, 4)[left.to(given.device)]
            beside = None if beside is None else beside[left]
            found = found.with_rows(left, self._reference.solve(flat[left], part, beside, order))
        return self._given(found.reshaped(T.shape[:-2]), T, given)

    def all_branches(self, T_base_tool: PoseLike) -> Solution:
        """Solutions on every branch, as `(*batch, branches)`; one for a robot without closed-form inverse."""
        T, given = as_poses(T_base_tool)
        every = self._reference.all_branches(T, given)
        shape = (*every.status.shape, 4, 4)
        return self._given(every, T.unsqueeze(-3).expand(shape), given.unsqueeze(-3).expand(shape))

    def _of_rows(self, rows: FastRows) -> Solution:
        correction = rows.q - rows.q_nominal
        return Solution(
            rows.q, rows.q_nominal, correction, rows.branch, self.branches, rows.status, rows.measure
        )

    def _given(self, found: Solution, T: Tensor, given: Tensor) -> Solution:
        """Solutions as they are handed out: like the poses, and with what residuals are computed from."""
        if given.requires_grad and torch.is_grad_enabled():
            found = differentiable(self.model, found, given)
        return replace(found.like(given), wanted=T, model=self.model)

    def _as_near(self, near: JointLike, batch: Sequence[int]) -> Tensor:
        """Joint values for every pose, float64 on the CPU."""
        values = as_numbers(near, "near", "joint values of shape (*batch, joints)").detach()
        values = values.to("cpu", torch.float64)
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
