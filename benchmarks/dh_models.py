"""Models of MuJoCo, pinocchio, Drake and the Robotics Toolbox from an exported DH table.

The module does not import pisigma, and reads the table by the convention and the units that the file states: A_i =
RotZ(theta_i + direction q_i) Trans(a_i, 0, d_i) RotX(alpha_i) RotY(beta_i), a prismatic joint adds its value to d_i.
"""

import csv
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

BASE, TOOL = "base", "tool"
"""Names of the base and the tool in the models."""


@dataclass(frozen=True)
class Row:
    """A row of the table, with type, direction (1 or -1), theta, alpha and beta [rad], d and a [m]."""

    type: str
    direction: int
    theta: float
    d: float
    a: float
    alpha: float
    beta: float


@dataclass(frozen=True)
class Table:
    """Base (4, 4), rows and tool (4, 4) of a table."""

    T_base: np.ndarray
    rows: list[Row]
    T_tool: np.ndarray

    def links(self) -> Iterator[tuple[str, int, np.ndarray]]:
        """Yield type and direction of every joint, and the pose of its frame (with its axis as z) in the previous one.

        A rotation about z and a translation along it commute, so the frame comes after RotZ(theta) Trans(0, 0, d).
        """
        T = self.T_base
        for row in self.rows:
            yield row.type, row.direction, T @ _rotation("z", row.theta) @ _translation(0, 0, row.d)
            T = _translation(row.a, 0, 0) @ _rotation("x", row.alpha) @ _rotation("y", row.beta)

    @property
    def T_last_tool(self) -> np.ndarray:
        """Return the pose of the tool in the last frame of `links`."""
        row = self.rows[-1]
        T = _translation(row.a, 0, 0) @ _rotation("x", row.alpha) @ _rotation("y", row.beta)
        return np.asarray(T @ self.T_tool)


def _rotation(axis: str, angle: float) -> np.ndarray:
    T, i = np.eye(4), "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    T[[j, k], [j, k]] = math.cos(angle)
    T[k, j], T[j, k] = math.sin(angle), -math.sin(angle)
    return T


def _translation(*xyz: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = xyz
    return T


def _in_si(entry: dict[str, Any], *names: str) -> list[float]:
    """Return values [m, rad] whose keys end with their unit."""
    return [
        float(entry[f"{n}_mm"]) / 1e3 if f"{n}_mm" in entry else math.radians(float(entry[f"{n}_deg"]))
        for n in names
    ]


def _frame(entry: dict[str, Any]) -> np.ndarray:
    x, y, z = _in_si(entry, "x", "y", "z")
    roll, pitch, yaw = _in_si(entry, "roll", "pitch", "yaw")
    return np.asarray(
        _translation(x, y, z) @ _rotation("z", roll) @ _rotation("y", pitch) @ _rotation("x", yaw)
    )


def read_table(path: str) -> Table:
    """Read a .csv or .json file of `pisigma export --format dh`."""
    text = Path(path).read_text()
    if path.endswith(".json"):
        document = json.loads(text)
        base, rows, tool = document["base"], document["rows"], document["tool"]
    else:
        lines = [{k: v for k, v in line.items() if v} for line in csv.DictReader(_without_comments(text))]
        (base,), (tool,) = ([line for line in lines if line["part"] == part] for part in (BASE, TOOL))
        rows = [line for line in lines if line["part"] == "row"]
    made = [
        Row(row["type"], int(row["direction"]), *_in_si(row, "theta", "d", "a", "alpha", "beta"))
        for row in rows
    ]
    return Table(_frame(base), made, _frame(tool))


def _without_comments(text: str) -> list[str]:
    return [line for line in text.splitlines() if not line.startswith("#")]


def mujoco_model(path: str) -> Any:
    """Return a MuJoCo specification with the sites `base` and `tool`."""
    import mujoco

    def place(made: Any, T: np.ndarray) -> Any:
        made.pos, quaternion = T[:3, 3], np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, T[:3, :3].flatten())
        made.quat = quaternion
        return made

    table, spec = read_table(path), mujoco.MjSpec()
    kinds = {"revolute": mujoco.mjtJoint.mjJNT_HINGE, "prismatic": mujoco.mjtJoint.mjJNT_SLIDE}
    body = spec.worldbody
    body.add_site(name=BASE)
    for kind, direction, T in table.links():
        body = place(body.add_body(mass=1.0, inertia=[0.01] * 3), T)
        if kind in kinds:
            body.add_joint(type=kinds[kind], axis=[0, 0, direction])
    place(body.add_site(name=TOOL), table.T_last_tool)
    return spec


def pinocchio_model(path: str) -> Any:
    """Return a pinocchio model with the frames `base` and `tool`."""
    import pinocchio

    table, model = read_table(path), pinocchio.Model()
    kinds = {
        "revolute": pinocchio.JointModelRevoluteUnaligned,
        "prismatic": pinocchio.JointModelPrismaticUnaligned,
    }
    joint, T_joint = 0, np.eye(4)
    for number, (kind, direction, T) in enumerate(table.links()):
        T_joint = T_joint @ T
        if kind in kinds:
            moves = kinds[kind](np.array([0.0, 0.0, direction]))
            joint = model.addJoint(joint, moves, pinocchio.SE3(T_joint), f"joint_{number}")
            T_joint = np.eye(4)
    for name, of, T in ((BASE, 0, np.eye(4)), (TOOL, joint, T_joint @ table.T_last_tool)):
        model.addFrame(pinocchio.Frame(name, of, pinocchio.SE3(T), pinocchio.FrameType.OP_FRAME))
    return model


def add_to_drake(path: str, plant: Any) -> None:
    """Add the arm to a plant of Drake, with the frames `base` and `tool`."""
    from pydrake.math import RigidTransform
    from pydrake.multibody.tree import (
        FixedOffsetFrame,
        PrismaticJoint,
        RevoluteJoint,
        SpatialInertia,
        WeldJoint,
    )

    table = read_table(path)
    kinds = {"revolute": RevoluteJoint, "prismatic": PrismaticJoint}
    body = plant.AddRigidBody(BASE, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    for number, (kind, direction, T) in enumerate(table.links()):
        parent, name = body.body_frame(), f"joint_{number}"
        before = plant.AddFrame(FixedOffsetFrame(f"before_{number}", parent, RigidTransform(T)))
        body = plant.AddRigidBody(f"link_{number}", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        if kind in kinds:
            plant.AddJoint(kinds[kind](name, before, body.body_frame(), [0, 0, direction]))
        else:
            plant.AddJoint(WeldJoint(name, before, body.body_frame(), RigidTransform()))
    plant.AddFrame(FixedOffsetFrame(TOOL, body.body_frame(), RigidTransform(table.T_last_tool)))


def toolbox_model(path: str) -> Any:
    """Return a robot of the toolbox: a `DHRobot`, or elementary transforms for beta and fixed rows."""
    from roboticstoolbox import ET, ETS, DHRobot, PrismaticDH, RevoluteDH, Robot
    from spatialmath import SE3

    table = read_table(path)
    if all(row.beta == 0 and row.type != "fixed" for row in table.rows):
        links = [
            RevoluteDH(d=row.d, a=row.a, alpha=row.alpha, offset=row.theta, flip=row.direction < 0)
            if row.type == "revolute"
            else PrismaticDH(theta=row.theta, a=row.a, alpha=row.alpha, offset=row.d, flip=row.direction < 0)
            for row in table.rows
        ]
        return DHRobot(links, base=SE3(table.T_base), tool=SE3(table.T_tool))
    moving = {"revolute": ET.Rz, "prismatic": ET.tz}
    made = ETS()
    for kind, direction, T in table.links():
        made *= ET.SE3(SE3(T))
        made *= moving[kind](flip=direction < 0) if kind in moving else ETS()
    return Robot(made * ET.SE3(SE3(table.T_last_tool)))
