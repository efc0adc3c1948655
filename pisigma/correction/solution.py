"""What corrected inverse kinematics gives back."""

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float, Int64
from torch import Tensor


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
            extrapolated, whatever the status says. NaN where there is no network or no solution.
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
        return self._map(lambda values: values[index], lambda values: values[index])

    def on_branch(self, index: Int64[Tensor, "*batch"]) -> "Solution":
        """Of solutions whose last batch axis is the branch, one per pose."""

        def vector(values: Tensor) -> Tensor:
            place = index[..., None, None].expand(*index.shape, 1, values.shape[-1])
            return values.gather(-2, place)[..., 0, :]

        return self._map(vector, lambda values: values.gather(-1, index[..., None])[..., 0])

    def with_branch_axis(self) -> "Solution":
        """The same with a last batch axis of one branch."""
        return self._map(lambda values: values.unsqueeze(-2), lambda values: values.unsqueeze(-1))

    def with_rows(self, index: Int64[Tensor, " _rows"], rows: "Solution") -> "Solution":
        """The same with other solutions at an index that counts through all batch axes."""
        batch = self.status.ndim

        def put(values: Tensor, others: Tensor) -> Tensor:
            flat = values.reshape(-1, *values.shape[batch:])
            return flat.index_copy(0, index, others).reshape(values.shape)

        return Solution(
            q=put(self.q, rows.q),
            q_nominal=put(self.q_nominal, rows.q_nominal),
            correction=put(self.correction, rows.correction),
            branch=put(self.branch, rows.branch),
            branches=self.branches,
            status=put(self.status, rows.status),
            domain_measure=put(self.domain_measure, rows.domain_measure),
        )

    def like(self, poses: Tensor) -> "Solution":
        """The same in the dtype and on the device of the poses."""
        return self._map(
            lambda values: values.to(poses),
            lambda values: values.to(poses) if values.is_floating_point() else values.to(poses.device),
        )

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
        )
