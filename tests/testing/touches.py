"""Touches of one fixed point by a UR5 with a tip of unknown position on its flange."""

import numpy as np
import torch
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.closed_form.registry import closed_form_solver
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.robot.se3 import invert, rotation_from_vector, transform, transform_from_xyz_zyx

TIP = np.array([0.05, -0.03, 0.2, 0.0, 0.0, 0.0])
POINT = torch.tensor([0.4, 0.1, 0.3], dtype=torch.float64)
NOISE = 5e-5
"""Standard deviation of a coordinate of a touch [m]."""
DOWN = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))


def touching_joints(
    count: int, tilt: float = 0.7, axis: int | None = None, places: Tensor | None = None
) -> Tensor:
    """Return joint values `(count, 6)` [rad] that hold the tip on a point, tilted about all axes or about one.

    With places `(count, 3)` [m], every row has a point of its own.
    """
    robot, rng, chosen = Robot.load("ur5"), np.random.default_rng(0), list[Tensor]()
    solver = closed_form_solver(robot)
    assert solver is not None
    while len(chosen) < count:
        turn = rng.uniform(-tilt, tilt, 3) * (1 if axis is None else np.eye(3)[axis])
        place = POINT if places is None else places[len(chosen)].double()
        T = transform(rotation_from_vector(torch.from_numpy(turn)) @ DOWN, place)
        branches = solver.solve(T @ invert(transform_from_xyz_zyx(torch.from_numpy(TIP)))).q
        reached = branches[torch.isfinite(branches).all(-1)]
        if len(reached):
            chosen.append(reached[0])
    return torch.stack(chosen)


def noise_vectors(values: int) -> np.ndarray:
    """Return vectors of noise `(values, values)` [m] whose mean outer product is exactly `NOISE² · identity`.

    The mean square error of a linear estimator over them is exactly that over random noise.
    """
    orthogonal = np.linalg.qr(np.random.default_rng(0).normal(size=(values, values)))[0]
    vectors: np.ndarray = NOISE * np.sqrt(values) * orthogonal
    return vectors


def touches(q: Tensor, missed: np.ndarray) -> Measurements:
    """Return touches that missed the point by `missed` `(touches, 3)` [m], which the joint values contain."""
    J = joint_jacobian(Robot.load("ur5").with_geometry(tool=TIP), q)[1][:, :3]
    moved = (torch.linalg.pinv(J) @ torch.from_numpy(missed)[..., None])[..., 0]
    return Measurements(q=q + moved, socket=("point",) * len(q))


def random_noise(count: int, seed: int, wrong: int | None = None) -> np.ndarray:
    """Return noise of points `(count, 3)` [m], of which one may be wrong by 5 mm in addition."""
    rng = np.random.default_rng(seed)
    missed = rng.normal(0, NOISE, (count, 3))
    if wrong is not None:
        direction = rng.normal(size=3)
        missed[wrong] += 5e-3 * direction / np.linalg.norm(direction)
    return missed
