"""The chain of joints between two links of a URDF."""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from pisigma.errors import RobotError, nearest_choice
from pisigma.robot.urdf_file import read_urdf
from pisigma.robot.urdf_frames import Frame, frame_of

UNIT = 1e-2
"""How far the length of an axis may be from 1, as written with few digits."""

_Place = Callable[[str], str]


@dataclass(frozen=True, eq=False)
class ChainJoint:
    """A joint that moves.

    Attributes:
        name: as in the file.
        type: how it moves.
        origin: its frame at rest in the frame behind the joint before (in the base link of the first).
        axis: unit vector in its own frame that it turns about or slides along.
        lower: smallest joint value [rad or m]; -inf of a continuous joint.
        upper: largest joint value [rad or m].
    """

    name: str
    type: Literal["revolute", "prismatic"]
    origin: Frame
    axis: Float64[np.ndarray, " 3"]
    lower: float
    upper: float


@dataclass(frozen=True, eq=False)
class Chain:
    """A serial chain, fixed joints gone into the origins.

    Attributes:
        name: of the robot.
        base: the link that poses are given in.
        tip: the link whose pose is meant.
        joints: those that move, from base to tip.
        end: the tip in the frame behind the last joint.
        source: the file.
    """

    name: str
    base: str
    tip: str
    joints: tuple[ChainJoint, ...]
    end: Frame
    source: str


def read_chain(path: str | os.PathLike[str], base: str | None = None, tip: str | None = None) -> Chain:
    """Read the chain from one link to another.

    Args:
        path: a URDF file.
        base: name of the link where it begins; the root where none is given.
        tip: name of the link where it ends; may be left out where only one link below the base has no child.

    Raises:
        RobotError: the file cannot be used, there is no such link or no way between them, or a joint of the
            chain mimics another, floats, is planar, or lacks its axis or limits.
    """
    urdf, place = read_urdf(path)
    links = list(urdf.link_map)
    _check_tree(urdf, place)
    for option, link in (("base", base), ("tip", tip)):
        if link is not None and link not in urdf.link_map:
            raise RobotError(f"{path}: there is no {option} link '{link}'; {nearest_choice(link, links)}")
    base = base or _root(urdf, str(path))
    tip = tip or _only_tip(urdf, base, str(path))
    origin, joints = np.eye(4), []
    for joint in _way(urdf, base, tip, str(path)):
        origin = origin @ origin_of(joint)
        if joint.type != "fixed":
            joints.append(_moving(joint, origin, place(joint.name)))
            origin = np.eye(4)
    if not joints:
        raise RobotError(
            f"{path}: no joint moves between the links '{base}' and '{tip}'; choose others with base and tip."
        )
    return Chain(urdf.name, base, tip, tuple(joints), origin, str(path))


def _check_tree(urdf: Any, place: _Place) -> None:
    """Refuse joints between links that are not there, and links with two parents."""
    parents: dict[str, str] = {}
    for joint in urdf.joints:
        for part, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in urdf.link_map:
                raise RobotError(
                    f"{place(joint.name)}: the {part} '{link}' of joint '{joint.name}' is no link; "
                    f"{nearest_choice(link, urdf.link_map)}"
                )
        if joint.child in parents:
            raise RobotError(
                f"{place(joint.name)}: the link '{joint.child}' is the child of two joints, "
                f"'{parents[joint.child]}' and '{joint.name}'; a URDF is a tree, remove one."
            )
        parents[joint.child] = joint.name


def _root(urdf: Any, path: str) -> str:
    roots = [link for link in urdf.link_map if link not in urdf.parent_map]
    if len(roots) == 1:
        return str(roots[0])
    if not roots:
        raise RobotError(f"{path}: the joints form a loop; a tree with one root link was wanted.")
    raise RobotError(
        f"{path}: {len(roots)} links have no parent ({', '.join(roots)}); say with base where the chain begins."
    )


def _only_tip(urdf: Any, base: str, path: str) -> str:
    """The one link below the base that has no child."""
    found, open_links, seen = [], [base], {base}
    while open_links:
        link = open_links.pop()
        children = [child for _, child in urdf.child_map.get(link, ()) if child not in seen]
        seen.update(children)
        open_links += children
        if link not in urdf.child_map:
            found.append(link)
    if len(found) == 1:
        return str(found[0])
    names = ", ".join(sorted(found)) or "none"
    raise RobotError(
        f"{path}: below '{base}' the chain has {len(found)} ends ({names}); say with tip which link is meant."
    )


def _way(urdf: Any, base: str, tip: str, path: str) -> list[Any]:
    """The joints from base to tip."""
    way: list[Any] = []
    link = tip
    while link != base:
        if link not in urdf.parent_map or len(way) > len(urdf.joints):
            raise RobotError(f"{path}: the link '{tip}' does not hang on '{base}'; choose other links.")
        name, link = urdf.parent_map[link]
        way.append(urdf.joint_map[name])
    return way[::-1]


def origin_of(joint: Any) -> Frame:
    """Frame of a joint in its parent; `rpy` turns about the fixed x, y and z axes, one after the other."""
    if joint.origin is None:
        return np.eye(4)
    xyz, rpy = joint.origin.xyz or (0.0, 0.0, 0.0), joint.origin.rpy or (0.0, 0.0, 0.0)
    return frame_of([float(value) for value in (*xyz, *rpy[::-1])])


def _moving(joint: Any, origin: Frame, place: str) -> ChainJoint:
    what = f"{place}: joint '{joint.name}'"
    if joint.mimic is not None:
        raise RobotError(
            f"{what} mimics '{joint.mimic.joint}', and a chain of independent joints was wanted; choose base "
            "and tip so that it is not between them, or make it a joint of its own."
        )
    if joint.type in ("floating", "planar"):
        raise RobotError(
            f"{what} is {joint.type}, which no DH row describes; choose base and tip so that it is not between "
            "them, or replace it by revolute and prismatic joints."
        )
    # The format's default axis is x; pytorch-kinematics' own chains take z there.
    axis = np.array((1.0, 0.0, 0.0) if joint.axis is None else joint.axis, dtype=np.float64)
    length = float(np.linalg.norm(axis))
    if abs(length - 1) > UNIT:
        raise RobotError(f"{what} has an axis of length {length:g}; a unit vector such as 0 0 1 was wanted.")
    lower, upper = _limits(joint, what)
    kind: Literal["revolute", "prismatic"] = "prismatic" if joint.type == "prismatic" else "revolute"
    return ChainJoint(joint.name, kind, origin, axis / length, lower, upper)


def _limits(joint: Any, what: str) -> tuple[float, float]:
    if joint.type == "continuous":
        return -math.inf, math.inf
    endless = ", or make it continuous" if joint.type == "revolute" else ""
    if joint.limit is None:
        raise RobotError(f"{what} is {joint.type} and has no <limit>; add lower and upper{endless}.")
    lower, upper = float(joint.limit.lower), float(joint.limit.upper)
    if not lower < upper:
        raise RobotError(
            f"{what}: the lower limit {lower:g} is not below the upper limit {upper:g} (0 where not given); "
            f"correct them{endless}."
        )
    return lower, upper
