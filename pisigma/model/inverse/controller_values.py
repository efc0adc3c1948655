"""Corrected inverse kinematics of coupled joints, whose solutions in DH values become the controller's values."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float64

from pisigma.files.errors import PoseError
from pisigma.model.inverse.joint_input import as_array, pose_array
from pisigma.model.inverse.solution import AbstractInverse, Solution
from pisigma.robot.kernels.array_kinematics import forward_kinematics, is_tensor, joint_jacobian
from pisigma.robot.kinematics import tolerances
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.task_axes import MAX_TILT, TaskAxes

if TYPE_CHECKING:  # run-time type checkers resolve the full name without this import
    import pisigma.robot.coupling

MAX_STARTS = 4
"""Largest number of stored joint values, those with the nearest poses, that are tried one after another."""
_IGNORED_WEIGHT = 1e-6
"""Weight of rotations about the tool's x and y axes for arms with fewer than six axes, which cannot control these
rotations; they only decide between joint values that meet the other axes. The tool may then be tilted by up to
`MAX_TILT`."""
Values = Float64[np.ndarray, "rows axes"]
Motion = Callable[[Values], tuple[Any, Any]]
"""Function that returns the pose `(rows, 4, 4)` and Jacobian `(rows, 6, axes)` of an arm at the controller's values."""


class ControllerValuesSolver:
    """Solver that finds DH values within wide limits and wraps the solutions into the controller's limits.

    Full turns of coupled joints change several of the controller's values. If a solution cannot be wrapped into the
    controller's limits, the other branches are tried, in their order or, with `near`, nearest first.
    """

    def __init__(
        self,
        ik: AbstractInverse,
        coupling: "pisigma.robot.coupling.Coupling",
    ) -> None:
        """Store the inverse kinematics in DH values, and the coupling between these and the controller's values."""
        self.ik, self.coupling = ik, coupling

    def with_axes(self, axes: TaskAxes) -> "ControllerValuesSolver":
        """Return a copy in which other axes of the tool are constrained.

        Raises:
            PoseError: the arm has passive joints, which are solved only in the default axes.
        """
        if self.coupling.has_passive_joints:
            raise PoseError(
                "axes other than the default ones are not supported for an arm with passive joints",
                value=axes.ignored,
                option="ignore_axes",
                remedy="omit ignore_axes and the tolerances",
            )
        return ControllerValuesSolver(self.ik.with_axes(axes), self.coupling)

    def solve(self, T: Any, near: Any, owner: Any, branch: str | None = None, **options: Any) -> Solution:
        """Find the controller's values for poses; see `CorrectedIK.__call__`.

        Args:
            T: target poses.
            near: checked values of the controller, or None.
            owner: solver that the solutions refer to as their owner.
            branch: name of the only branch that may be used, or None.
            options: other options of `CorrectedIK.__call__`.
        """
        sides = options.get("approach")
        if self.coupling.has_passive_joints:
            return self._solve_passive(T, near, owner).with_approach(sides)
        options = self._with_dh_approach(options)
        near_rows = None if near is None else self.coupling.to_dh(np.asarray(near, dtype=np.float64))
        first = self.ik(T, near=near_rows, branch=branch, **options)
        q, outside = self._inside(np.asarray(as_array(first.q)), near_rows)
        if outside.any() and branch is None:
            self._other_branches(pose_array(T)[0], q, outside, near_rows, options)
        if not np.array_equal(q, as_array(first.q), equal_nan=True):
            first = self.ik(T, near=np.nan_to_num(q), branch=branch, **options)
        return self._answer(first, owner).with_approach(sides)

    def all_branches(self, T: Any, owner: Any, **options: Any) -> Solution:
        """Find the controller's values on every branch; see `CorrectedIK.all_branches`."""
        sides = options.get("approach")
        if self.coupling.has_passive_joints:
            return self._solve_passive(T[..., None, :, :], None, owner).with_approach(
                sides, has_branch_axis=True
            )
        every = self.ik.all_branches(T, **self._with_dh_approach(options))
        q, _ = self._inside(np.asarray(as_array(every.q)), None)
        answer = self._answer(replace(every, q=every.q * 0 + _as(q, every.q)), owner)
        return answer.with_approach(sides, has_branch_axis=True)

    def forward(self, q: Any, approach: Any) -> Any:
        """Compute poses at the controller's values; see `CorrectedIK.forward`."""
        return self.ik.forward(self._to_dh(q), **self._with_dh_approach({"approach": approach}))

    def jacobian(self, q: Any) -> Any:
        """Compute the Jacobian with respect to the controller's values; see `CorrectedIK.jacobian`."""
        return self.ik.jacobian(self._to_dh(q)) @ _as(self.coupling.derivative(as_array(q)), q)

    def accuracy(self, q: Any, approach: Any = None) -> Any:
        """Predict the accuracy at the controller's values; see `CorrectedIK.accuracy`."""
        return self.ik.accuracy(self._to_dh(q), **self._with_dh_approach({"approach": approach}))

    def _with_dh_approach(self, options: dict[str, Any]) -> dict[str, Any]:
        """Return options with the directions of approach of the joints instead of the controller's axes."""
        if (sides := options.get("approach")) is None:
            return options
        return {**options, "approach": self.coupling.approach_to_dh(np.asarray(sides, dtype=np.float64))}

    def _to_dh(self, q: Any) -> Any:
        return self.coupling.to_dh(q if is_tensor(q) else np.asarray(q, dtype=np.float64))

    def _solve_passive(self, T: Any, near: Any, owner: Any) -> Solution:
        """Solve an arm with passive joints, starting at `near` or at the stored joint values with the nearest poses."""
        poses, axes = pose_array(T)[0], len(self.coupling.axes)
        rows, batch = poses.reshape(-1, 4, 4), poses.shape[:-2]
        if near is None:
            stored = self.coupling.to_controller(self.ik.model.starts.double().cpu().numpy())
            starts = nearest_starts(self._motion, rows, stored)
        else:
            starts = np.broadcast_to(near, (*batch, axes)).reshape(-1, 1, axes)
        found = solve_from(
            self._motion, rows, starts, lambda q: self.coupling.is_within_limits(self.coupling.to_dh(q))
        )
        # The nominal solution starts at the corrected solution, so that both belong to the same branch.
        nominal = solve(partial(self._motion, nominal=True), rows, found.q)
        q, q_nominal = found.mask_unreached(found.q), nominal.mask_unreached(nominal.q)
        solution = Solution(
            q.reshape(*batch, axes),
            np.where(np.isfinite(q), q_nominal, np.nan).reshape(*batch, axes),
            np.zeros(batch, dtype=int),
            self.ik.branches[:1],
            np.where(found.reached, int(Status.REACHED), int(Status.UNREACHABLE)).reshape(batch),
            found.mask_unreached(found.position_error).reshape(batch),
            found.mask_unreached(found.rotation_error).reshape(batch),
            np.full(batch, np.nan),
            owner,
        )
        # A solution outside the limits is kept only if no start leads to a solution within them.
        outside = found.reached & ~self.coupling.is_within_limits(self.coupling.to_dh(found.q))
        beyond = int(Status.OUTSIDE_JOINT_LIMITS)
        solution = replace(solution, status=np.where(outside.reshape(batch), beyond, solution.status))
        return solution.map(T.new_tensor) if is_tensor(T) else solution

    def _motion(self, q: Any, nominal: bool = False) -> tuple[Any, Any]:
        """Compute pose and Jacobian of the calibrated or the nominal arm at the controller's values."""
        dh, slope = self.coupling.to_dh(q), self.coupling.derivative(q)
        if nominal:
            robot = self.ik.model.robot
            return forward_kinematics(robot, dh), joint_jacobian(robot, dh) @ slope
        return self.ik.forward(dh), self.ik.jacobian(dh) @ slope

    def _inside(self, q: Any, near: Any) -> tuple[Any, Any]:
        """Return DH values wrapped so that the controller's values are within its limits, and a mask of failures."""
        rows = q.reshape(-1, q.shape[-1])
        near_rows = None if near is None else np.broadcast_to(near, q.shape).reshape(rows.shape)
        turned, inside = self.coupling.wrapped_within_limits(rows, near_rows)
        return turned.reshape(q.shape), (~inside & np.isfinite(rows).all(-1)).reshape(q.shape[:-1])

    def _other_branches(self, T: Any, q: Any, outside: Any, near: Any, options: dict[str, Any]) -> None:
        """Replace joint values in `q` with those of the best branch within the limits, if there is one."""
        poses = T[outside] if T.ndim > 2 else T[None]
        every, excluded = self._inside(
            np.asarray(self.ik.all_branches(poses, approach=_of_rows(options.get("approach"), outside)).q),
            None,
        )
        allowed = ~excluded & np.isfinite(every).all(-1)
        if near is None:
            # Without a previous posture, the order of the model's branches determines the choice.
            cost = np.argsort(self.ik.branch_order)[None].astype(float)
        else:
            cost = np.abs(every - np.broadcast_to(near, q.shape)[outside].reshape(-1, 1, q.shape[-1])).sum(-1)
        best = np.where(allowed, cost, np.inf).argmin(-1)
        chosen = every[np.arange(len(best)), best]
        some = allowed.any(-1)
        rows = q.reshape(-1, q.shape[-1])
        index = np.flatnonzero(outside)[some]
        rows[index] = chosen[some]
        q[...] = rows.reshape(q.shape)

    def _answer(self, solution: Solution, owner: Any) -> Solution:
        """Return a solution in the controller's values, with a status that refers to the controller's limits."""
        status = np.asarray(as_array(solution.status))
        dh = np.asarray(as_array(solution.q))
        beyond = ~self.coupling.is_within_limits(dh) & np.isfinite(dh).all(-1)
        status = np.where(beyond, int(Status.OUTSIDE_JOINT_LIMITS), status)
        plain = int(status) if np.ndim(solution.status) == 0 and not is_tensor(solution.status) else status
        return replace(
            solution,
            q=self.coupling.to_controller(solution.q),
            q_nominal=self.coupling.to_controller(solution.q_nominal),
            status=_as(plain, solution.status),
            owner=owner,
        )


def _as(values: Any, like: Any) -> Any:
    """Return values as a tensor if `like` is a tensor."""
    return like.new_tensor(values) if is_tensor(like) else values


def _of_rows(values: Any, rows: Any) -> Any:
    """Return the selected rows of values that have one entry per row."""
    return values[rows] if values is not None and np.ndim(values) > 1 else values


@dataclass(frozen=True, eq=False)
class ReachedPoses:
    """Result of the iteration towards poses.

    Attributes:
        q: the controller's values [rad or m].
        reached: whether the pose is reached in all axes that the arm can control.
        position_error: distance from the target position [m].
        rotation_error: angle to the target orientation [rad], which arms with fewer than six axes control only
            partially.
    """

    q: Values
    reached: Bool[np.ndarray, " rows"]
    position_error: Float64[np.ndarray, " rows"]
    rotation_error: Float64[np.ndarray, " rows"]

    def mask_unreached(self, values: np.ndarray) -> np.ndarray:
        """Return values with NaN for poses that are not reached."""
        return np.where(self.reached if values.ndim == 1 else self.reached[:, None], values, np.nan)


def solve(motion: Motion, T: Float64[np.ndarray, "rows 4 4"], start: Values) -> ReachedPoses:
    """Find the controller's values that reach poses, by damped least squares from initial values.

    Args:
        motion: function that returns pose and Jacobian of the arm.
        T: target poses T_base_tool [m].
        start: initial values of the controller [rad or m].
    """
    q = start.copy()
    weight = np.ones(6)
    # Fewer than six axes cannot control the tilt; a small weight prevents the arm from tilting freely.
    weight[3:5] = 1.0 if q.shape[1] >= 6 else _IGNORED_WEIGHT
    error, J = _errors(motion, T, q)
    for _ in range(tolerances.MAX_ITERATIONS):
        A, b = J * weight[:, None], error * weight
        normal = A.mT @ A
        # Damping vanishes with the error, so convergence is quadratic near the solution.
        # The constant keeps the normal matrix regular for redundant axes and at a singularity.
        damping = 1e-3 * (b * b).sum(-1) + 1e-15
        normal += damping[:, None, None] * np.eye(q.shape[1])
        step = np.linalg.solve(normal, (A.mT @ b[..., None]))[..., 0]
        # Long steps leave the region in which the linearisation is valid.
        q = q + np.clip(step, -0.5, 0.5)
        error, J = _errors(motion, T, q)
        if np.abs(step).max(initial=0.0) < 1e-13:
            break
    reached = np.abs(error * (weight == 1.0)).max(-1) < tolerances.ACCEPTED
    reached &= np.abs(error[:, 3:5]).max(-1) <= MAX_TILT
    return ReachedPoses(
        q, reached, np.linalg.norm(error[:, :3], axis=-1), np.linalg.norm(error[:, 3:], axis=-1)
    )


def solve_from(
    motion: Motion,
    T: Float64[np.ndarray, "rows 4 4"],
    starts: Float64[np.ndarray, "rows tried axes"],
    is_inside: Callable[[Values], Bool[np.ndarray, " rows"]],
) -> ReachedPoses:
    """Solve every pose from the first start that reaches it within the limits, or else from any that reaches it."""
    result = solve(motion, T, starts[:, 0])
    for tried in starts[:, 1:].swapaxes(0, 1):
        left = ~(result.reached & is_inside(result.q))
        if left.any():
            again, q = solve(motion, T[left], tried[left]), result.q.copy()
            better = again.reached & (is_inside(again.q) | ~result.reached[left])
            q[left] = np.where(better[:, None], again.q, q[left])
            result = solve(motion, T, q)
    return result


def nearest_starts(
    motion: Motion, T: Float64[np.ndarray, "rows 4 4"], starts: Float64[np.ndarray, "starts axes"]
) -> Float64[np.ndarray, "rows tried axes"]:
    """Return the stored values with the poses nearest to every pose, nearest first."""
    position = motion(starts)[0][:, :3, 3]
    off = np.linalg.norm(T[:, None, :3, 3] - position, axis=-1)
    return starts[np.argsort(off, axis=1)[:, :MAX_STARTS]]


def _errors(motion: Motion, T: Any, q: Values) -> tuple[Any, Any]:
    """Compute the position error [m] and rotation vector [rad] in the tool's axes, and their Jacobian."""
    here, J = motion(q)
    R = here[:, :3, :3]
    shift = (R.mT @ (T[:, :3, 3] - here[:, :3, 3])[..., None])[..., 0]
    return np.concatenate([shift, _rotation_vector(R.mT @ T[:, :3, :3])], -1), np.concatenate(
        [R.mT @ J[:, :3], R.mT @ J[:, 3:]], 1
    )


def _rotation_vector(R: Any) -> Any:
    """Compute rotation vectors [rad]; near an angle of pi only their length is accurate."""
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], -1) / 2
    sine, cosine = np.linalg.norm(axis, axis=-1), (np.trace(R, axis1=1, axis2=2) - 1) / 2
    angle = np.arctan2(sine, cosine)
    return axis * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0)[:, None]
