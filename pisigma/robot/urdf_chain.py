"""Read the chain of joints between two links of a URDF file."""

import math
import os
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from pisigma.files.errors import Place, RobotError, choice_remedy, make_printable
from pisigma.robot.urdf_file import parse_xml, read_urdf
from pisigma.robot.urdf_frames import Frame, frame_of

_AXIS_LENGTH_TOLERANCE = 1e-2
"""Largest deviation of an axis from unit length, because files state axes with few digits."""


@dataclass(frozen=True, eq=False)
class ChainJoint:
    """A moving joint of a chain.

    Attributes:
        name: name of the joint in the file.
        type: "revolute" (also for a continuous joint) or "prismatic".
        origin: frame of the joint at joint value 0, in the frame of the preceding joint, or in the base link for the
            first joint.
        axis: unit vector of the joint axis in the joint's frame.
        lower: smallest joint value [rad or m]; -inf for a continuous joint or one that mimics another.
        upper: largest joint value [rad or m].
        mimic: name of the mimicked joint, multiplier [rad or m per rad or m] and offset [rad or m]; None for a
            commanded joint.
    """

    name: str
    type: Literal["revolute", "prismatic"]
    origin: Frame
    axis: Float64[np.ndarray, " 3"]
    lower: float
    upper: float
    mimic: tuple[str, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Chain:
    """A serial chain, with fixed joints merged into the origins.

    Attributes:
        name: name of the robot.
        base: base link; poses are in its frame.
        tip: link whose pose is computed.
        joints: joints that move, from base to tip.
        end: pose of the tip in the frame of the last joint.
        source: path of the file.
        content: content of the file with its xacro properties expanded; None if there is no file.
    """

    name: str
    base: str
    tip: str
    joints: tuple[ChainJoint, ...]
    end: Frame
    source: str
    content: bytes | None = None


def read_chain(path: str | os.PathLike[str], base: str | None = None, tip: str | None = None) -> Chain:
    """Read the chain from one link to another.

    Args:
        path: a URDF file.
        base: first link of the chain; None for the root.
        tip: last link of the chain; None if only one link below the base has no child.

    Raises:
        RobotError: the file cannot be used, a link does not exist, the links are not connected, or a joint of the chain
            mimics a joint outside the chain, is floating or planar, or lacks its axis or limits.
    """
    from lxml import etree

    root = parse_xml(path, keep_comments=True)
    urdf, place = read_urdf(path, root)
    links = list(urdf.link_map)
    _check_tree(urdf, place)
    for option, link in (("base", base), ("tip", tip)):
        if link is not None and link not in urdf.link_map:
            problem, hint = f"there is no {option} link '{link}'", choice_remedy(link, links)
            raise RobotError(problem, value=link, option=option, at=Place(path), remedy=hint)
    base = base or _root(urdf, Place(path))
    tip = tip or _only_tip(urdf, base, Place(path))
    origin, joints, between = np.eye(4), [], _joints_between(urdf, base, tip, Place(path))
    commanded = {joint.name for joint in between if joint.type != "fixed" and joint.mimic is None}
    for joint in between:
        origin = origin @ origin_of(joint)
        if joint.type != "fixed":
            joints.append(_moving(joint, origin, place(joint.name), commanded))
            origin = np.eye(4)
    if not joints:
        raise RobotError(
            f"there is no moving joint between the links '{base}' and '{tip}'",
            expected="a joint that moves",
            at=Place(path),
            remedy="choose another base or tip",
        )
    content = etree.tostring(root.getroottree(), xml_declaration=True, encoding="UTF-8")
    return Chain(urdf.name, base, tip, tuple(joints), origin, make_printable(str(path), cut=False), content)


def _check_tree(urdf: Any, place: Callable[[str], Place]) -> None:
    """Check that joints connect existing links, and that no link has two parents."""
    parents: dict[str, str] = {}
    for joint in urdf.joints:
        for part, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in urdf.link_map:
                problem = f"the {part} of joint '{joint.name}' is '{link}', which is not a link"
                hint = choice_remedy(link, urdf.link_map)
                raise RobotError(problem, value=link, at=place(joint.name), remedy=hint)
        if joint.child in parents:
            raise RobotError(
                f"the link '{joint.child}' is the child of two joints, "
                f"'{parents[joint.child]}' and '{joint.name}', but a URDF is a tree",
                value=joint.child,
                at=place(joint.name),
                remedy="remove one of the joints",
            )
        parents[joint.child] = joint.name


def _root(urdf: Any, at: Place) -> str:
    """Return the only link without a parent.

    Raises:
        RobotError: no link, or more than one, has no parent.
    """
    roots = [link for link in urdf.link_map if link not in urdf.parent_map]
    if len(roots) == 1:
        return str(roots[0])
    expected = "a tree with one root link"
    if not roots:
        raise RobotError(
            f"expected {expected}, but the joints form a loop", expected=expected, value=0, at=at
        )
    problem = f"{len(roots)} links have no parent: {', '.join(roots)}"
    remedy = "state the first link of the chain as base"
    raise RobotError(problem, expected=expected, value=len(roots), at=at, remedy=remedy)


def _only_tip(urdf: Any, base: str, at: Place) -> str:
    """Return the only link below the base that has no child.

    Raises:
        RobotError: more than one link below the base has no child.
    """
    ends, open_links, passed = [], [base], {base}
    while open_links:
        link = open_links.pop()
        children = [child for _, child in urdf.child_map.get(link, ()) if child not in passed]
        passed.update(children)
        open_links += children
        if link not in urdf.child_map:
            ends.append(link)
    if len(ends) == 1:
        return str(ends[0])
    names = ", ".join(sorted(ends)) or "none"
    problem, remedy = (
        f"the chain below '{base}' has {len(ends)} ends: {names}",
        "state the last link of the chain as tip",
    )
    raise RobotError(problem, expected="one end", value=len(ends), at=at, remedy=remedy)


def _joints_between(urdf: Any, base: str, tip: str, at: Place) -> list[Any]:
    """Return the joints from base to tip.

    Raises:
        RobotError: the tip is not below the base.
    """
    joints: list[Any] = []
    link = tip
    while link != base:
        if link not in urdf.parent_map or len(joints) > len(urdf.joints):
            problem = f"the link '{tip}' is not below '{base}'"
            raise RobotError(problem, value=tip, at=at, remedy="choose another base or tip")
        name, link = urdf.parent_map[link]
        joints.append(urdf.joint_map[name])
    return joints[::-1]


def origin_of(joint: Any) -> Frame:
    """Return the frame of a joint in its parent; `rpy` are rotations about the fixed x, y and z axes in order."""
    if joint.origin is None:
        return np.eye(4)
    xyz, rpy = joint.origin.xyz or (0.0, 0.0, 0.0), joint.origin.rpy or (0.0, 0.0, 0.0)
    return frame_of([float(value) for value in (*xyz, *rpy[::-1])])


def _moving(joint: Any, origin: Frame, at: Place, commanded: Collection[str]) -> ChainJoint:
    """Convert a moving joint of the URDF file to a `ChainJoint`.

    Raises:
        RobotError: the joint mimics one outside the chain, or has an unsupported type, an invalid axis or invalid
            limits.
    """
    if joint.mimic is not None and joint.mimic.joint not in commanded:
        raise RobotError(
            f"joint '{joint.name}' mimics '{joint.mimic.joint}', which is not a commanded joint of the chain",
            expected="a commanded joint of the chain",
            value=joint.mimic.joint,
            at=at,
            remedy="choose base and tip so that both joints or neither are between them, or remove the mimic",
        )
    if joint.type in ("floating", "planar"):
        raise RobotError(
            f"joint '{joint.name}' is {joint.type}, which DH rows cannot describe",
            expected="a revolute or prismatic joint",
            value=joint.type,
            at=at,
            remedy="choose base and tip so that it is not between them, or replace it with revolute and prismatic "
            "ones",
        )
    # URDF's default axis is x; pytorch-kinematics' own chains use z.
    axis = np.array((1.0, 0.0, 0.0) if joint.axis is None else joint.axis, dtype=np.float64)
    length = float(np.linalg.norm(axis))
    if abs(length - 1) > _AXIS_LENGTH_TOLERANCE:
        expected = "a unit vector such as 0 0 1"
        problem = f"joint '{joint.name}': expected {expected} as the axis, got a vector of length {length:g}"
        raise RobotError(problem, expected=expected, value=length, at=at)
    kind: Literal["revolute", "prismatic"] = "prismatic" if joint.type == "prismatic" else "revolute"
    if joint.mimic is None:
        return ChainJoint(joint.name, kind, origin, axis / length, *_limits(joint, at))
    multiplier, offset = joint.mimic.multiplier, joint.mimic.offset or 0.0
    mimic = joint.mimic.joint, 1.0 if multiplier is None else float(multiplier), float(offset)
    return ChainJoint(joint.name, kind, origin, axis / length, -math.inf, math.inf, mimic)


def _limits(joint: Any, at: Place) -> tuple[float, float]:
    """Return the limits of a joint [rad or m].

    Raises:
        RobotError: the joint lacks limits, or the lower one is not below the upper one.
    """
    if joint.type == "continuous":
        return -math.inf, math.inf
    alternative = ", or make it continuous" if joint.type == "revolute" else ""
    if joint.limit is None:
        problem, remedy = f"joint '{joint.name}' is {joint.type} but has no <limit>", "add lower and upper"
        raise RobotError(problem, expected="<limit>", at=at, remedy=f"{remedy}{alternative}")
    lower, upper = float(joint.limit.lower), float(joint.limit.upper)
    if not lower < upper:
        raise RobotError(
            f"joint '{joint.name}': the lower limit {lower:g} is not below the upper limit {upper:g}",
            expected="a lower limit below the upper limit",
            value=(lower, upper),
            at=at,
            remedy=f"state both limits, whose default is 0{alternative}",
        )
    return lower, upper
