"""The package figaroh: placements of all joints by pinocchio and Levenberg-Marquardt, positions of the targets."""

import contextlib
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from shared_benchmark.methods._dh import rotation_about
from shared_benchmark.rows import Array, Method, Predict, Prediction, Rows, Task

COMPONENTS = ("x", "y", "z")


def fit(task: Task) -> Predict:
    """Fit the base parameters of the chain that the package selects, the base and the position of every target.

    Raises:
        ValueError: the targets were not measured at the same joint values.
    """
    names = [str(name) for name in np.unique(task.train.target)]
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(sys.stderr):
        calibration = _calibration(task, names, Path(folder))
        calibration.initialize()
        found = calibration.solve(enable_logging=False)

    def predict(rows: Rows) -> Prediction:
        from figaroh.calibration.calibration_tools import calc_updated_fkm

        settings = {**calibration.calib_config, "NbSample": len(rows.q)}
        q = rows.q * task.direction[task.direction != 0]
        points = calc_updated_fkm(calibration.model, calibration.data, found.x, q, settings)
        marker = np.array([names.index(str(name)) for name in rows.target])
        T = np.broadcast_to(np.eye(4), (len(q), 4, 4)).copy()
        T[:, :3, 3] = points.reshape(len(names), 3, len(q))[marker, :, np.arange(len(q))]
        T[:, :3, :3] = np.nan
        return Prediction(T)

    return predict


def _calibration(task: Task, names: list[str], folder: Path) -> Any:
    """Return the calibration of the package, whose rows and settings are files."""
    from figaroh.calibration.base_calibration import BaseCalibration
    from figaroh.calibration.calibration_tools import calc_updated_fkm

    class Calibration(BaseCalibration):  # type: ignore[misc]
        """Positions without weights, as in the examples of the package."""

        def cost_function(self, var: Array) -> Array:
            """Return measured minus predicted positions [m]."""
            points = calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)
            return np.asarray(self.PEE_measured - points)

    rows, settings = folder / "rows.csv", folder / "settings.yaml"
    joints = _write_rows(task, names, rows)
    markers = [{"ref_joint": joints[-1], "measurable_dof": [True] * 3 + [False] * 3}] * len(names)
    stated = {
        "robot": {"name": "arm", "properties": {"joints": {"active_joints": joints}}},
        "tasks": {
            "calibration": {
                "enabled": True,
                "type": "kinematic_calibration",
                "kinematics": {"base_frame": "universe", "tool_frame": "flange"},
                "parameters": {"calibration_level": "full_params", "outlier_threshold": 1.0},
                "measurements": {"markers": markers},
                "data": {"source_file": str(rows), "number_of_samples": len(task.train.q)},
            }
        },
    }
    settings.write_text(json.dumps(stated), encoding="utf-8")  # JSON is YAML
    calibration = Calibration(_arm(task, joints), str(settings))
    calibration.calib_config |= {"known_baseframe": False, "known_tipframe": False}
    return calibration


def _write_rows(task: Task, names: list[str], path: Path) -> list[str]:
    """Write joint values and the positions of all targets, and return the names of the joints."""
    train = task.train
    assert train.position is not None
    chosen = [np.flatnonzero(train.target == name) for name in names]
    if len({train.q[rows].tobytes() for rows in chosen}) > 1:
        raise ValueError("expected all targets at the same joint values")
    joints = [f"joint{number}" for number in range(1, train.q.shape[1] + 1)]
    head = [f"{axis}{marker}" for marker in range(1, len(names) + 1) for axis in COMPONENTS]
    positive = train.q[chosen[0]] * task.direction[task.direction != 0]
    values = np.concatenate([*(train.position[rows] for rows in chosen), positive], 1)
    np.savetxt(path, values, delimiter=",", header=",".join([*head, *joints]), comments="", fmt="%.17g")
    return joints


def _arm(task: Task, joints: list[str]) -> Any:
    """Return the nominal arm; joints that turn the other way get negative joint values."""
    import pinocchio

    model, parent, T = pinocchio.Model(), 0, np.eye(4)
    for (theta, d, a, alpha, beta), sign in zip(task.dh, task.direction, strict=True):
        turn, link = np.eye(4), np.eye(4)
        turn[:3, :3] = rotation_about(2, theta)
        link[:3, :3] = rotation_about(0, alpha) @ rotation_about(1, beta)
        link[:3, 3] = a, 0.0, d
        T = T @ turn
        if sign:
            joint = pinocchio.JointModelRZ()
            parent, T = model.addJoint(parent, joint, pinocchio.SE3(T), joints[parent]), np.eye(4)
            model.addJointFrame(parent)
        T = T @ link
    model.addFrame(pinocchio.Frame("flange", parent, 0, pinocchio.SE3(T), pinocchio.FrameType.OP_FRAME))
    model.lowerPositionLimit[:], model.upperPositionLimit[:] = -np.pi, np.pi
    return pinocchio.RobotWrapper(model)


METHOD = Method(
    name="figaroh",
    title="figaroh, placements of all joints",
    source="T. D. V. Nguyen, FIGAROH, LAAS-CNRS, with pinocchio",
    packages=("figaroh", "pin", "numpy", "scipy"),
    measured=("position", "pose"),
    fit=fit,
    slow=True,
)
