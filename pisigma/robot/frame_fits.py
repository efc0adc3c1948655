"""Fit base and tool transforms to measured poses, in closed form or by Levenberg-Marquardt."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.robot.se3 import nearest_rotation, rotation_from_vector, rotation_vector, skew, transform

LEVER_SHARE = 0.2
"""Lever arm that converts rotation errors to position errors, as a share of the robot's reach."""
_ALTERNATIONS = 10
"""Number of alternating projections onto rotations that refine the initial guess of base and tool."""
MAX_ITERATIONS = 20
AFFINE_UNKNOWNS = 13
"""Number of unknowns per coordinate of an affine base and tool, which only a larger number of positions determines."""
CONVERGENCE_TOLERANCE = 1e-6
"""Relative decrease of the cost below which the fit of base and tool has converged."""
INITIAL_DAMPING = 1e-6


@dataclass(frozen=True, eq=False)
class MeasuredPoses:
    """Measured positions and rotations, for comparison with predicted poses.

    Attributes:
        position: measured positions [m].
        rotation: measured rotations; the identity where none was measured.
        has_rotation: mask of the rows with a measured rotation.
        lever: lever arm that converts rotation errors [rad] to position errors [m].
    """

    position: Float64[Tensor, "*#batch rows 3"]
    rotation: Float64[Tensor, "*#batch rows 3 3"]
    has_rotation: Bool[Tensor, " rows"]
    lever: float

    @staticmethod
    def from_tensors(
        position: Float64[Tensor, "rows 3"] | None, rotation: Float64[Tensor, "rows 3 3"] | None, lever: float
    ) -> "MeasuredPoses":
        """Return measured poses from positions [m] and rotations, which are not finite where none was measured."""
        assert position is not None
        rows, eye = len(position), torch.eye(3, dtype=torch.float64)
        if rotation is None:
            none = torch.zeros(rows, dtype=torch.bool)
            return MeasuredPoses(position, eye.expand(rows, 3, 3), none, lever)
        has_rotation = torch.isfinite(rotation).flatten(1).all(-1)
        return MeasuredPoses(
            position, torch.where(has_rotation[:, None, None], rotation, eye), has_rotation, lever
        )

    def select(self, rows: Tensor) -> "MeasuredPoses":
        """Return the rows that a mask or an index selects."""
        return MeasuredPoses(self.position[rows], self.rotation[rows], self.has_rotation[rows], self.lever)

    @staticmethod
    def stack(several: Sequence["MeasuredPoses"]) -> "MeasuredPoses":
        """Return measured poses as a batch; all must have rotations in the same rows."""
        return replace(
            several[0],
            position=torch.stack([one.position for one in several]),
            rotation=torch.stack([one.rotation for one in several]),
        )

    def select_batches(self, index: Tensor) -> "MeasuredPoses":
        """Return the members of the batch that a mask or an index selects."""
        return replace(self, position=self.position[index], rotation=self.rotation[index])

    @property
    def value_count(self) -> int:
        """Number of independent measured values: three per position and three per rotation."""
        return 3 * len(self.position) + 3 * int(self.has_rotation.sum())

    @property
    def spread(self) -> float:
        """Root mean square distance [m] from the mean pose, as measured by `squared_errors`."""
        off = (self.position - self.position.mean(0)).square().sum(-1).mean()
        R = self.rotation[self.has_rotation]
        # Mean of |R - mean R|² / 2, because |R|² = 3.
        turn = (3 - R.mean(0).square().sum()) / 2 if len(R) else torch.zeros(())
        return float((off + self.lever**2 * turn * self.has_rotation.double().mean()).sqrt())

    def squared_errors(self, T: Float64[Tensor, "*batch rows 4 4"]) -> Float64[Tensor, "*batch rows"]:
        """Compute squared errors `|dp|² + lever² |dR|² / 2` [m²] of poses; |dR|²/2 is about the squared angle."""
        off = (self.position - T[..., :3, 3]).square().sum(-1)
        if not bool(self.has_rotation.any()):
            return off
        turn = (self.rotation - T[..., :3, :3]).square().sum((-2, -1)) / 2
        return off + self.lever**2 * torch.where(self.has_rotation, turn, 0.0)


def best_base(
    T: Float64[Tensor, "*batch rows 4 4"],
    measured: MeasuredPoses,
    weight: Float64[Tensor, "*batch rows"] | None = None,
) -> Float64[Tensor, "*batch 4 4"]:
    """Find the transform X that minimises the distance of `X T` from measured poses (orthogonal Procrustes).

    Args:
        T: predicted poses.
        measured: measured poses.
        weight: weight of every row; None for equal weights.
    """
    # The best shift makes the mean positions equal, so only the rotation remains to be found.
    middle, wanted = _mean(T[..., :3, 3], weight), _mean(measured.position, weight)
    off = measured.position - wanted
    M = (off if weight is None else weight[..., None] * off).mT @ (T[..., :3, 3] - middle)
    if bool(measured.has_rotation.any()):
        # As in `squared_errors`, every column of a rotation is treated as a point of weight lever² / 2.
        turned = _rotation_weights(measured, weight) * measured.rotation @ T[..., :3, :3].mT
        M = M + measured.lever**2 / 2 * turned.sum(-3)
    R = nearest_rotation(M)
    return transform(R, (wanted - middle @ R.mT)[..., 0, :])


def best_tool(
    T: Float64[Tensor, "*batch rows 4 4"],
    measured: MeasuredPoses,
    weight: Float64[Tensor, "*batch rows"] | None = None,
) -> Float64[Tensor, "*batch 4 4"]:
    """Find the transform X (a translation without rotations) that minimises the distance of `T X` from poses.

    The arguments are those of `best_base`.
    """
    R = T[..., :3, :3]
    # `T X` is separable: its position depends only on the tool's translation, its rotation only on the tool's rotation.
    offset = _mean((R.mT @ (measured.position - T[..., :3, 3])[..., None])[..., 0], weight)[..., 0, :]
    if not bool(measured.has_rotation.any()):
        return transform(torch.eye(3).to(T).expand(*T.shape[:-3], 3, 3), offset)
    turned = (_rotation_weights(measured, weight) * R.mT @ measured.rotation).sum(-3)
    return transform(nearest_rotation(turned), offset)


def _mean(
    values: Float64[Tensor, "*#batch rows 3"], weight: Float64[Tensor, "*#batch rows"] | None
) -> Float64[Tensor, "*#batch 1 3"]:
    """Return the weighted mean over the rows."""
    if weight is None:
        return values.mean(-2, keepdim=True)
    return (weight / weight.sum(-1, keepdim=True))[..., None, :] @ values


def _rotation_weights(
    measured: MeasuredPoses, weight: Float64[Tensor, "*batch rows"] | None
) -> Float64[Tensor, "*#batch rows 1 1"]:
    """Return the weight of every row's rotation, which is 0 where none was measured."""
    there = measured.has_rotation.to(measured.position)
    return (there if weight is None else weight * there)[..., None, None]


def affine_squared_error(
    T: Float64[Tensor, "*#batch rows 4 4"], measured: MeasuredPoses
) -> Float64[Tensor, "*#batch"]:
    """Compute the residual mean squared error [m²] per row of the best affine base and tool, a bound for rigid ones.

    Without the rotation constraint, every coordinate of `R_base (R t + p) + p_base` is linear in 13 unknowns, and
    `|R_measured - R_base R R_tool|² / 2` is at least 3 minus three times the largest singular value of the mean of
    `R_measured ⊗ R` (Shah 2013, J. Mechanisms Robotics 5(3)). With this bound, thousands of hypotheses are compared in
    closed form. Squared lengths are divided by the remaining degrees of freedom.

    Args:
        T: predicted poses.
        measured: more than 13 measured poses.
    """
    rows = T.shape[-3]
    A, solution = _affine_solution(T, measured.position)
    residual = measured.position - A @ solution
    error: Tensor = residual.square().sum((-2, -1)) / max(rows - A.shape[-1], 0.0)
    if not bool(measured.has_rotation.any()):
        return error
    K = _rotation_products(T, measured) / measured.has_rotation.sum()
    turns: Tensor = 3 * (1 - torch.linalg.matrix_norm(K, 2)).clamp(min=0.0)
    return error + measured.lever**2 * turns


def smallest_error(
    T: Float64[Tensor, "*#batch rows 4 4"], measured: MeasuredPoses
) -> Float64[Tensor, "*#batch"]:
    """Return a lower bound of the RMS error [m] with any base and tool; 0 with too few rows for one."""
    rows = T.shape[-3]
    if rows <= AFFINE_UNKNOWNS:
        return torch.zeros_like(T[..., 0, 0, 0])
    return (affine_squared_error(T, measured) * (1 - AFFINE_UNKNOWNS / rows)).sqrt()


def best_base_and_tool(
    T: Float64[Tensor, "*batch rows 4 4"], measured: MeasuredPoses
) -> tuple[Float64[Tensor, "*batch 4 4"], Float64[Tensor, "*batch 4 4"]]:
    """Find transforms X, Y that minimise the distance of `X T Y` from measured poses.

    Without measured rotations, Y is a translation.

    The initial guess is the affine fit of `affine_squared_error` with the nearest rotations as its matrices. It is
    refined by the Levenberg-Marquardt method on all batches at once.

    Args:
        T: predicted poses.
        measured: measured poses.
    """
    base, tool = _affine_base_and_tool(T, measured)
    # The closed form minimises a norm that differs from that of the errors, so a few Levenberg-Marquardt steps follow.
    damping = torch.full_like(T[..., 0, 0, 0], INITIAL_DAMPING)
    cost = measured.squared_errors(base[..., None, :, :] @ T @ tool[..., None, :, :]).sum(-1)
    for _ in range(MAX_ITERATIONS):
        step = base_and_tool_step(T, measured, base, tool, damping)
        new_base, new_tool = moved_base_and_tool(base, tool, step)
        new_cost = measured.squared_errors(new_base[..., None, :, :] @ T @ new_tool[..., None, :, :]).sum(-1)
        better = new_cost < cost
        converged = bool(((cost - new_cost).abs() <= CONVERGENCE_TOLERANCE * cost).all())
        # Every batch accepts or rejects its own step.
        base = torch.where(better[..., None, None], new_base, base)
        tool = torch.where(better[..., None, None], new_tool, tool)
        cost, damping = torch.minimum(cost, new_cost), torch.where(better, damping / 10, damping * 10)
        if converged:
            break
    return base, tool


def moved_base_and_tool(
    base: Float64[Tensor, "*batch 4 4"],
    tool: Float64[Tensor, "*batch 4 4"],
    step: Float64[Tensor, "*batch 12"],
) -> tuple[Float64[Tensor, "*batch 4 4"], Float64[Tensor, "*batch 4 4"]]:
    """Return base and tool moved by a step as returned by `base_and_tool_step`."""
    base, tool = moved_frame(torch.stack([base, tool], -3), step.reshape(*step.shape[:-1], 2, 6)).unbind(-3)
    return base, tool


def moved_frame(
    frame: Float64[Tensor, "*batch 4 4"], step: Float64[Tensor, "*batch 6"]
) -> Float64[Tensor, "*batch 4 4"]:
    """Return a frame translated by a step's first entries [m] and rotated about its origin by the others [rad]."""
    return transform(
        rotation_from_vector(step[..., 3:]) @ frame[..., :3, :3], frame[..., :3, 3] + step[..., :3]
    )


def _rotation_products(
    T: Float64[Tensor, "*#batch rows 4 4"], measured: MeasuredPoses
) -> Float64[Tensor, "*#batch 9 9"]:
    """Sum `vec(R_measured) vec(R)^T`, reordered so that it maps `vec(R_tool^T)` to `vec(R_base)`."""
    weight = measured.has_rotation.to(T)[..., None]
    M = (weight * measured.rotation.flatten(-2)).mT @ T[..., :3, :3].flatten(-2)
    batch = M.shape[:-2]
    K: Tensor = M.reshape(*batch, 3, 3, 3, 3).transpose(-3, -2).reshape(*batch, 9, 9)
    return K


def _affine_solution(
    T: Float64[Tensor, "*batch rows 4 4"], position: Float64[Tensor, "*#batch rows 3"]
) -> tuple[Float64[Tensor, "*batch rows 13"], Float64[Tensor, "*batch 13 3"]]:
    """Solve `position = A X` for the regressors `A = (vec(R), p, 1)`; return A and X."""
    A = torch.cat([T[..., :3, :3].flatten(-2), T[..., :3, 3], torch.ones_like(T[..., :1, 0])], -1)
    # Columns of equal size make the ridge below independent of units.
    size = A.square().sum(-2, keepdim=True).sqrt().clamp(min=1e-12)
    scaled = A / size
    normal = scaled.mT @ scaled + 1e-12 * torch.eye(A.shape[-1]).to(A)
    return A, torch.linalg.solve(normal, scaled.mT @ position) / size.mT


def _nearest_rotations(columns: Float64[Tensor, "*batch 9 1"]) -> Float64[Tensor, "*batch 3 3"]:
    """Return the rotations nearest to matrices that are flattened to columns."""
    return nearest_rotation(columns.reshape(*columns.shape[:-2], 3, 3))


def _affine_base_and_tool(
    T: Float64[Tensor, "*batch rows 4 4"], measured: MeasuredPoses
) -> tuple[Float64[Tensor, "*batch 4 4"], Float64[Tensor, "*batch 4 4"]]:
    """Estimate base and tool in closed form; see `affine_squared_error`."""
    R, p, position = T[..., :3, :3], T[..., :3, 3], measured.position
    R_tool = torch.eye(3).to(T).expand(*T.shape[:-3], 3, 3)
    if bool(measured.has_rotation.any()):
        K = _rotation_products(T, measured)[..., None, :, :]
        # The leading singular vectors are the rotations up to a common sign, so both signs are tried.
        leading = torch.linalg.svd(K)[2][..., 0, :]
        Z = _nearest_rotations(torch.cat([leading, -leading], -2)[..., None])
        for _ in range(_ALTERNATIONS):
            bases = _nearest_rotations(K @ Z.flatten(-2)[..., None])
            Z = _nearest_rotations(K.mT @ bases.flatten(-2)[..., None])
        agreement = (bases.flatten(-2) * (K @ Z.flatten(-2)[..., None])[..., 0]).sum(-1)
        best = agreement.argmax(-1)[..., None, None, None]
        R_base = bases.take_along_dim(best, -3)[..., 0, :, :]
        R_tool = Z.take_along_dim(best, -3)[..., 0, :, :].mT
    elif T.shape[-3] > AFFINE_UNKNOWNS:
        # In `position = R_base p + ...` the coefficients of p are those of R_base.
        R_base = nearest_rotation(_affine_solution(T, position)[1][..., 9:12, :].mT)
    else:
        R_base = best_base(T, measured)[..., :3, :3]
    eye = torch.eye(3).to(T).expand(R.shape)
    # With both rotations known, the two translations are a linear problem.
    J = torch.cat([eye, R_base[..., None, :, :] @ R], -1).flatten(-3, -2)
    wanted = (position - p @ R_base.mT).flatten(-2)[..., None]
    # Base and tool translations are not separable if all orientations are equal.
    ridge = 1e-9 * T.shape[-3] * torch.eye(6).to(T)
    shift = torch.linalg.solve(J.mT @ J + ridge, J.mT @ wanted)[..., 0]
    return transform(R_base, shift[..., :3]), transform(R_tool, shift[..., 3:])


def frame_jacobian(
    T: Float64[Tensor, "*batch rows 4 4"],
    measured: MeasuredPoses,
    base: Float64[Tensor, "*batch #rows 4 4"],
    tool: Float64[Tensor, "*batch #rows 4 4"],
) -> tuple[Float64[Tensor, "*batch rows 6 12"], Float64[Tensor, "*batch rows 6"]]:
    """Return the Jacobian of poses `base T tool` with respect to base and tool, and the errors.

    The columns are translation [m] and rotation [rad] of the base, then of the tool; the base rotates about its origin,
    in the measuring frame. The six values of a row are those of its position [m] and of its rotation vector times the
    lever [m]; the latter are 0 where no rotation was measured.
    """
    R_base, R_flange = base[..., :3, :3], base[..., :3, :3] @ T[..., :3, :3]
    arm = (R_base @ (T[..., :3, 3:] + T[..., :3, :3] @ tool[..., :3, 3:]))[..., 0]
    eye, none = torch.eye(3).to(T).expand(R_flange.shape), torch.zeros_like(R_flange)
    weight, turn = measured.lever * measured.has_rotation.to(T)[..., None], torch.zeros_like(arm)
    if bool(measured.has_rotation.any()):
        turn = rotation_vector(measured.rotation @ (R_flange @ tool[..., :3, :3]).mT)
    # The tool rotates about its origin, in the axes of the flange, which does not move the position.
    J = torch.cat([eye, -skew(arm), R_flange, none], -1)
    J = torch.cat([J, weight[..., None] * torch.cat([none, eye, none, R_flange], -1)], -2)
    return J, torch.cat([measured.position - arm - base[..., :3, 3], weight * turn], -1)


def base_and_tool_step(
    T: Float64[Tensor, "*batch rows 4 4"],
    measured: MeasuredPoses,
    base: Float64[Tensor, "*batch 4 4"],
    tool: Float64[Tensor, "*batch 4 4"],
    damping: Float64[Tensor, "*batch"],
    eliminated_direction: Float64[Tensor, "*batch rows 6"] | None = None,
) -> Float64[Tensor, "*batch 12"]:
    """Compute a damped step: translation [m] and rotation [rad] of the base, in the measuring frame, then of the tool.

    Args:
        T: predicted poses.
        measured: measured poses.
        base: current base.
        tool: current tool.
        damping: Marquardt's damping, relative to the diagonal of the normal matrix.
        eliminated_direction: translation [m] and rotation [rad] of every row's pose per unit of an unknown of that row,
            which is eliminated (variable projection, Golub and Pereyra 1973); None for no such unknown.
    """
    J, error = frame_jacobian(T, measured, base[..., None, :, :], tool[..., None, :, :])
    residual = error[..., None]
    if eliminated_direction is not None:
        weight = measured.lever * measured.has_rotation.to(T)[..., None]
        along = torch.cat([eliminated_direction[..., :3], weight * eliminated_direction[..., 3:]], -1)[
            ..., None
        ]
        # Projecting out this direction implicitly solves for the unknown of each row.
        along = along / along.norm(dim=-2, keepdim=True).clamp(min=1e-12)
        J, residual = J - along @ (along.mT @ J), residual - along @ (along.mT @ residual)
    J, residual = J.flatten(-3, -2), residual.flatten(-3, -2)
    normal = J.mT @ J
    # The constant keeps the system solvable for unknowns without effect, such as the tool's rotation without
    # orientations.
    scale = normal.diagonal(dim1=-2, dim2=-1) * damping[..., None] + 1e-12 * T.shape[-3]
    step: Tensor = torch.linalg.solve(normal + torch.diag_embed(scale), J.mT @ residual)
    return step[..., 0]
