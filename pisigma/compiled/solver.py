"""Corrected inverse kinematics for control loops: NumPy in, NumPy out, a few microseconds a pose."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from pisigma.compiled.arrays import BLENDED, GEOMETRIC, Description
from pisigma.compiled.description_file import read_description
from pisigma.compiled.kernels import (
    LAST_ROW,
    LEFT_HANDED,
    NOT_FINITE,
    NOT_ORTHONORMAL,
    evaluate,
    solve_poses,
)
from pisigma.compiled.layout import make_memory, pack
from pisigma.errors import PoseError, nearest_choice
from pisigma.kinematics.status import Status

CHUNK = 2_048
"""Poses that a thread takes at a time."""

_WRONG = {
    NOT_FINITE: "has entries that are not finite numbers; give 16 finite numbers",
    LAST_ROW: "does not end with the row 0 0 0 1; give a homogeneous transform",
    NOT_ORTHONORMAL: "has a rotation part that is not orthonormal; normalise it or check its source",
    LEFT_HANDED: "has a left-handed rotation part (determinant -1); a reflection is no pose, check its axes",
}


class CompiledSolution(NamedTuple):
    """What the robot has to be commanded to reach one pose, or poses; see `correction.solution.Solution`.

    Attributes:
        q: `(*batch, dof)`: corrected joint values [rad or m], NaN where, and only where, the status is UNREACHABLE.
        q_nominal: the same of the nominal robot, on the same turns; NaN too where it does not reach the pose.
        branch: index into `branches`: an int, or `(poses,)`.
        branches: names of the branches.
        status: a `Status` as a number: an int, or `(poses,)`.
        position_residual: distance of the tool from the wanted position [m], as far as the model knows.
        rotation_residual: angle of the tool to the wanted orientation [rad].
        share: of the learned correction that is in force: 1 where every joint value was measured, 0 where only the
            geometric calibration holds; NaN where there is no learned correction or no solution.
    """

    q: Any
    q_nominal: Any
    branch: Any
    branches: tuple[str, ...]
    status: Any
    position_residual: Any
    rotation_residual: Any
    share: Any

    @property
    def correction(self) -> Any:
        """`q - q_nominal` [rad or m]."""
        return self.q - self.q_nominal

    @property
    def domain_measure(self) -> Any:
        """1 where every joint value was measured, up to 2 where only the geometric calibration holds."""
        return 2 - self.share

    @property
    def sentences(self) -> tuple[str, ...]:
        """What every status means and what to do about it."""
        return tuple(Status(status).sentence for status in np.atleast_1d(self.status).tolist())


class CompiledIK:
    """The corrected inverse kinematics of one arm, compiled.

    Attributes:
        description: the arm as arrays.
        name: of the model.
        branches: names of the branches.
        joints: names of the joints.
    """

    def __init__(
        self, description: Description, branches: Sequence[str], joints: Sequence[str], name: str = "model"
    ) -> None:
        """Take a description such as `correction.compiled_model.describe` makes.

        Raises:
            ModelError: the arm is larger than the compiled kernels allow.
        """
        self.description = description
        self._packed = pack(description, name)
        self.branches = tuple(branches)
        self.joints = tuple(joints)
        self.name = name
        self._none = np.zeros((1, len(self.joints)))

    @staticmethod
    def load(file: str | os.PathLike[str]) -> "CompiledIK":
        """Read a file that `save` wrote.

        Raises:
            ModelError: the file is missing, truncated, foreign, changed or of another format.
        """
        description, names = read_description(file)
        return CompiledIK(description, **names)

    def solve(self, T_base_tool: Any, near: Any = None, branch: str | None = None) -> CompiledSolution:
        """Find corrected joint values for one pose.

        Args:
            T_base_tool: `(4, 4)`: wanted pose of the tool in the base frame [m].
            near: `(dof,)` joint values [rad or m] such as the present ones: of the branches that reach the pose the
                nearest is taken, on the nearest turns within the limits.
            branch: name of the branch to take; with neither it is the one that most training rows lie on.

        Raises:
            PoseError: the matrix is no pose, `near` does not fit, or there is no such branch.
        """
        T = self._numbers(T_base_tool, "T_base_tool")
        if T.shape != (4, 4):
            raise PoseError(
                f"T_base_tool has the shape {T.shape}; give one homogeneous transform of shape (4, 4)."
            )
        beside = self._none if near is None else self._near(near, ())
        dof = len(self.joints)
        found = np.empty((1, 2 * dof + 5))
        wrong = solve_poses(
            self._packed,
            make_memory(),
            T.reshape(1, 4, 4),
            beside,
            near is not None,
            self._branch(branch),
            found,
            0,
            1,
        )
        if wrong >= 0:
            raise PoseError(f"T_base_tool {_WRONG[wrong % 8]}.")
        position, rotation, share, status, lies = found[0, 2 * dof :].tolist()
        q, nominal = found[0, :dof], found[0, dof : 2 * dof]
        return CompiledSolution(q, nominal, int(lies), self.branches, int(status), position, rotation, share)

    def solve_batch(
        self, T_base_tool: Any, near: Any = None, branch: str | None = None, threads: int | None = None
    ) -> CompiledSolution:
        """Find corrected joint values for poses `(poses, 4, 4)`, several threads at a time.

        Args:
            T_base_tool: `(poses, 4, 4)`: wanted poses [m].
            near: `(poses, dof)` or `(dof,)`: see `solve`.
            branch: see `solve`.
            threads: how many; None for one per processor that this process may use.

        Raises:
            PoseError: a matrix is no pose (the message gives its index), or see `solve`.
        """
        T = self._numbers(T_base_tool, "T_base_tool")
        if T.ndim != 3 or T.shape[1:] != (4, 4):
            raise PoseError(
                f"T_base_tool has the shape {T.shape}; give homogeneous transforms of shape (poses, 4, 4)."
            )
        if threads is not None and threads < 1:
            raise PoseError(f"threads={threads}: at least one is needed; give None for one per processor.")
        beside = self._none if near is None else self._near(near, (len(T),))
        dof, index = len(self.joints), self._branch(branch)
        found = np.empty((len(T), 2 * dof + 5))

        def solve_chunk(start: int) -> int:
            stop = min(start + CHUNK, len(T))
            return solve_poses(
                self._packed, make_memory(), T, beside, near is not None, index, found, start, stop
            )

        starts = range(0, len(T), CHUNK)
        workers = min(threads or len(os.sched_getaffinity(0)), len(starts))
        if workers > 1:
            with ThreadPoolExecutor(workers) as pool:
                results = list(pool.map(solve_chunk, starts))
        else:
            results = [solve_chunk(start) for start in starts]
        wrong = next((result for result in results if result >= 0), -1)
        if wrong >= 0:
            raise PoseError(f"T_base_tool at index {wrong // 8} {_WRONG[wrong % 8]}.")
        position, rotation, share, status, lies = found[:, 2 * dof :].T
        q, nominal = found[:, :dof], found[:, dof : 2 * dof]
        return CompiledSolution(
            q, nominal, lies.astype(int), self.branches, status.astype(int), position, rotation, share
        )

    def forward(self, q: Any, arm: int | None = None) -> tuple[Any, Any, Any, Any]:
        """Where the calibrated arm goes.

        Args:
            q: `(poses, dof)` commanded joint values [rad or m].
            arm: another of the arms in `compiled.arrays`.

        Returns:
            T_base_tool `(poses, 4, 4)` [m], Jacobian `(poses, 6, dof)` without the slope of the correction, the
            correction `(poses, dof)` [rad or m], and how much of it is in force `(poses,)`.
        """
        rows = np.ascontiguousarray(self._near(q, (len(q),)))
        T, J = np.zeros((len(rows), 4, 4)), np.zeros((len(rows), 6, len(self.joints)))
        delta, share = np.zeros(rows.shape), np.zeros(len(rows))
        default = BLENDED if self.description.arms.hybrid else GEOMETRIC
        evaluate(self._packed, make_memory(), default if arm is None else arm, rows, T, J, delta, share)
        return T, J, delta, share

    def _branch(self, name: str | None) -> int:
        if name is None:
            return -1
        if name not in self.branches:
            raise PoseError(f"there is no branch '{name}'; {nearest_choice(name, self.branches)}")
        return self.branches.index(name)

    def _numbers(self, values: Any, what: str) -> Any:
        """The values as a contiguous float64 array, itself where it is one."""
        try:
            return np.ascontiguousarray(values, dtype=np.float64)
        except (TypeError, ValueError):
            raise PoseError(f"{what} is no array of numbers; give real numbers, lengths in metres.") from None

    def _near(self, near: Any, batch: tuple[int, ...]) -> Any:
        """Joint values as `(1 or poses, dof)`."""
        values, dof = self._numbers(near, "near"), len(self.joints)
        if values.shape != (dof,) and values.shape != (*batch, dof):
            raise PoseError(
                f"near has the shape {values.shape}; give {dof} joint values ({', '.join(self.joints)}), once or for "
                "every pose."
            )
        if not np.isfinite(values).all():
            raise PoseError(
                "near holds joint values that are no finite numbers; give a number for every joint."
            )
        return values.reshape(-1, dof)
