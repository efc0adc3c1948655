"""The functions that are compiled once and kept on disk: everything else is compiled into them.

numba keeps compiled code as long as the file of the compiled function itself stays the same, whatever becomes of the
functions that it calls. So the functions here hold a checksum of all files of the package, which numba compares too.
"""

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, no_type_check

from numba import njit

from pisigma.compiled.arrays import BLENDED
from pisigma.compiled.inverse import solve_pose
from pisigma.compiled.motion import correct, covered, move

Array = Any

FINE, NOT_FINITE, LAST_ROW, NOT_ORTHONORMAL, LEFT_HANDED = 0, 1, 2, 3, 4
"""What is wrong with a matrix that should be a pose."""
_TOLERANCE = 1e-6


@njit(error_model="numpy")
@no_type_check
def _check_pose(T: Array) -> int:
    """What is wrong with a matrix, in the order in which `se3.check_transforms` looks."""
    total = 0.0
    for i in range(4):
        for k in range(4):
            total += T[i, k] * 0.0
    if total != 0.0:
        return NOT_FINITE
    if abs(T[3, 0]) + abs(T[3, 1]) + abs(T[3, 2]) + abs(T[3, 3] - 1) > _TOLERANCE:
        return LAST_ROW
    for i in range(3):
        for k in range(i + 1):
            product = T[0, i] * T[0, k] + T[1, i] * T[1, k] + T[2, i] * T[2, k]
            if abs(product - (1.0 if i == k else 0.0)) > _TOLERANCE:
                return NOT_ORTHONORMAL
    x = T[1, 0] * T[2, 1] - T[2, 0] * T[1, 1]
    y = T[2, 0] * T[0, 1] - T[0, 0] * T[2, 1]
    z = T[0, 0] * T[1, 1] - T[1, 0] * T[0, 1]
    return FINE if x * T[0, 2] + y * T[1, 2] + z * T[2, 2] > 0 else LEFT_HANDED


def _solving(checksum: int) -> Callable[..., int]:
    @njit(cache=True, nogil=True, error_model="numpy")
    @no_type_check
    def solve_poses(
        descriptions: Array,
        memories: Array,
        T: Array,
        near: Array,
        has_near: bool,
        branch: int,
        found: Array,
        start: int,
        stop: int,
    ) -> int:
        """Solve poses `start` to `stop` of `(poses, 4, 4)`; -1, or `8 · row + what is wrong` with the first bad one."""
        if checksum < 0:
            return -2
        description, memory = descriptions[0], memories[0]
        for row in range(start, stop):
            wrong = _check_pose(T[row])
            if wrong != FINE:
                return 8 * row + wrong
            for i in range(4):
                for k in range(4):
                    memory.pose[i, k] = T[row, i, k]
            for j in range(near.shape[1]):
                memory.near[j] = near[row if near.shape[0] > 1 else 0, j]
            solve_pose(description, memory, has_near, branch, found[row])
        return -1

    return solve_poses  # type: ignore[no-any-return]


def _evaluating(checksum: int) -> Callable[..., None]:
    @njit(cache=True, nogil=True, error_model="numpy")
    @no_type_check
    def evaluate(
        descriptions: Array,
        memories: Array,
        arm: int,
        q: Array,
        T: Array,
        J: Array,
        delta: Array,
        share: Array,
    ) -> None:
        """Pose `(poses, 4, 4)`, Jacobian `(poses, 6, dof)` and, of BLENDED, correction and share at joint values."""
        if checksum < 0:
            return
        description, memory = descriptions[0], memories[0]
        dof = description.arms.dof
        for row in range(q.shape[0]):
            for j in range(dof):
                memory.q[j] = q[row, j]
            if arm == BLENDED:
                correct(description, memory, memory.q)
                for j in range(dof):
                    delta[row, j] = memory.delta[j]
                share[row] = covered(description, memory.q)[0]
            move(description, memory, arm, memory.q)
            T[row, :3, :] = memory.T
            T[row, 3, :] = 0.0
            T[row, 3, 3] = 1.0
            for i in range(6):
                for j in range(dof):
                    J[row, i, j] = memory.J[i, j]

    return evaluate  # type: ignore[no-any-return]


def _checksum() -> int:
    """Of all files of this package."""
    value = 0
    for path in sorted(Path(__file__).parent.glob("*.py")):
        value = zlib.crc32(path.read_bytes(), value)
    return value


_SOURCES = _checksum()
solve_poses = _solving(_SOURCES)
evaluate = _evaluating(_SOURCES)
