"""Forward kinematics of DH rows, and least squares on their parameters with scipy."""

from dataclasses import dataclass

import numpy as np

from shared_benchmark.rows import Array, Predict, Prediction, Rows, Task

LEVER = 0.3
"""Lever arm that converts angles of measured rotations to lengths [m]."""
DISTANCE_WEIGHT = 30.0
"""Weight of the known distances of sockets relative to rows."""
ALTERNATIONS = 30
COST_TOLERANCE = 1e-6
"""Relative decrease of the cost below which a fit has converged; some directions have almost no effect."""
PARALLEL = 1e-6
"""Sine of the angle below which consecutive axes are parallel, so that Hayati's angle replaces the offset."""


def flange_poses(dh: Array, direction: Array, q: Array) -> Array:
    """Return the poses (rows of q, 4, 4) of the last DH row in the frame of the first."""
    T = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    joint = 0
    for (theta, d, a, alpha, beta), sign in zip(dh, direction, strict=True):
        angle = np.full(len(q), theta)
        if sign:
            angle, joint = angle + sign * q[:, joint], joint + 1
        cosine, sine = np.cos(angle), np.sin(angle)
        A = np.zeros((len(q), 4, 4))
        A[:, 0, 0], A[:, 0, 1], A[:, 1, 0], A[:, 1, 1] = cosine, -sine, sine, cosine
        A[:, 0, 3], A[:, 1, 3], A[:, 2, 3] = a * cosine, a * sine, d
        A[:, 2, 2] = A[:, 3, 3] = 1.0
        link = np.eye(4)
        link[:3, :3] = rotation_about(0, alpha) @ rotation_about(1, beta)
        T = T @ A @ link
    return T


def rotation_about(axis: int, angle: float) -> Array:
    """Return the rotation about an axis of the frame (0 for x)."""
    vector = np.zeros(3)
    vector[axis] = angle
    return rotation_of(vector)


def rotation_of(vector: Array) -> Array:
    """Return the rotation of a rotation vector [rad]."""
    angle = float(np.linalg.norm(vector))
    K = np.cross(np.eye(3), vector)
    if angle < 1e-9:
        return np.eye(3) + K
    return np.eye(3) + np.sin(angle) / angle * K + (1 - np.cos(angle)) / angle**2 * K @ K


def nearest_rotation(matrix: Array) -> Array:
    """Return the rotation that is nearest to a matrix."""
    U, _, V = np.linalg.svd(matrix)
    rotation: Array = U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V
    return rotation


@dataclass(frozen=True, eq=False)
class Frames:
    """Base, and tools by target.

    Attributes:
        base: pose of the robot in the frame of the sensor (4, 4).
        tools: position of every target on the flange [m].
        turn: rotation of the tool on the flange.
    """

    base: Array
    tools: dict[str, Array]
    turn: Array

    def poses(self, T: Array, target: Array) -> Array:
        """Return the poses of the targets of some flange poses."""
        tool = np.broadcast_to(np.eye(4), T.shape).copy()
        tool[:, :3, :3] = self.turn
        tool[:, :3, 3] = np.array([self.tools[str(name)] for name in target])
        return self.base @ T @ tool

    def moved(self, step: Array) -> "Frames":
        """Return the frames after a step: base (6), rotation of the tool (3), and positions of the targets."""
        base = self.base.copy()
        base[:3, :3], base[:3, 3] = rotation_of(step[3:6]) @ base[:3, :3], base[:3, 3] + step[:3]
        shifts = step[9:].reshape(-1, 3)
        tools = {name: place + shift for (name, place), shift in zip(self.tools.items(), shifts, strict=True)}
        return Frames(base, tools, self.turn @ rotation_of(step[6:9]))


def first_frames(T: Array, rows: Rows) -> Frames:
    """Guess base and tools: the better of two starts, refined by alternating between the base and the tools.

    One start is the affine fit `position = A vec(R) + B p + c` with the rotation nearest to `B`, the other one assumes
    that the targets are at the flange.
    """
    names = [str(name) for name in np.unique(rows.target)]
    if rows.position is None:
        return Frames(np.eye(4), dict.fromkeys(names, _tool_of_sockets(T, rows)), np.eye(3))
    first = rows.target == names[0]
    count = int(first.sum())
    columns = np.concatenate([T[first, :3, :3].reshape(count, 9), T[first, :3, 3], np.ones((count, 1))], 1)
    affine = np.linalg.lstsq(columns, rows.position[first], rcond=1e-9)[0]
    starts = nearest_rotation(affine[9:12].T), _rotation_between(T[:, :3, 3], rows.position)
    guesses = [_alternate(T, rows, names, R) for R in starts]
    frames = min(
        guesses, key=lambda one: float(np.square(rows.position - one.poses(T, rows.target)[:, :3, 3]).sum())
    )
    if rows.rotation is None:
        return frames
    turn = nearest_rotation(np.einsum("nji,njk->ik", frames.base[:3, :3] @ T[:, :3, :3], rows.rotation))
    return Frames(frames.base, frames.tools, turn)


def _alternate(T: Array, rows: Rows, names: list[str], R: Array) -> Frames:
    """Alternate between the rotation of the base and all positions, which are linear."""
    assert rows.position is not None
    eye = np.broadcast_to(np.eye(3), (len(T), 3, 3))
    base = np.eye(4)
    for _ in range(ALTERNATIONS):
        tools = [np.where((rows.target == name)[:, None, None], R @ T[:, :3, :3], 0.0) for name in names]
        columns = np.concatenate([eye, *tools], 2).reshape(-1, 3 + 3 * len(names))
        wanted = (rows.position - T[:, :3, 3] @ R.T).ravel()
        shifts = np.linalg.lstsq(columns, wanted, rcond=None)[0]
        base[:3, :3], base[:3, 3] = R, shifts[:3]
        frames = Frames(base.copy(), dict(zip(names, shifts[3:].reshape(-1, 3), strict=True)), np.eye(3))
        R = _rotation_between((np.linalg.inv(base) @ frames.poses(T, rows.target))[:, :3, 3], rows.position)
    return frames


def _rotation_between(first: Array, second: Array) -> Array:
    """Return the rotation from points to others (Kabsch 1976)."""
    return nearest_rotation((second - second.mean(0)).T @ (first - first.mean(0)))


def _tool_of_sockets(T: Array, rows: Rows) -> Array:
    """Return the position of the ball on the flange with the least scatter of the rows of a socket."""
    assert rows.socket is not None
    R, p = T[:, :3, :3].copy(), T[:, :3, 3].copy()
    for name in np.unique(rows.socket):
        here = rows.socket == name
        R[here] -= R[here].mean(0)
        p[here] -= p[here].mean(0)
    tool: Array = np.linalg.lstsq(R.reshape(-1, 3), -p.ravel(), rcond=None)[0]
    return tool


def residuals(T: Array, rows: Rows, distances: dict[tuple[str, str], float]) -> Array:
    """Return measured minus predicted values of all rows [m]."""
    if rows.position is not None:
        parts = [(rows.position - T[:, :3, 3]).ravel()]
        if rows.rotation is not None:
            between = np.einsum("nij,nkj->nik", rows.rotation, T[:, :3, :3])
            parts.append(LEVER / 2 * (between - between.transpose(0, 2, 1))[:, [2, 0, 1], [1, 2, 0]].ravel())
        return np.concatenate(parts)
    assert rows.socket is not None
    place = {str(name): T[rows.socket == name, :3, 3].mean(0) for name in np.unique(rows.socket)}
    scatter = T[:, :3, 3] - np.array([place[str(name)] for name in rows.socket])
    known = [np.linalg.norm(place[a] - place[b]) - length for (a, b), length in distances.items()]
    return np.concatenate([scatter.ravel(), DISTANCE_WEIGHT * np.array(known)])


@dataclass(frozen=True, eq=False)
class Geometry:
    """A fitted geometry.

    Attributes:
        dh: DH parameters (rows, 5).
        direction: sign of the joint value of every row; 0 for fixed rows.
        frames: base and tools.
    """

    dh: Array
    direction: Array
    frames: Frames

    def poses(self, rows: Rows) -> Array:
        """Return predicted poses of the targets."""
        return self.frames.poses(flange_poses(self.dh, self.direction, rows.q), rows.target)


def fit_geometry(task: Task, arm: bool) -> Geometry:
    """Fit base and tools, and the arm's parameters if wanted, by scipy's `least_squares`.

    The parameters of the arm are theta, d, a and alpha of the links, with Hayati's beta instead of d where the next
    axis is parallel (Hayati and Mirmirani 1985, J. Robotic Systems 2(4), 397-413), starting from the nominal arm.
    The base replaces theta and d of the first row, and the tool replaces the last row.

    Args:
        task: the rows and the nominal arm.
        arm: whether the arm's parameters are fitted.
    """
    from scipy.optimize import least_squares

    free = np.zeros(task.dh.shape, bool)
    if arm:
        parallel = np.abs(np.sin(task.dh[:, 3])) < PARALLEL
        links = (task.direction != 0) & (np.arange(len(task.dh)) < task.direction.nonzero()[0][-1])
        free[:, [0, 2, 3]] = links[:, None]
        free[:, 1], free[:, 4] = links & ~parallel, links & parallel
        free[0, :2] = False
    start = first_frames(flange_poses(task.dh, task.direction, task.train.q), task.train)
    count = int(free.sum())

    def moved(x: Array) -> Geometry:
        dh = task.dh.copy()
        dh[free] += x[:count]
        return Geometry(dh, task.direction, start.moved(x[count:]))

    def errors(x: Array) -> Array:
        return residuals(moved(x).poses(task.train), task.train, dict(task.distances))

    found = least_squares(
        errors, np.zeros(count + 9 + 3 * len(start.tools)), method="trf", x_scale="jac", ftol=COST_TOLERANCE
    )
    if not found.success:
        raise RuntimeError(found.message)
    return moved(found.x)


def predict_with(geometry: Geometry) -> Predict:
    """Return the function that predicts with a geometry."""
    return lambda rows: Prediction(geometry.poses(rows))
