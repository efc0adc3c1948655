"""The package pybotics: modified DH without Hayati's angle, positions of one target."""

import numpy as np

from shared_benchmark.methods._dh import first_frames, flange_poses
from shared_benchmark.rows import Method, Predict, Prediction, Task

EVALUATIONS = 3000
"""Largest number of evaluations of the error function."""


def fit(task: Task) -> Predict:
    """Fit the chain, the position of the tool and the world frame, as in the tutorial of the package.

    Raises:
        ValueError: there is more than one target, or a joint turns the other way.
    """
    from pybotics.kinematic_chain import MDHKinematicChain
    from pybotics.optimization import OptimizationHandler, optimize_accuracy
    from pybotics.robot import Robot
    from pybotics.tool import Tool
    from scipy.optimize import least_squares

    if len(np.unique(task.train.target)) > 1 or (task.direction != 1).any():
        raise ValueError("expected one target and joints of positive direction")
    start = first_frames(flange_poses(task.dh, task.direction, task.train.q), task.train)
    theta, d, a, alpha = task.dh.T[:4]
    shifted = [np.concatenate([[0.0], values[:-1]]) for values in (alpha, a)]
    chain = MDHKinematicChain.from_parameters(np.stack([*shifted, theta, d], axis=1))
    tool = np.eye(4)
    (tool[:3, 3],) = start.tools.values()
    robot = Robot(chain, tool=Tool(matrix=tool), world_frame=start.base)
    masks = {"kinematic_chain_mask": True, "tool_mask": [True] * 3 + [False] * 3, "world_mask": True}
    handler = OptimizationHandler(robot, **masks)
    first = handler.generate_optimization_vector()
    given = (handler, task.train.q, task.train.position)
    found = least_squares(optimize_accuracy, first, args=given, method="lm", max_nfev=EVALUATIONS)
    handler.apply_optimization_vector(found.x)
    return lambda rows: Prediction(np.stack([handler.robot.fk(q) for q in rows.q]))


METHOD = Method(
    name="pybotics",
    title="pybotics, least squares on modified DH",
    source="N. Nadeau 2019, J. Open Source Software 4(41), 1738",
    packages=("pybotics", "numpy", "scipy"),
    measured=("position", "pose"),
    fit=fit,
    slow=True,
)
