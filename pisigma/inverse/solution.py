"""What corrected inverse kinematics gives back."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from pisigma.kinematics.status import Status
from pisigma.model.accuracy import position_accuracy
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.se3 import pose_error


@dataclass(frozen=True, eq=False)
class Solution:
    """What the robot has to be commanded to reach poses, and how far that can be trusted.

    Attributes:
        q: corrected joint values [rad or m], NaN where, and only where, the status is `UNREACHABLE`.
        q_nominal: joint values of the nominal robot, on the same turn; NaN too where an identified geometry
            reaches the pose and the nominal one, on the same base and with the same tool, does not.
        correction: `q - q_nominal`.
        branch: index into `branches`.
        branches: names of the branches.
        status: a `Status` per pose; the gravest finding counts, in the order unreachable, outside joint
            limits, singular, outside domain, reached. Limits are those of the corrected values, which are
            commanded.
        domain_measure: distance to the training rows over their spacing; above 1 the correction is
            extrapolated, whatever the status says. For a hybrid 1 where all joint values were measured, rising
            to 2 where only the geometric calibration holds. NaN where there is no network or no solution.
        wanted: the poses T_base_tool that were asked for, float64 on the CPU.
        model: whose solution it is. Residuals and accuracy are computed when they are first read, in float64 on
            the CPU.
    """

    q: Float[Tensor, "*batch dof"]
    q_nominal: Float[Tensor, "*batch dof"]
    correction: Float[Tensor, "*batch dof"]
    branch: Int64[Tensor, "*batch"]
    branches: tuple[str, ...]
    status: Int64[Tensor, "*batch"]
    domain_measure: Float[Tensor, "*batch"]
    wanted: Float64[Tensor, "*batch 4 4"] | None = None
    model: CalibratedModel | None = None

    @property
    def position_residual(self) -> Float64[Tensor, "*batch"]:
        """Distance of the tool from the wanted position [m], as far as the model knows; NaN without solution."""
        length: Tensor = torch.linalg.vector_norm(self._residual[..., :3], dim=-1)
        return length

    @property
    def rotation_residual(self) -> Float64[Tensor, "*batch"]:
        """Angle of the tool to the wanted orientation [rad], as far as the model knows; NaN without solution."""
        angle: Tensor = torch.linalg.vector_norm(self._residual[..., 3:], dim=-1)
        return angle

    @cached_property
    def accuracy(self) -> Float64[Tensor, "*batch"]:
        """Predicted standard deviation of the tool's position [m]; NaN where the model does not know it."""
        if self.model is None:
            return torch.full(self.status.shape, torch.nan, dtype=torch.float64)
        return position_accuracy(self.model, self.q)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What every status means and what to do about it, all batch axes in a row."""
        return tuple(Status(status).sentence for status in self.status.flatten().tolist())

    @cached_property
    def _residual(self) -> Float64[Tensor, "*batch 6"]:
        """Translation [m] and rotation vector [rad] from where the tool goes to where it was to go."""
        found = torch.full((self.status.numel(), 6), torch.nan, dtype=torch.float64)
        q = self.q.detach().to("cpu", torch.float64).reshape(len(found), self.q.shape[-1])
        rows = torch.isfinite(q).all(-1).nonzero()[:, 0]
        if self.model is not None and self.wanted is not None and len(rows):
            T = self.model.forward(q[rows])
            error = pose_error(self.wanted.reshape(-1, 4, 4)[rows], torch.nan_to_num(T))
            found[rows] = torch.where(torch.isfinite(T).flatten(1).all(-1)[:, None], error, torch.nan)
        return found.reshape(*self.status.shape, 6)

    def select(self, index: int | Tensor | slice) -> "Solution":
        """The solutions at an index of the first batch axis."""
        return self._map(lambda values: values[index], lambda values: values[index])

    def on_branch(self, index: Int64[Tensor, "*batch"]) -> "Solution":
        """Of solutions whose last batch axis is the branch, one per pose."""

        def vector(values: Tensor) -> Tensor:
            place = index[..., None, None].expand(*index.shape, 1, values.shape[-1])
            return values.gather(-2, place)[..., 0, :]

        return self._map(vector, lambda values: values.gather(-1, index[..., None])[..., 0])

    def reshaped(self, batch: Sequence[int]) -> "Solution":
        """The same with other batch axes."""
        return self._map(
            lambda values: values.reshape((*batch, values.shape[-1])),
            lambda values: values.reshape(tuple(batch)),
        )

    def with_branch_axis(self) -> "Solution":
        """The same with a last batch axis of one branch."""
        return self._map(lambda values: values.unsqueeze(-2), lambda values: values.unsqueeze(-1))

    def with_rows(self, index: Int64[Tensor, " _rows"], rows: "Solution") -> "Solution":
        """The same with other solutions at an index that counts through all batch axes."""
        batch = self.status.ndim

        def put(values: Tensor, others: Tensor) -> Tensor:
            flat = values.reshape(-1, *values.shape[batch:])
            return flat.index_copy(0, index, others).reshape(values.shape)

        return replace(
            self,
            q=put(self.q, rows.q),
            q_nominal=put(self.q_nominal, rows.q_nominal),
            correction=put(self.correction, rows.correction),
            branch=put(self.branch, rows.branch),
            status=put(self.status, rows.status),
            domain_measure=put(self.domain_measure, rows.domain_measure),
        )

    def like(self, poses: Tensor) -> "Solution":
        """The same in the dtype and on the device of the poses."""
        other = self._map(
            lambda values: values.to(poses),
            lambda values: values.to(poses) if values.is_floating_point() else values.to(poses.device),
        )
        return replace(other, wanted=self.wanted)

    def _map(self, vector: Callable[[Tensor], Tensor], single: Callable[[Tensor], Tensor]) -> "Solution":
        """Apply one function to what has an axis of joints and another to what has none."""
        return Solution(
            q=vector(self.q),
            q_nominal=vector(self.q_nominal),
            correction=vector(self.correction),
            branch=single(self.branch),
            branches=self.branches,
            status=single(self.status),
            domain_measure=single(self.domain_measure),
            wanted=None if self.wanted is None else _as_matrices(vector(self.wanted.flatten(-2))),
            model=self.model,
        )


def _as_matrices(values: Float64[Tensor, "*batch 16"]) -> Float64[Tensor, "*batch 4 4"]:
    return values.reshape(*values.shape[:-1], 4, 4)
