"""Corrected inverse kinematics for control loops: NumPy in, NumPy out, a few microseconds a pose."""

import os
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from pisigma.errors import PoseError, nearest_choice
from pisigma.kernels.arrays import (
    ANY_BRANCH,
    BLENDED,
    EVALUATE,
    EVERY_BRANCH,
    GEOMETRIC,
    LAST_ROW,
    LEFT_HANDED,
    NEAR_NOT_FINITE,
    NOT_FINITE,
    NOT_ORTHONORMAL,
    SOLVE,
    Description,
)
from pisigma.kernels.description_file import read_description
from pisigma.kernels.layout import make_memory, pack
from pisigma.kernels.machine_code import kernel_features, load_kernels
from pisigma.kernels.solution import CompiledSolution, solution_of_row, solution_of_rows, width

CHUNK = 2_048
"""Poses that a thread takes at a time."""

_WRONG = {
    NOT_FINITE: "T_base_tool{} has entries that are not finite numbers; give 16 finite numbers.",
    LAST_ROW: "T_base_tool{} does not end with the row 0 0 0 1; give a homogeneous transform.",
    NOT_ORTHONORMAL: (
        "T_base_tool{} has a rotation part that is not orthonormal; normalise it or check its source."
    ),
    LEFT_HANDED: (
        "T_base_tool{} has a left-handed rotation part (determinant -1); a reflection is no pose, check its axes."
    ),
    NEAR_NOT_FINITE: ("near{} holds joint values that are no finite numbers; give a number for every joint."),
}

_PATIENCE = 2.0
"""[s] Kernels that are on disk are loaded in far less."""
_COMPILING = (
    "pisigma: compiling the inverse kinematics for this machine, once; that takes a minute or two ...\n"
)


def _kernels(features: tuple[str, ...]) -> Callable[..., int]:
    """The kernels; where they have to be compiled first, somebody at a terminal is told why it takes so long."""
    told = threading.Timer(_PATIENCE, sys.stderr.write, (_COMPILING,))
    told.daemon = True
    if sys.stderr.isatty():
        told.start()
    try:
        return load_kernels(features)
    finally:
        told.cancel()


class CompiledIK:
    """The corrected inverse kinematics of one arm, compiled. It may be called from several threads at a time.

    Attributes:
        description: the arm as arrays.
        name: of the model.
        branches: names of the branches.
        joints: names of the joints.
        belongs_to: SHA-256 of the model folder that says the same; "" where that is not known.
    """

    def __init__(
        self,
        description: Description,
        branches: Sequence[str],
        joints: Sequence[str],
        name: str = "model",
        belongs_to: str = "",
    ) -> None:
        """Take a description such as `correction.compiled_model.describe` makes.

        Raises:
            ModelError: the arm is larger than the compiled kernels allow.
        """
        self.description = description
        self._packed = pack(description, name, kernel_features(description.features))
        self._address = _address(self._packed)
        self.branches = tuple(branches)
        self.joints = tuple(joints)
        self.name = name
        self.belongs_to = belongs_to
        self._none = np.zeros((0, len(self.joints)))
        self._kernels = _kernels(description.features)
        self._threads = threading.local()

    @staticmethod
    def load(file: str | os.PathLike[str]) -> "CompiledIK":
        """Read a file that `correction.compiled_model.save_compiled` wrote.

        Raises:
            ModelError: the file is missing, truncated, foreign, changed or of another format.
        """
        description, names = read_description(file)
        return CompiledIK(description, **names)

    def solve(
        self, T_base_tool: Any, near: Any = None, branch: str | None = None, throw: bool = True
    ) -> CompiledSolution:
        """Find corrected joint values for one pose.

        Args:
            T_base_tool: `(4, 4)`: wanted pose of the tool in the base frame [m].
            near: `(dof,)` joint values [rad or m] such as the present ones: of the branches that reach the pose the
                nearest is taken, on the nearest turns within the limits.
            branch: name of the branch to take. With neither, branches are tried in the order of how many training
                rows lie on them, then the others; the first that reaches the pose inside the joint limits is taken,
                else the first that reaches it.
            throw: whether a matrix that is no pose, and joint values `near` that are not finite, raise; else the
                status is INVALID_POSE.

        Raises:
            PoseError: the matrix is no pose, a shape does not fit, or there is no such branch.
        """
        T = self._numbers(T_base_tool, "T_base_tool", throw)
        if T.shape != (4, 4):
            raise PoseError(
                f"T_base_tool has the shape {T.shape}; give one homogeneous transform of shape (4, 4)."
            )
        beside = self._none if near is None else self._near(near, (), throw)
        found = np.empty((1, 1, width(len(self.joints))))
        wrong = self._run(SOLVE, T, 0, 1, beside, self._branch(branch), not throw, found)
        if wrong >= 0:
            raise PoseError(_WRONG[wrong % 8].format(""))
        return solution_of_row(found[0, 0], len(self.joints), self.branches)

    def solve_batch(
        self,
        T_base_tool: Any,
        near: Any = None,
        branch: str | None = None,
        threads: int | None = None,
        throw: bool = True,
    ) -> CompiledSolution:
        """Find corrected joint values for poses `(poses, 4, 4)`, several threads at a time.

        Args:
            T_base_tool: `(poses, 4, 4)`: wanted poses [m].
            near: `(poses, dof)` or `(dof,)`: see `solve`.
            branch: see `solve`.
            threads: how many; None for one per processor that this process may use.
            throw: see `solve`; with False bad rows get the status INVALID_POSE and the others are solved.

        Raises:
            PoseError: a matrix is no pose (the message gives its index), or see `solve`.
        """
        T = self._poses(T_base_tool, throw)
        beside = self._none if near is None else self._near(near, (len(T),), throw)
        found = self._solve_rows(T, beside, self._branch(branch), 1, threads, throw)
        return solution_of_rows(found[:, 0], len(self.joints), self.branches)

    def all_branches(
        self, T_base_tool: Any, threads: int | None = None, throw: bool = True
    ) -> CompiledSolution:
        """Solutions `(poses, branches)` of poses `(poses, 4, 4)` on every branch; for the rest see `solve_batch`."""
        T = self._poses(T_base_tool, throw)
        found = self._solve_rows(T, self._none, EVERY_BRANCH, len(self.branches), threads, throw)
        return solution_of_rows(found, len(self.joints), self.branches)

    def _solve_rows(
        self, T: Any, near: Any, branch: int, count: int, threads: int | None, throw: bool
    ) -> Any:
        """What the kernels find, `(poses, count, width)`."""
        if threads is not None and threads < 1:
            raise PoseError(f"threads={threads}: at least one is needed; give None for one per processor.")
        found = np.empty((len(T), count, width(len(self.joints))))

        def solve_chunk(start: int) -> int:
            stop = min(start + CHUNK, len(T))
            return self._run(SOLVE, T, start, stop, near, branch, not throw, found)

        starts = range(0, len(T), CHUNK)
        workers = min(threads or len(os.sched_getaffinity(0)), len(starts))
        if workers > 1:
            with ThreadPoolExecutor(workers) as pool:
                results = list(pool.map(solve_chunk, starts))
        else:
            results = [solve_chunk(start) for start in starts]
        wrong = next((result for result in results if result >= 0), -1)
        if wrong >= 0:
            raise PoseError(_WRONG[wrong % 8].format(f" at index {wrong // 8}"))
        return found

    def _run(
        self, task: int, T: Any, start: int, stop: int, near: Any, branch: int, mark: bool, found: Any
    ) -> int:
        """Have the kernels work on the rows from `start` to `stop`; what they say, with the row of the whole."""
        beside, rows = _address(near), len(near)
        if rows > 1:
            beside, rows = beside + start * near.strides[0], stop - start
        said = self._kernels(
            self._address,
            self._memory(),
            task,
            stop - start,
            _address(T) + start * 128,
            beside,
            rows,
            beside,
            0,
            branch,
            mark,
            0,
            _address(found) + start * found.strides[0],
            found.shape[1],
        )
        return int(said) if said < 0 else int(said) + 8 * start

    def _memory(self) -> int:
        """Address of memory to work in that no other thread uses."""
        found: int | None = getattr(self._threads, "address", None)
        if found is None:
            self._threads.memory = make_memory()
            found = self._threads.address = _address(self._threads.memory)
        return found

    def forward(self, q: Any, arm: int | None = None) -> tuple[Any, Any, Any, Any]:
        """Where the calibrated arm goes.

        Args:
            q: `(poses, dof)` commanded joint values [rad or m].
            arm: another of the arms in `compiled.arrays`.

        Returns:
            T_base_tool `(poses, 4, 4)` [m], Jacobian `(poses, 6, dof)` without the slope of the correction, the
            correction `(poses, dof)` [rad or m], and how much of it is in force `(poses,)`.
        """
        rows, dof = self._near(q, (len(q),), True), len(self.joints)
        T, found = np.empty((len(rows), 4, 4)), np.empty((len(rows), 7 * dof + 1))
        default = BLENDED if self.description.arms.hybrid else GEOMETRIC
        self._run(EVALUATE, T, 0, len(rows), rows, default if arm is None else arm, False, found)
        J = found[:, : 6 * dof].reshape(-1, 6, dof)
        return T, J, found[:, 6 * dof : 7 * dof], found[:, 7 * dof]

    def _branch(self, name: str | None) -> int:
        if name is None:
            return ANY_BRANCH
        if name not in self.branches:
            raise PoseError(f"there is no branch '{name}'; {nearest_choice(name, self.branches)}")
        return self.branches.index(name)

    def _poses(self, T_base_tool: Any, throw: bool) -> Any:
        T = self._numbers(T_base_tool, "T_base_tool", throw)
        if T.ndim != 3 or T.shape[1:] != (4, 4):
            raise PoseError(
                f"T_base_tool has the shape {T.shape}; give homogeneous transforms of shape (poses, 4, 4)."
            )
        return T

    def _numbers(self, values: Any, what: str, throw: bool) -> Any:
        """The values as a contiguous float64 array, itself where it is one; NaN for what is none, or a complaint."""
        try:
            return np.ascontiguousarray(values, dtype=np.float64)
        except (TypeError, ValueError):
            shape = None if throw else _shape(values)
            if shape is None:
                raise PoseError(
                    f"{what} is no array of numbers; give real numbers, lengths in metres."
                ) from None
            return np.full(shape, np.nan)

    def _near(self, near: Any, batch: tuple[int, ...], throw: bool) -> Any:
        """Joint values as `(1 or poses, dof)`."""
        values, dof = self._numbers(near, "near", throw), len(self.joints)
        if values.shape != (dof,) and values.shape != (*batch, dof):
            raise PoseError(
                f"near has the shape {values.shape}; give {dof} joint values ({', '.join(self.joints)}), once or for "
                "every pose."
            )
        return values.reshape(-1, dof)


def _address(array: Any) -> int:
    """Where the numbers of a contiguous array lie in memory."""
    return array.__array_interface__["data"][0]  # type: ignore[no-any-return]


def _shape(values: Any) -> tuple[int, ...] | None:
    """Shape of nested values, None where they are ragged."""
    try:
        return tuple(np.shape(values))
    except ValueError:
        return None
