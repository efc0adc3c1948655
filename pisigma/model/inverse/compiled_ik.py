"""Corrected inverse kinematics for control loops: NumPy in, NumPy out, some microseconds a pose."""

import ctypes
import os
import threading
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pisigma.files.errors import PoseError, nearest_choice
from pisigma.model.inverse.joint_input import FAULTS, joint_rows, numbers
from pisigma.model.inverse.solution import AbstractInverse, Solution
from pisigma.robot.kernels import arrays
from pisigma.robot.kernels.array_kinematics import address_of
from pisigma.robot.kernels.description_file import read_description
from pisigma.robot.kernels.layout import make_memory, pack
from pisigma.robot.kernels.machine_code import IGNORED, Said, kernel_forms, load_kernels
from pisigma.robot.kinematics.task_axes import WHOLE, TaskAxes, default_axes

if TYPE_CHECKING:  # a name in full, which type checkers at run time find without this import
    import pisigma.model.calibrated_model

CHUNK = 2_048
"""Poses that a thread takes at a time."""
SOLUTIONS = 8
"""Different solutions of a pose that are looked for on arms without closed form."""


class CompiledIK:
    """The corrected inverse kinematics of one arm, compiled. It may be called from several threads at a time.

    Attributes:
        description: the arm as arrays.
        name: of the model.
        branches: names of the branches.
        joints: names of the joints.
        belongs_to: SHA-256 of the model folder that says the same; "" where there is none.
        axes: which axes of the tool count where no task is stated.
    """

    def __init__(
        self,
        description: arrays.Description,
        branches: Sequence[str],
        joints: Sequence[str],
        name: str = "model",
        belongs_to: str = "",
    ) -> None:
        """Take a description such as `model.compiled_model.describe` makes.

        Raises:
            ModelError: the arm is larger than the compiled kernels allow, or there are no kernels for this machine.
        """
        self.description = description
        self._packed = pack(description, name, kernel_forms(description.forms))
        self._address = address_of(self._packed)
        self.branches, self.joints = tuple(branches), tuple(joints)
        self.name, self.belongs_to = name, belongs_to
        self._none = np.zeros((0, len(self.joints)))
        self._row = ctypes.c_double * (2 * len(self.joints) + 5)
        whole = description.network.used and not description.forms.closed_forms
        self.axes = WHOLE if whole else default_axes(len(self.joints))
        self._kernels = load_kernels(description.forms)
        self._threads = threading.local()

    @staticmethod
    def of(model: "pisigma.model.calibrated_model.CalibratedModel") -> "CompiledIK":
        """Take a model.

        Raises:
            ModelError: it corrects by something that has no compiled form, see `model.compiled_model.describe`; or see
                `__init__`.
        """
        from pisigma.model.compiled_model import describe

        description, branches = describe(model)
        return CompiledIK(description, branches, [joint.name for joint in model.robot.joints], model.name)

    @staticmethod
    def load(file: str | os.PathLike[str]) -> "CompiledIK":
        """Read a file that `model.compiled_model.save_compiled` wrote.

        Raises:
            ModelError: the file is missing, truncated, foreign, changed or of another format.
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
            T_base_tool: `(4, 4)`: wanted pose of the tool in the base frame [m].
            near: `(dof,)` joint values [rad or m] such as the present ones: of the branches that reach the pose the
                nearest is taken, on the nearest turns within the limits.
            branch: name of the branch to take. With neither, branches are tried in the order of how many training
                rows lie on them, then the others; the first that reaches the pose inside the joint limits is taken,
                else the first that reaches it.
            throw: whether a matrix that is no pose, and joint values `near` that are not finite, raise; else the
                status is INVALID_POSE.
            approach: `(dof,)`: +1 or -1 for the side from which every joint comes, 0 where that is not stated.
            owner: see `Solution`.
            axes: which axes of the tool count; None for `axes` of the arm.

        Raises:
            PoseError: the matrix is no pose, a shape does not fit, or there is no such branch.
        """
        T = numbers(T_base_tool, "T_base_tool", throw)
        if T.shape != (4, 4):
            raise PoseError(
                f"T_base_tool has the shape {T.shape}; give one homogeneous transform of shape (4, 4)."
            )
        beside, sides = self._rows(near, (), "near", throw), self._rows(approach, (), "approach", True)
        task, dof = self._checked(axes), len(self.joints)
        wrong, out = self._solve_bytes(
            T.tobytes(), beside.tobytes(), sides.tobytes(), task, self._branch(branch), not throw
        )
        if wrong >= 0:
            raise PoseError(FAULTS[wrong % 8].format(""))
        row = np.frombuffer(memoryview(out))
        position, rotation, measure, status, index = row[2 * dof :].tolist()
        lies = row[:dof], row[dof : 2 * dof], int(index), self.branches, int(status)
        return Solution(*lies, position, rotation, measure, owner, task.ignored)

    def solve_packed(self, T_base_tool: bytes, near: bytes) -> list[float]:
        """Find corrected joint values for one pose whose numbers stand in bytes, as they come from a socket.

        Args:
            T_base_tool: 16 doubles, row by row [m].
            near: a double for every joint [rad or m], or nothing.

        Returns:
            Corrected and nominal joint values, residuals of position [m] and rotation [rad], domain measure, status
            (INVALID_POSE for what is no pose) and branch, see `Solution`.
        """
        try:
            solve, rest, out = self._threads.packed
        except AttributeError:
            out, axes = self._row(), self.axes.row.tobytes()
            solve = partial(self._kernels, IGNORED, IGNORED, self._address, self._memory(), arrays.SOLVE, 1)
            rest = b"", 0, axes, bool(axes), arrays.ANY_BRANCH, True, False, out, 1
            self._threads.packed = solve, rest, out
        solve(T_base_tool, near, bool(near), *rest)
        return out[:]  # type: ignore[no-any-return]

    def solve_batch(
        self,
        T_base_tool: Any,
        near: Any = None,
        branch: str | None = None,
        threads: int | None = None,
        throw: bool = True,
        approach: Any = None,
        single: bool = False,
        axes: TaskAxes | None = None,
    ) -> Solution:
        """Find corrected joint values for poses `(*batch, 4, 4)`, several threads at a time.

        Args:
            T_base_tool: `(*batch, 4, 4)`: wanted poses [m].
            near: `(*batch, dof)` or `(dof,)`: see `solve`.
            branch: see `solve`.
            threads: how many; None for one per processor that this process may use.
            throw: see `solve`; with False bad rows get the status INVALID_POSE and the others are solved.
            approach: `(*batch, dof)` or `(dof,)`: see `solve`.
            single: whether the poses were rounded to float32, which widens what counts as rounding.
            axes: see `solve`.

        Raises:
            PoseError: a matrix is no pose (the message gives its index), or see `solve`.
        """
        task = self._checked(axes)
        T = self._poses(T_base_tool, throw)
        batch = T.shape[:-2]
        beside, sides = self._rows(near, batch, "near", throw), self._rows(approach, batch, "approach", True)
        out = self._solve_rows(T, beside, sides, self._branch(branch), 1, threads, throw, single, task)
        return self._solution(out.reshape(*batch, out.shape[-1]), task)

    def all_branches(
        self,
        T_base_tool: Any,
        threads: int | None = None,
        throw: bool = True,
        approach: Any = None,
        single: bool = False,
        axes: TaskAxes | None = None,
    ) -> Solution:
        """Solutions `(*batch, branches)` of poses `(*batch, 4, 4)` on every branch; for the rest see `solve_batch`.

        An arm without closed form gets up to `SOLUTIONS` different ones instead, UNREACHABLE where there are fewer.
        """
        task = self._checked(axes)
        T = self._poses(T_base_tool, throw)
        sides = self._rows(approach, T.shape[:-2], "approach", True)
        several = not self.description.forms.closed_forms and not self.description.network.used
        count = SOLUTIONS if several else len(self.branches)
        out = self._solve_rows(T, self._none, sides, arrays.EVERY_BRANCH, count, threads, throw, single, task)
        return self._solution(out.reshape(*T.shape[:-2], count, out.shape[-1]), task)

    def forward(self, q: Any, arm: int | None = None, approach: Any = None) -> tuple[Any, Any, Any, Any]:
        """Where the calibrated arm goes.

        Args:
            q: `(poses, dof)` commanded joint values [rad or m].
            arm: another of the arms in `kernels.arrays`.
            approach: `(poses, dof)` or `(dof,)`: see `solve`.

        Returns:
            T_base_tool `(poses, 4, 4)` [m], Jacobian `(poses, 6, dof)` without the slope of the correction, the
            correction `(poses, dof)` [rad or m], and the angle [rad] by which a joint lies beyond its measured values
            `(poses,)`.
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
        """Which axes count; models that correct by the whole pose leave out no others than usual."""
        if axes is None or not self.description.network.used or axes == self.axes:
            return axes or self.axes
        raise PoseError(
            f"model '{self.name}' corrects nominal joint values by the whole pose, so that other axes of the tool than "
            f"the usual ones ({', '.join(self.axes.ignored) or 'none'}) cannot be ignored; calibrate a hybrid."
        )

    def _solution(self, out: Any, axes: TaskAxes) -> Solution:
        """The solutions of poses, `(*batch, 2 · dof + 5)`."""
        dof = len(self.joints)
        position, rotation, measure, status, branch = np.moveaxis(out[..., 2 * dof :], -1, 0)
        lies, found = (branch.astype(int), self.branches, status.astype(int)), (position, rotation, measure)
        return Solution(out[..., :dof], out[..., dof : 2 * dof], *lies, *found, ignored_axes=axes.ignored)

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
        """What the kernels write, `(poses, count, 2 · dof + 5)`."""
        if threads is not None and threads < 1:
            raise PoseError(f"threads={threads}: at least one is needed; give None for one per processor.")
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
            at = f" at index {index if len(index) > 1 else index[0]}" if index else ""
            raise PoseError(FAULTS[wrong % 8].format(at))
        return out

    def _solve_bytes(
        self, T: bytes, near: bytes, approach: bytes, axes: TaskAxes, branch: int, mark: bool
    ) -> tuple[int, ctypes.Array[ctypes.c_double]]:
        """What the kernels say of one pose, and the row that they write.

        ctypes passes the address of bytes in a fraction of the time in which NumPy states that of an array.
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
        """Have the kernels work on the rows from `start` to `stop`; what they say, with the row of the whole."""
        pairs = []
        for values in (near, approach):
            beside, rows = address_of(values), len(values)
            pairs += [beside, rows] if rows < 2 else [beside + start * values.strides[0], stop - start]
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
        """Address of memory to work in that no other thread uses."""
        address: int | None = getattr(self._threads, "address", None)
        if address is None:
            self._threads.memory = make_memory()
            address = self._threads.address = address_of(self._threads.memory)
        return address

    def _branch(self, name: str | None) -> int:
        if name is None:
            return arrays.ANY_BRANCH
        if name not in self.branches:
            raise PoseError(f"there is no branch '{name}'; {nearest_choice(name, self.branches)}")
        return self.branches.index(name)

    def _poses(self, T_base_tool: Any, throw: bool) -> Any:
        T = numbers(T_base_tool, "T_base_tool", throw)
        if T.ndim < 2 or T.shape[-2:] != (4, 4):
            raise PoseError(
                f"T_base_tool has the shape {T.shape}; give homogeneous transforms of shape (*batch, 4, 4)."
            )
        return T

    def _rows(self, values: Any, batch: tuple[int, ...], what: str, throw: bool) -> Any:
        """Joint values, or approaches, as `(1 or poses, dof)`; `(0, dof)` for None."""
        return self._none if values is None else joint_rows(values, batch, what, throw, self.joints)


def _processors() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
