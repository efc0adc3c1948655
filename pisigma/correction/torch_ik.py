"""Corrected inverse kinematics in torch: batches of tensors, on any device."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from pisigma.correction.calibrated_model import CalibratedModel
from pisigma.correction.identified_arm import ATTEMPTS, IdentifiedArm, search
from pisigma.correction.pose_input import JointLike, PoseLike, as_numbers, as_poses
from pisigma.correction.solution import Solution
from pisigma.correction.stored_starts import StoredStarts
from pisigma.correction.turns import turn_near
from pisigma.errors import ModelError, PoseError, nearest_choice
from pisigma.kinematics.closed_form import closed_form_solver
from pisigma.kinematics.joint_limits import turn_into_limits
from pisigma.kinematics.numeric import SINGULAR_TOLERANCE
from pisigma.kinematics.singularity import singularity_measure
from pisigma.kinematics.status import Status

NUMERIC = "numeric"
"""Name of the only branch of a robot without closed-form inverse: the one of the nearest training rows."""

AWAY = 0.1
"""[rad or m] A solution farther from where it was to be near to may not be the one that was meant."""


class TorchIK:
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
        self._starts = StoredStarts(model.calibrated or model.robot, model.starts)
        self._arm: IdentifiedArm | None = None
        if model.calibrated is not None and self._solver is not None:
            self._arm = IdentifiedArm(model.robot, model.calibrated, self._solver, self._starts, model.hybrid)
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
                is the branch that most training rows lie on. With an identified geometry a pose that the
                nominal arm has no branch for gets the branch on which the identified one reaches it.

        Returns:
            One solution per pose, computed on the CPU in float64 (the closed form in the dtype of the poses)
            and given in the dtype and on the device of `T_base_tool`.

        Raises:
            PoseError: a matrix is no pose, `near` does not fit, or the branch is unknown.
        """
        if branch is not None and branch not in self.branches:
            raise PoseError(f"there is no branch '{branch}'; {nearest_choice(branch, self.branches)}")
        T, given = as_poses(T_base_tool)
        start = None if near is None else self._as_near(near, T.shape[:-2])
        if self._solver is None:
            return self._given(self._numeric(T, start), T, given)
        index = self._default if branch is None else self.branches.index(branch)
        free = start is not None and branch is None
        few: Sequence[int] = [index] if self._arm is not None and not free else range(len(self.branches))
        some = self._on_branches(T, given, start, few)
        chosen = torch.full(T.shape[:-2], few.index(index))
        found = some.on_branch(self._nearest(some, start) if start is not None and free else chosen)
        if self._arm is not None:
            found = self._recovered(T, given, found, start, any_branch=branch is None)
            if start is not None and free:
                found = self._continued(T, found, start)
        return self._given(found, T, given)

    def all_branches(self, T_base_tool: PoseLike) -> Solution:
        """Solutions on every branch, as `(*batch, branches)`; one for a robot without closed-form inverse."""
        T, given = as_poses(T_base_tool)
        if self._solver is not None:
            every = self._on_branches(T, given, None, range(len(self.branches)))
            if self._arm is not None:
                each = T.unsqueeze(-3).expand(*every.status.shape, 4, 4)
                every = self._recovered(each, given, every, None, any_branch=False)
        else:
            every = self._numeric(T, None).with_branch_axis()
        return self._given(every, T.unsqueeze(-3).expand(*every.status.shape, 4, 4), given)

    def _given(self, found: Solution, T: Tensor, given: Tensor) -> Solution:
        """Solutions as they are handed out: like the poses, and with what residuals are computed from."""
        return replace(found.like(given), wanted=T, model=self.model)

    def _as_near(self, near: JointLike, batch: tuple[int, ...]) -> Tensor:
        """Joint values for every pose, float64 on the CPU."""
        values = as_numbers(near, "near", "joint values of shape (*batch, joints)").to("cpu", torch.float64)
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

    def _on_branches(self, T: Tensor, given: Tensor, near: Tensor | None, indices: Sequence[int]) -> Solution:
        """Solutions on some branches, as a last batch axis, each from its nominal joint values on."""
        assert self._solver is not None
        found = self._solver.solve(given.detach().to("cpu"))
        branch = torch.tensor(indices).expand(*T.shape[:-2], len(indices))
        q, status = found.q[..., indices, :].double(), found.status[..., indices]
        each = T.unsqueeze(-3).expand(*branch.shape, 4, 4)
        beside = None if near is None else near.unsqueeze(-2).expand(*branch.shape, -1)
        if self._arm is None:
            return self._finish(each, q, status, branch, beside)
        reached, status = self._arm.follow(each, q)
        return self._finish_identified(each, reached, q, status, branch, beside)

    def _recovered(
        self, T: Tensor, given: Tensor, found: Solution, near: Tensor | None, any_branch: bool
    ) -> Solution:
        """Look again for what was not found, where the identified arm reaches and the nominal one does not.

        Another branch than the wanted one will do where `any_branch` and the nominal arm has none at all.
        """
        assert self._arm is not None
        lost = (found.status == Status.UNREACHABLE).reshape(-1).nonzero()[:, 0]
        if not len(lost):
            return found
        T_lost, branch = T.reshape(-1, 4, 4)[lost], found.branch.reshape(-1)[lost]
        anywhere = torch.zeros(len(lost), dtype=torch.bool)
        if any_branch:
            closed = self._arm.solver.solve(given.detach().to("cpu").reshape(-1, 4, 4)[lost])
            anywhere = (closed.status == Status.UNREACHABLE).all(-1)
        q, status, branch = self._arm.recover(T_lost, branch, anywhere)
        beside = None if near is None else near.reshape(-1, q.shape[-1])[lost]
        nominal = torch.full_like(q, torch.nan)
        return found.with_rows(lost, self._finish_identified(T_lost, q, nominal, status, branch, beside))

    def _continued(self, T: Tensor, found: Solution, near: Tensor) -> Solution:
        """Look from `near` itself where nothing was found close to it.

        Near singular poses the nominal arm may lack the branch on which the identified one is.
        """
        assert self._arm is not None
        q_near, q_found = near.reshape(-1, near.shape[-1]), found.q.reshape(-1, near.shape[-1])
        off = (q_found - q_near).norm(dim=-1).nan_to_num(torch.inf)
        away = (off > AWAY).nonzero()[:, 0]
        T_away, start = T.reshape(-1, 4, 4)[away], q_near[away]
        q, status = search(self._arm.calibrated, T_away, start[:, None], self.model.hybrid)
        lies = self._arm.branch_of(q)
        nominal, _ = search(self.model.robot, T_away, q[:, None])
        other = self._finish_identified(T_away, q, nominal, status, lies, start)
        good = (other.status != Status.UNREACHABLE) & (other.status != Status.OUTSIDE_JOINT_LIMITS)
        kept = (good & ((other.q - start).norm(dim=-1) < off[away])).nonzero()[:, 0]
        return found.with_rows(away[kept], other.select(kept))

    def _numeric(self, T: Tensor, near: Tensor | None) -> Solution:
        """Numeric inverse from `near`, or from the training rows whose poses are nearest."""
        flat, shape = T.reshape(-1, 4, 4), T.shape[:-2]
        dof = self.model.robot.dof
        nearest = self._starts.nearest(flat, ATTEMPTS if near is None else 0)
        starts = self.model.starts[nearest] if near is None else near.reshape(-1, 1, dof)
        q, status = search(self._starts.robot, flat, starts, self.model.hybrid)
        branch = torch.zeros(shape, dtype=torch.int64)
        if self.model.calibrated is None:
            return self._finish(T, q.reshape(*shape, dof), status.reshape(shape), branch, near)
        nominal, _ = search(self.model.robot, flat, q[:, None])
        q, nominal = (values.reshape(*shape, dof) for values in (q, nominal))
        return self._finish_identified(T, q, nominal, status.reshape(shape), branch, near)

    def _finish(self, T: Tensor, q: Tensor, status: Tensor, branch: Tensor, near: Tensor | None) -> Solution:
        """Add the correction to nominal joint values, and everything that limits the trust in it."""
        robot = self.model.robot
        found = torch.isfinite(q).all(-1)
        safe = torch.where(found[..., None], q, torch.zeros_like(q))
        seen = turn_near(robot, safe, self._centre, within_limits=False)  # as the training rows were turned
        correction = torch.where(found[..., None], self.model.correction(T, seen), torch.nan)
        status = self._without_limits(safe, status)
        corrected = q + correction
        commanded, inside = self._turned(corrected, near)
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

    def _finish_identified(
        self, T: Tensor, q: Tensor, q_nominal: Tensor, status: Tensor, branch: Tensor, near: Tensor | None
    ) -> Solution:
        """Put joint values of the identified arm beside the nominal ones, on the same turns."""
        found = torch.isfinite(q).all(-1)
        status = self._without_limits(torch.where(found[..., None], q, 0.0), status)
        commanded, inside = self._turned(q, near)
        measure = torch.full(status.shape, torch.nan, dtype=torch.float64)
        if self.model.hybrid is not None:
            commanded, inside = self._on_turn(T, commanded, inside)
            share = self.model.hybrid.coverage.share(commanded)
            measure = 2 - share
            status[(status == Status.REACHED) & (share < 1)] = int(Status.OUTSIDE_DOMAIN)
        status[~inside & found] = int(Status.OUTSIDE_JOINT_LIMITS)
        q_nominal = torch.where(found[..., None], q_nominal, torch.nan)
        q_nominal = turn_near(self.model.robot, q_nominal, commanded, within_limits=False)
        correction = commanded - q_nominal
        return Solution(commanded, q_nominal, correction, branch, self.branches, status, measure)

    def _on_turn(self, T: Tensor, q: Tensor, inside: Tensor) -> tuple[Tensor, Tensor]:
        """Solve again on the turns to command where a correction is not the same on all turns."""
        hybrid = self.model.hybrid
        assert hybrid is not None
        if all(features.periodic for features in hybrid.correction.features):
            return q, inside
        flat = q.reshape(-1, 1, q.shape[-1])
        found, status = search(self._starts.robot, T.reshape(-1, 4, 4), flat, hybrid)
        settled = torch.where((status == Status.UNREACHABLE)[:, None], flat[:, 0], found).reshape(q.shape)
        turned, within = turn_into_limits(self.model.robot, settled)
        return settled, within & (turned == settled).all(-1)

    def _turned(self, q: Tensor, near: Tensor | None) -> tuple[Tensor, Tensor]:
        """Joint values on the turn to command, and whether they are inside the limits."""
        commanded, inside = turn_into_limits(self.model.robot, q)
        if near is not None:
            commanded = turn_near(self.model.robot, commanded, near, within_limits=True)
        return commanded, inside

    def _without_limits(self, q: Tensor, status: Tensor) -> Tensor:
        """A copy of the status as if there were no joint limits, which bind the corrected values only."""
        status = status.clone()
        limited = status == Status.OUTSIDE_JOINT_LIMITS
        if limited.any():
            robot = self.model.calibrated or self.model.robot
            singular = singularity_measure(robot, q[limited]) < SINGULAR_TOLERANCE
            status[limited] = torch.where(singular, int(Status.SINGULAR), int(Status.REACHED))
        return status

    def _nearest(self, every: Solution, near: Tensor) -> Tensor:
        """Index of the branch nearest to `near`: of those that reach, else of those outside limits."""
        distance = (every.q - near.unsqueeze(-2)).square().sum(-1)
        lost = every.status == Status.UNREACHABLE
        rank = (every.status == Status.OUTSIDE_JOINT_LIMITS).long() + 2 * lost.long()
        distance = torch.where(rank == rank.amin(-1, keepdim=True), distance, torch.inf)
        return torch.where(lost.all(-1), self._default, distance.argmin(-1))
