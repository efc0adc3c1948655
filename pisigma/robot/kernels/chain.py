"""Forward kinematics and joint Jacobian of an arm for single and many joint values, on plain numbers."""

import math

from pisigma.robot.kernels.arrays import FIXED, REVOLUTE
from pisigma.robot.kernels.layout import LANES
from pisigma.robot.kernels.rows import Array, Record, contracted_kernel


@contracted_kernel
def walk(arms: Record, arm: int, q: Array, axes: Array, T: Array) -> None:
    """Compute tool pose, and axis and origin of every joint, in the base frame; see `kinematics.forward`.

    Args:
        arms: the arms.
        arm: index of the arm.
        q: joint values [rad or m].
        axes: `(dof, 6)`, output: axis and origin [m].
        T: `(3, 4)`, output: T_base_tool without its last row.
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
        # The frame's rows a, b, c are transformed by RotZ(theta), Trans(a, 0, d), RotX(alpha) and RotY(beta).
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


@contracted_kernel
def jacobian(arms: Record, axes: Array, T: Array, J: Array) -> None:
    """Compute the geometric Jacobian in the base frame at the tool's origin; see `kinematics.jacobian`.

    Args:
        arms: the arms.
        axes: output of `walk`.
        T: output of `walk`.
        J: `(6, dof)`, output.
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


@contracted_kernel
def walk_many(arms: Record, arm: int, memory: Record, q: Array, T: Array, J: Array) -> None:
    """Compute tool poses and Jacobians at many joint values, vectorised by `LANES`; see `walk` and `jacobian`.

    Args:
        arms: the arms.
        arm: index of the arm.
        memory: working memory.
        q: `(poses, dof)`: joint values [rad or m].
        T: `(poses, 4, 4)`, output: T_base_tool.
        J: `(poses, 6, dof)`, output; without rows no Jacobian is computed.
    """
    frame, axes = memory.lanes, memory.lane_axes
    for first in range(0, q.shape[0], LANES):
        count = min(LANES, q.shape[0] - first)
        for i in range(3):
            for k in range(4):
                for b in range(LANES):
                    frame[4 * i + k, b] = arms.ends[arm, 0, i, k]
        joint = 0
        for i in range(arms.rows_used):
            row, kind = arms.rows[arm, i], arms.kind[i]
            if kind != FIXED:
                if J.shape[0] > 0:
                    for k in range(3):
                        for b in range(LANES):
                            axes[joint, k, b], axes[joint, 3 + k, b] = (
                                frame[4 * k + 2, b],
                                frame[4 * k + 3, b],
                            )
                _turn_by_joint(arms, row, kind, joint, q, first, count, memory)
                joint += 1
            else:
                _turn(frame, 0, 1, row[7], row[8])
                _shift(frame, 2, row[1])
            if row[2] != 0.0:
                _shift(frame, 0, row[2])
            _turn(frame, 1, 2, row[3], row[4])
            _turn(frame, 2, 0, row[5], row[6])
        _write_poses(arms.ends[arm, 1], frame, first, count, T)
        if J.shape[0] > 0:
            _write_jacobians(arms, axes, T, first, count, J)


@contracted_kernel
def _turn_by_joint(
    arms: Record, row: Array, kind: int, joint: int, q: Array, first: int, count: int, memory: Record
) -> None:
    """Rotate frames about their z axes by theta and translate them along z by d, including the joint value."""
    frame, turns = memory.lanes, memory.lane_turns
    for b in range(LANES):
        turns[0, b] = arms.direction[joint] * q[first + min(b, count - 1), joint]
    if kind == REVOLUTE:
        cosines_sines(turns, row[0])
        for i in range(0, 12, 4):
            for b in range(LANES):
                cos, sin, x, y = turns[0, b], turns[1, b], frame[i, b], frame[i + 1, b]
                frame[i, b], frame[i + 1, b] = cos * x + sin * y, cos * y - sin * x
        if row[1] != 0.0:
            _shift(frame, 2, row[1])
        return
    _turn(frame, 0, 1, row[7], row[8])
    for i in range(0, 12, 4):
        for b in range(LANES):
            frame[i + 3, b] += (row[1] + turns[0, b]) * frame[i + 2, b]


@contracted_kernel
def cosines_sines(turns: Array, offset: float) -> None:
    """Replace angles `turns[0]` [rad] by the cosines of angle and offset, and write the sines into `turns[1]`.

    Reduction to [-pi/4, pi/4] in three parts (Cody and Waite 1980) and the polynomials of fdlibm (Sun 1993): errors
    below 1e-15, vectorised over angles. Larger angles use the C library.
    """
    largest = 0.0
    for b in range(LANES):
        turns[0, b] += offset
        largest = max(largest, abs(turns[0, b]))
    if not largest < 1e5:
        for b in range(LANES):
            angle = turns[0, b]
            turns[0, b], turns[1, b] = math.cos(angle), math.sin(angle)
        return
    for b in range(LANES):
        angle = turns[0, b]
        quarters = math.floor(angle * 0.6366197723675814 + 0.5)
        x = angle - quarters * 1.57079632673412561417
        x = x - quarters * 6.07710050630396597660e-11
        x = x - quarters * 2.02226624879595063154e-21
        z = x * x
        sine = -2.50507602534068634195e-08 + z * 1.58969099521155010221e-10
        sine = -1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 + z * sine)
        sine = x + x * z * (-1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * sine))
        cosine = 2.08757232129817482790e-09 + z * -1.13596475577881948265e-11
        cosine = 2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07 + z * cosine)
        cosine = 4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * cosine)
        cosine = 1.0 - (0.5 * z - z * z * cosine)
        quadrant = quarters - 4.0 * math.floor(quarters * 0.25)
        # An odd number of quarter turns swaps sine and cosine.
        odd = quadrant == 1.0 or quadrant == 3.0
        first, second = sine if odd else cosine, cosine if odd else sine
        turns[0, b] = -first if quadrant == 1.0 or quadrant == 2.0 else first
        turns[1, b] = -second if quadrant >= 2.0 else second


@contracted_kernel
def _turn(frame: Array, u: int, v: int, cos: float, sin: float) -> None:
    """Rotate frames by one angle, from their axis u towards their axis v."""
    if sin == 0.0 and cos == 1.0:
        return
    for i in range(0, 12, 4):
        for b in range(LANES):
            x, y = frame[i + u, b], frame[i + v, b]
            frame[i + u, b], frame[i + v, b] = cos * x + sin * y, cos * y - sin * x


@contracted_kernel
def _shift(frame: Array, axis: int, distance: float) -> None:
    """Translate frames along one of their axes [m]."""
    for i in range(0, 12, 4):
        for b in range(LANES):
            frame[i + 3, b] += distance * frame[i + axis, b]


@contracted_kernel
def _write_poses(tool: Array, frame: Array, first: int, count: int, T: Array) -> None:
    """Write the frames followed by the tool."""
    for b in range(count):
        pose = T[first + b]
        for i in range(3):
            x, y, z = frame[4 * i, b], frame[4 * i + 1, b], frame[4 * i + 2, b]
            for k in range(4):
                pose[i, k] = x * tool[0, k] + y * tool[1, k] + z * tool[2, k]
            pose[i, 3] += frame[4 * i + 3, b]
        pose[3, 0], pose[3, 1], pose[3, 2], pose[3, 3] = 0.0, 0.0, 0.0, 1.0


@contracted_kernel
def _write_jacobians(arms: Record, axes: Array, T: Array, first: int, count: int, J: Array) -> None:
    """Write the columns of the Jacobian for all joints; see `jacobian`."""
    for j in range(arms.dof):
        sign = arms.direction[j]
        for b in range(count):
            pose, column = T[first + b], J[first + b]
            x, y, z = sign * axes[j, 0, b], sign * axes[j, 1, b], sign * axes[j, 2, b]
            if arms.revolute[j]:
                u, v, w = pose[0, 3] - axes[j, 3, b], pose[1, 3] - axes[j, 4, b], pose[2, 3] - axes[j, 5, b]
                column[0, j], column[1, j], column[2, j] = y * w - z * v, z * u - x * w, x * v - y * u
                column[3, j], column[4, j], column[5, j] = x, y, z
            else:
                column[0, j], column[1, j], column[2, j] = x, y, z
                column[3, j], column[4, j], column[5, j] = 0.0, 0.0, 0.0
