"""Forward kinematics and joint Jacobian of one arm at one place, on plain numbers."""

import math
from typing import Any, no_type_check

from numba import njit

from pisigma.kernels.arrays import FIXED, REVOLUTE

Array = Any
Record = Any


@njit(error_model="numpy", fastmath={"contract"})
@no_type_check
def walk(arms: Record, arm: int, q: Array, axes: Array, T: Array) -> None:
    """Tool pose, and axis and origin of every joint, in the base frame: see `kinematics.forward`.

    Args:
        arms: the arms.
        arm: which of them.
        q: joint values [rad or m].
        axes: `(dof, 6)`, written: axis and origin [m].
        T: `(3, 4)`, written: T_base_tool without its last row.
    """
    base, tool = arms.ends[arm, 0], arms.ends[arm, 1]
    ax, ay, az, ap = base[0, 0], base[0, 1], base[0, 2], base[0, 3]
    bx, by, bz, bp = base[1, 0], base[1, 1], base[1, 2], base[1, 3]
    cx, cy, cz, cp = base[2, 0], base[2, 1], base[2, 2], base[2, 3]
    joint = 0
    for i in range(arms.rows_used):
        row = arms.rows[arm, i]
        d, cos, sin = row[1], row[7], row[8]
        if arms.kind[i] != FIXED:
            axis = axes[joint]
            axis[0], axis[1], axis[2] = az, bz, cz
            axis[3], axis[4], axis[5] = ap, bp, cp
            value = arms.direction[joint] * q[joint]
            if arms.kind[i] == REVOLUTE:
                angle = row[0] + value
                cos, sin = math.cos(angle), math.sin(angle)
            else:
                d += value
            joint += 1
        ax, ay = cos * ax + sin * ay, cos * ay - sin * ax
        bx, by = cos * bx + sin * by, cos * by - sin * bx
        cx, cy = cos * cx + sin * cy, cos * cy - sin * cx
        ap += row[2] * ax + d * az
        bp += row[2] * bx + d * bz
        cp += row[2] * cx + d * cz
        cos, sin = row[3], row[4]
        ay, az = cos * ay + sin * az, cos * az - sin * ay
        by, bz = cos * by + sin * bz, cos * bz - sin * by
        cy, cz = cos * cy + sin * cz, cos * cz - sin * cy
        cos, sin = row[5], row[6]
        az, ax = cos * az + sin * ax, cos * ax - sin * az
        bz, bx = cos * bz + sin * bx, cos * bx - sin * bz
        cz, cx = cos * cz + sin * cx, cos * cx - sin * cz
    for k in range(4):
        T[0, k] = ax * tool[0, k] + ay * tool[1, k] + az * tool[2, k]
        T[1, k] = bx * tool[0, k] + by * tool[1, k] + bz * tool[2, k]
        T[2, k] = cx * tool[0, k] + cy * tool[1, k] + cz * tool[2, k]
    T[0, 3] += ap
    T[1, 3] += bp
    T[2, 3] += cp


@njit(error_model="numpy", fastmath={"contract"})
@no_type_check
def jacobian(arms: Record, axes: Array, T: Array, J: Array) -> None:
    """Geometric Jacobian in the base frame at the tool's origin: see `kinematics.jacobian`.

    Args:
        arms: the arms.
        axes: what `walk` wrote.
        T: what `walk` wrote.
        J: `(6, dof)`, written.
    """
    for j in range(arms.dof):
        sign, axis = arms.direction[j], axes[j]
        x, y, z = sign * axis[0], sign * axis[1], sign * axis[2]
        if arms.revolute[j]:
            u, v, w = T[0, 3] - axis[3], T[1, 3] - axis[4], T[2, 3] - axis[5]
            J[0, j], J[1, j], J[2, j] = y * w - z * v, z * u - x * w, x * v - y * u
            J[3, j], J[4, j], J[5, j] = x, y, z
        else:
            J[0, j], J[1, j], J[2, j] = x, y, z
            J[3, j], J[4, j], J[5, j] = 0.0, 0.0, 0.0
