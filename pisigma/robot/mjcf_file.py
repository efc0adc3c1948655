"""Read the kinematics of MJCF files: bodies, and the joints that move them."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from pisigma.files.errors import Phrase, Place, RobotError
from pisigma.files.input_file import read_input
from pisigma.robot.description import Robot
from pisigma.robot.row import Row
from pisigma.robot.urdf_frames import Frame, rotation, translation
from pisigma.robot.urdf_rows import rotation_from_z_to

_TYPES = {"hinge": "revolute", "slide": "prismatic"}
"""Type of the DH row by type of the MJCF joint."""


@dataclass(frozen=True, eq=False)
class MovedBody:
    """Body that a joint of the robot moves.

    Attributes:
        element: the body.
        joint: attributes of the joint, including defaults of its classes.
        name: name of the joint.
        parent_pose: pose of the body's parent in the preceding moved body, or in the base.
        pose: pose of the body in its parent.
        axis_frame: frame of the row's axis in the body: z is the joint's axis, in the direction of the robot's row.
    """

    element: Any
    joint: Mapping[str, str]
    name: str
    parent_pose: Frame
    pose: Frame
    axis_frame: Frame


@dataclass(frozen=True, eq=False)
class MjcfDrawing:
    """A parsed MJCF file.

    Attributes:
        path: the file.
        root: root element of the file.
        compiler: attributes of all `compiler` elements.
        defaults: default attributes of joints by class; "" for joints without a class.
    """

    path: str | os.PathLike[str]
    root: Any
    compiler: Mapping[str, str]
    defaults: Mapping[str, Mapping[str, str]]

    @staticmethod
    def read(path: str | os.PathLike[str]) -> "MjcfDrawing":
        """Parse a file.

        Raises:
            RobotError: the file cannot be read, is not an MJCF file, or includes other files.
        """
        from lxml import etree

        parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False)
        try:
            root = etree.fromstring(read_input(path, RobotError), parser)
        except (etree.XMLSyntaxError, ValueError) as problem:
            line = problem.lineno if isinstance(problem, etree.XMLSyntaxError) else None
            expected = "a complete MJCF file"
            raise RobotError(
                f"the file is truncated or not valid XML: {problem}",
                expected=expected,
                at=Place(path, line),
                option="--like",
            ) from None
        if root.tag != "mujoco":
            expected = "an MJCF file, which starts with <mujoco>, or a .urdf"
            raise RobotError(expected=expected, value=f"<{root.tag}>", at=Place(path), option="--like")
        for element in root.iter("include", "frame", "replicate", "attach"):
            raise RobotError(
                expected="a model of nested bodies in one file",
                value=f"<{element.tag}>",
                at=Place(path, element.sourceline),
                option="--like",
                remedy="save the compiled model with mujoco.mj_saveLastXML and give that file",
            )
        compiler = {key: value for one in root.iter("compiler") for key, value in one.items()}
        defaults: dict[str, Mapping[str, str]] = {"": {}}
        for default in root.iter("default"):
            above = default.getparent()
            base = defaults.get(above.get("class", "") if above.tag == "default" else "", defaults[""])
            top = above.tag != "default"
            here = {
                **base,
                **{key: value for joint in default.findall("joint") for key, value in joint.items()},
            }
            defaults["" if top else default.get("class")] = here
            defaults[default.get("class", "")] = here
        return MjcfDrawing(path, root, compiler, defaults)

    @property
    def angle_unit(self) -> float:
        """Unit of the file's angles [rad]."""
        return 1.0 if self.compiler.get("angle", "degree") == "radian" else math.pi / 180

    def moved_bodies(self, nominal: Robot, tip: str | None) -> list[MovedBody]:
        """Return the bodies that the joints of a robot move, in the order of the joints.

        Raises:
            RobotError: the joints of the file are not those of the robot.
        """
        rows = [row for row in nominal.rows if row.type != "fixed"]
        bodies = [body for body in self.root.iter("body") if body.find("joint") is not None]
        if tip is not None:
            ends = [body for body in self.root.iter("body") if body.get("name") == tip]
            above = {body for end in ends for body in (end, *end.iterancestors("body"))}
            bodies = [body for body in bodies if body in above]
        named = [body for row in rows for body in bodies if body.find("joint").get("name") == row.name]
        bodies = named if len(named) == len(rows) else bodies
        found = [
            self._moved(body, before, row)
            for body, before, row in zip(bodies, [None, *bodies], rows, strict=False)
        ]
        kinds = [_TYPES.get(one.joint.get("type", "hinge"), "") for one in found]
        names = [body.find("joint").get("name") for body in bodies]
        if nominal.coupling is not None or len(bodies) != len(rows) or kinds != [row.type for row in rows]:
            expected = f"the joints {', '.join(row.name for row in rows)}, one in a body and none coupled"
            remedy = "give the MJCF file of this robot; --tip names the body after its last joint"
            raise RobotError(
                expected=expected,
                value=Phrase(", ".join(map(str, names))),
                at=Place(self.path),
                option="--like",
                remedy=remedy,
            )
        return found

    def _moved(self, body: Any, before: Any, row: Row) -> MovedBody:
        joint = self._attributes(body.find("joint"))
        between, parent = np.eye(4), body.getparent()
        while before is not None and parent is not before and parent.tag == "body":
            between, parent = self.pose(parent) @ between, parent.getparent()
        if (
            len(body.findall("joint")) > 1
            or float(joint.get("ref", 0))
            or (before is not None and parent is not before)
        ):
            raise RobotError(
                expected="a chain of nested bodies with one joint each, drawn at joint values of 0",
                value=str(body.get("name")),
                at=Place(self.path, body.sourceline),
                option="--like",
            )
        axis = row.direction * np.array(numbers(joint.get("axis", "0 0 1")))
        place = translation(*numbers(joint.get("pos", "0 0 0")))
        attached = place @ rotation_from_z_to(axis / np.linalg.norm(axis))
        return MovedBody(body, joint, row.name, between, self.pose(body), attached)

    def _attributes(self, joint: Any) -> dict[str, str]:
        """Return the attributes of a joint, including those of its class."""
        classes = [joint.get("class"), *(body.get("childclass") for body in joint.iterancestors("body")), ""]
        return {**self.defaults[next(name for name in classes if name is not None)], **joint.attrib}

    def pose(self, body: Any) -> Frame:
        """Return the pose of a body or site in its parent."""
        T = translation(*numbers(body.get("pos", "0 0 0")))
        if (text := body.get("quat")) is not None:
            T[:3, :3] = _rotation(np.array(numbers(text)))
        elif (text := body.get("euler")) is not None:
            order = self.compiler.get("eulerseq", "xyz")
            turns = [
                rotation("xyz".index(a.lower()), v * self.angle_unit)
                for a, v in zip(order, numbers(text), strict=True)
            ]
            for turn in turns if order.islower() else turns[::-1]:
                T = T @ turn
        elif (text := body.get("axisangle")) is not None:
            *axis, angle = numbers(text)
            half, unit = angle * self.angle_unit / 2, np.array(axis) / np.linalg.norm(axis)
            T[:3, :3] = _rotation(np.array([math.cos(half), *(math.sin(half) * unit)]))
        elif body.get("xyaxes") is not None:
            x, y = np.array(numbers(body.get("xyaxes"))).reshape(2, 3)
            x = x / np.linalg.norm(x)
            y = y - (x @ y) * x
            T[:3, :3] = np.stack([x, y / np.linalg.norm(y), np.cross(x, y / np.linalg.norm(y))], 1)
        elif body.get("zaxis") is not None:
            z = np.array(numbers(body.get("zaxis")))
            z = z / np.linalg.norm(z)
            # Shortest rotation from z to the axis; the quaternion need not have unit length.
            half_turn = (
                np.array([1 + z[2], -z[1], z[0], 0.0]) if z[2] > -1 + 1e-12 else np.array([0.0, 1, 0, 0])
            )
            T[:3, :3] = _rotation(half_turn)
        return T


def _rotation(quaternion: Float64[np.ndarray, " 4"]) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation of a quaternion w, x, y, z of any length; multiples of 90 deg are exact."""
    from scipy.spatial.transform import Rotation

    R: Float64[np.ndarray, "3 3"] = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    return np.where(np.abs(R - R.round()) < 1e-14, R.round(), R)


def numbers(text: str) -> list[float]:
    """Return the numbers in an attribute."""
    return [float(value) for value in text.split()]
