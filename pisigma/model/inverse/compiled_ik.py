"""Compiled corrected inverse kinematics for control loops, which takes microseconds per pose of a NumPy array."""

import ctypes
import os
import threading
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pisigma.files.errors import PoseError, check_choice
from pisigma.model.inverse.joint_input import as_float_array, fault_error, joint_rows
from pisigma.model.inverse.solution import AbstractInverse, Solution
from pisigma.robot.kernels import arrays
from pisigma.robot.kernels.array_kinematics import address_of
from pisigma.robot.kernels.description_file import read_description
from pisigma.robot.kernels.layout import make_memory, pack
from pisigma.robot.kernels.machine_code import IGNORED, Said, kernel_forms, load_kernels
from pisigma.robot.kinematics.task_axes import WHOLE, TaskAxes, default_axes

if TYPE_CHECKING:  # run-time type checkers resolve the full name without this import
    import pisigma.model.calibrated_model

CHUNK = 2_048
"""Number of poses that a thread solves at a time."""
MAX_SOLUTIONS = 8
"""Largest number of distinct solutions of a pose that are returned for arms without a closed-form inverse."""


class CompiledIK:
    """Compiled corrected inverse kinematics of one arm, which may be called from several threads at a time.

    Attributes:
        description: the arm as arrays.
        name: name of the model.
        branches: names of the branches.
        joints: names of the joints.
        belongs_to: SHA-256 of the folder of the same model; "" if there is none.
        warnings: see `CorrectedIK`.
        task_axes: axes of the tool that are constrained unless a task states others.
    """

    def __init__(
        self,
        description: arrays.Description,
        branches: Sequence[str],
        joints: Sequence[str],
        name: str = "model",
        belongs_to: str = "",
        warnings: Sequence[str] = (),
    ) -> None:
        """Make the inverse kinematics of a description from `model.compiled_model.describe_as_arrays`.

        Raises:
            ModelError: the arm is larger than the compiled kernels allow, or there are no kernels for this machine.
        """
        self.description = description
        self._packed = pack(description, name, kernel_forms(description.forms))
        self._address = address_of(self._packed)
        self.branches, self.joints = tuple(branches), tuple(joints)
        self.name, self.belongs_to, self.warnings = name, belongs_to, tuple(warnings)
        self._none = np.zeros((0, len(self.joints)))
        self._row = ctypes.c_double * (2 * len(self.joints) + 5)
        whole = description.network.used and not description.forms.closed_forms
        self.task_axes = WHOLE if whole else default_axes(len(self.joints))
        self._kernels = load_kernels(description.forms)
        self._threads = threading.local()

    @staticmethod
    def from_model(model: "pisigma.model.calibrated_model.CalibratedModel") -> "CompiledIK":
        """Return the compiled inverse kinematics of a model.

        Raises:
            ModelError: the model has no compiled form (see `describe_as_arrays`), or the kernels cannot be used (see
                `__init__`).
        """
        from pisigma.model.compiled_model import describe_as_arrays

        description, branches = describe_as_arrays(model)
        return CompiledIK(description, branches, [joint.name for joint in model.robot.joints], model.name)

    @staticmethod
    def load(file: str | os.PathLike[str]) -> "CompiledIK":
        """Return the inverse kinematics in a file that `model.compiled_model.save_compiled` wrote.

        Raises:
            ModelError: the file is missing, truncated, changed, of another kind or of another format.
        """
        description, names = read_description(file)
        return CompiledIK(description, **names)

    def solve(
        self,
        T_base_tool: Any,
        near: Any = None,
        branch: str | None = None,
        throw: bool = True,
        approach: Any = None,
        owner: AbstractInverse | None = None,
        axes: TaskAxes | None = None,
    ) -> Solution:
        """Find corrected joint values for one pose.

        Args:
            T_base_tool: `(4, 4)`: target pose of the tool in the frame of the measurements [m].
            near: `(dof,)` joint values [rad or m], for example the robot's current joint values. Among the branches
                that reach the pose, the nearest is chosen, with revolute joints wrapped as near as their limits allow.
            branch: name of the branch to use. Without `near` and `branch`, branches are tried in order of decreasing
                numbers of training rows; the first branch that reaches the pose inside the joint limits is chosen, or
                else the first that reaches it.
            throw: whether an invalid pose, or a `near` that is not finite, raises an error; if not, the status is
                INVALID_POSE.
            approach: `(dof,)`: +1 or -1 for the direction in which every joint moves to the pose, 0 if it is unknown.
            owner: see `Solution`.
            axes: axes of the tool that are constrained; None for the arm's `task_axes`.

        Raises:
            PoseError: the matrix is not a valid pose, a shape is wrong, or the branch is unknown.
        """
        T = as_float_array(T_base_tool, "T_base_tool", throw)
        if T.shape != (4, 4):
            raise PoseError(
                expected="one homogeneous transform of shape (4, 4)", value=T.shape, option="T_base_tool"
            )
        near_row, sides = self._rows(near, (), "near", throw), self._rows(approach, (), "approach", True)
        task, dof = self._checked(axes), len(self.joints)
        wrong, out = self._solve_bytes(
            T.tobytes(), near_row.tobytes(), sides.tobytes(), task, self._branch(branch), not throw
        )
        if wrong >= 0:
            raise fault_error(wrong % 8)
        row = np.frombuffer(memoryview(out))
        position, rotation, measure, status, index = row[2 * dof :].tolist()
        joints = row[:dof], row[dof : 2 * dof], int(index), self.branches, int(status)
        return Solution(*joints, position, rotation, measure, owner, task.ignored, approach)

    def solve_packed(self, T_base_tool: bytes, near: bytes) -> list[float]:
        """Find corrected joint values for one pose given as bytes, for example as received from a network socket.

        Args:
            T_base_tool: 16 doubles, row by row [m].
            near: one double for every joint [rad or m], or empty.

        Returns:
            Corrected and nominal joint values, residuals of position [m] and rotation [rad], domain measure, status
            (INVALID_POSE for an invalid pose) and branch, see `Solution`.
        """
        try:
            solve, arguments, out = self._threads.packed
        except AttributeError:
            out, axes = self._row(), self.task_axes.row.tobytes()
            solve = partial(self._kernels, IGNORED, IGNORED, self._address, self._memory(), arrays.SOLVE, 1)
            arguments = b"", 0, axes, bool(axes), arrays.ANY_BRANCH, True, False, out, 1
            self._threads.packed = solve, arguments, out
        solve(T_base_tool, near, bool(near), *arguments)
        return out[:]  # type: ignore[no-any-return]

    def solve_batch(
        self,
        T_base_tool: Any,
        near: Any = None,
        branch: str | None = None,
        threads: int | None = None,
        throw: bool = True,
        approach: Any = None,
        is_float32: bool = False,
        axes: TaskAxes | None = None,
    ) -> Solution:
        """Find corrected joint values for poses `(*batch, 4, 4)`, using several threads.

        Args:
            T_base_tool: `(*batch, 4, 4)`: target poses [m].
            near: `(*batch, dof)` or `(dof,)`: see `solve`.
            branch: see `solve`.
            threads: number of threads; None for one per processor that this process may use.
            throw: see `solve`; if False, invalid rows get the status INVALID_POSE and other rows are solved.
            approach: `(*batch, dof)` or `(dof,)`: see `solve`.
            is_float32: whether the poses were rounded to float32, which widens the tolerances for rounding.
            axes: see `solve`.

        Raises:
            PoseError: a matrix is not a valid pose (the message states its index), or an argument is invalid, see
                `solve`.
        """
        task = self._checked(axes)
        T = self._poses(T_base_tool, throw)
        batch = T.shape[:-2]
        near_rows, sides = (
            self._rows(near, batch, "near", throw),
            self._rows(approach, batch, "approach", True),
        )
        out = self._solve_rows(T, near_rows, sides, self._branch(branch), 1, threads, throw, is_float32, task)
        return self._solution(out.reshape(*batch, out.shape[-1]), task)

    def all_branches(
        self,
        T_base_tool: Any,
        threads: int | None = None,
        throw: bool = True,
        approach: Any = None,
        is_float32: bool = False,
        axes: TaskAxes | None = None,
    ) -> Solution:
        """Find solutions `(*batch, branches)` of poses `(*batch, 4, 4)` on every branch; see `solve_batch`.

        For an arm without a closed-form inverse, these are up to `MAX_SOLUTIONS` distinct solutions; missing solutions
        are UNREACHABLE.
        """
        task = self._checked(axes)
        T = self._poses(T_base_tool, throw)
        sides = self._rows(approach, T.shape[:-2], "approach", True)
        several = not self.description.forms.closed_forms and not self.description.network.used
        count = MAX_SOLUTIONS if several else len(self.branches)
        out = self._solve_rows(
            T, self._none, sides, arrays.EVERY_BRANCH, count, threads, throw, is_float32, task
        )
        return self._solution(out.reshape(*T.shape[:-2], count, out.shape[-1]), task)

    def forward(self, q: Any, arm: int | None = None, approach: Any = None) -> tuple[Any, Any, Any, Any]:
        """Compute poses, Jacobians and corrections of the calibrated arm.

        Args:
            q: `(poses, dof)` commanded joint values [rad or m].
            arm: index of another arm in `kernels.arrays`; None for the calibrated arm.
            approach: `(poses, dof)` or `(dof,)`: see `solve`.

        Returns:
            T_base_tool `(poses, 4, 4)` [m], Jacobian `(poses, 6, dof)` without the slope of the correction, the
            correction `(poses, dof)` [rad or m], and the largest angle [rad] by which a joint is outside its measured
            values `(poses,)`.
        """
        dof = len(self.joints)
        rows = self._rows(q, (len(q),), "q", True)
        sides = self._rows(approach, (len(rows),), "approach", True)
        T, out = np.empty((len(rows), 4, 4)), np.empty((len(rows), 7 * dof + 1))
        default = arrays.CORRECTED if self.description.arms.corrected else arrays.IDENTIFIED
        which = default if arm is None else arm
        self._run(arrays.EVALUATE, T, 0, len(rows), rows, sides, which, False, out, WHOLE.row)
        J = out[:, : 6 * dof].reshape(-1, 6, dof)
        return T, J, out[:, 6 * dof : 7 * dof], out[:, 7 * dof]

    def _checked(self, axes: TaskAxes | None) -> TaskAxes:
        """Return the constrained axes; models that correct by the whole pose accept only the default axes."""
        if axes is None or not self.description.network.used or axes == self.task_axes:
            return axes or self.task_axes
        raise PoseError(
            f"model '{self.name}' corrects nominal joint values as a function of the whole pose, so only the default "
            f"axes ({', '.join(self.task_axes.ignored) or 'none'}) can be ignored",
            value=axes.ignored,
            option="ignore_axes",
            remedy="calibrate a hybrid model",
        )

    def _solution(self, out: Any, axes: TaskAxes) -> Solution:
        """Return the solutions in rows that the kernels write, `(*batch, 2 · dof + 5)`."""
        dof = len(self.joints)
        position, rotation, measure, status, branch = np.moveaxis(out[..., 2 * dof :], -1, 0)
        branches, found = (
            (branch.astype(int), self.branches, status.astype(int)),
            (position, rotation, measure),
        )
        return Solution(out[..., :dof], out[..., dof : 2 * dof], *branches, *found, ignored_axes=axes.ignored)

    def _solve_rows(
        self,
        T: Any,
        near: Any,
        approach: Any,
        branch: int,
        count: int,
        threads: int | None,
        throw: bool,
        single: bool,
        axes: TaskAxes,
    ) -> Any:
        """Solve poses with the kernels, which write rows `(poses, count, 2 · dof + 5)`."""
        if threads is not None and threads < 1:
            raise PoseError(
                expected="a count >= 1",
                value=threads,
                option="threads",
                remedy="give None for one per processor",
            )
        rows = T.reshape(-1, 4, 4)
        out = np.empty((len(rows), count, 2 * len(self.joints) + 5))

        def solve_chunk(start: int) -> int:
            stop = min(start + CHUNK, len(rows))
            return self._run(
                arrays.SOLVE, rows, start, stop, near, approach, branch, not throw, out, axes.row, single
            )

        starts = range(0, len(rows), CHUNK)
        workers = min(threads or _processors(), len(starts))
        results: Iterable[int] = map(solve_chunk, starts)
        if workers > 1:
            with ThreadPoolExecutor(workers) as pool:
                results = pool.map(solve_chunk, starts)
        wrong = next((result for result in list(results) if result >= 0), -1)
        if wrong >= 0:
            index = tuple(int(i) for i in np.unravel_index(wrong // 8, T.shape[:-2])) if T.ndim > 2 else ()
            raise fault_error(wrong % 8, index)
        return out

    def _solve_bytes(
        self, T: bytes, near: bytes, approach: bytes, axes: TaskAxes, branch: int, mark: bool
    ) -> tuple[int, ctypes.Array[ctypes.c_double]]:
        """Solve one pose with the kernels, and return their fault code and the row that they write.

        ctypes passes the address of bytes in a fraction of the time that NumPy needs for the address of an array.
        """
        said, out = Said(), self._row()
        arm = self._address, self._memory(), arrays.SOLVE, 1
        rows = T, near, bool(near), approach, bool(approach), axes.row.tobytes(), len(axes.row)
        self._kernels(said, IGNORED, *arm, *rows, branch, mark, False, out, 1)
        return said[0], out

    def _run(
        self,
        task: int,
        T: Any,
        start: int,
        stop: int,
        near: Any,
        approach: Any,
        branch: int,
        mark: bool,
        out: Any,
        axes: Any,
        single: bool = False,
    ) -> int:
        """Run the kernels on the rows from `start` to `stop`, and return the fault code with the index of its row."""
        pairs = []
        for values in (near, approach):
            address, rows = address_of(values), len(values)
            pairs += [address, rows] if rows < 2 else [address + start * values.strides[0], stop - start]
        said, arm = Said(), (self._address, self._memory(), task, stop - start)
        self._kernels(
            said,
            IGNORED,
            *arm,
            address_of(T) + start * 128,
            *pairs,
            address_of(axes) if len(axes) else 0,
            len(axes),
            branch,
            mark,
            single,
            address_of(out) + start * out.strides[0],
            out.shape[1],
        )
        return said[0] if said[0] < 0 else said[0] + 8 * start

    def _memory(self) -> int:
        """Return the address of working memory that no other thread uses."""
        address: int | None = getattr(self._threads, "address", None)
        if address is None:
            self._threads.memory = make_memory()
            address = self._threads.address = address_of(self._threads.memory)
        return address

    def _branch(self, name: str | None) -> int:
        if name is None:
            return arrays.ANY_BRANCH
        if name not in self.branches:
            check_choice(PoseError, "branch", name, self.branches)
        return self.branches.index(name)

    def _poses(self, T_base_tool: Any, throw: bool) -> Any:
        T = as_float_array(T_base_tool, "T_base_tool", throw)
        if T.ndim < 2 or T.shape[-2:] != (4, 4):
            raise PoseError(
                expected="homogeneous transforms of shape (*batch, 4, 4)", value=T.shape, option="T_base_tool"
            )
        return T

    def _rows(self, values: Any, batch: tuple[int, ...], what: str, throw: bool) -> Any:
        """Return joint values or approach directions as `(1 or poses, dof)`, None as `(0, dof)`."""
        return self._none if values is None else joint_rows(values, batch, what, throw, self.joints)


def _processors() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
