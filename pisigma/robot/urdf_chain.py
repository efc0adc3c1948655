"""The chain of joints between two links of a URDF file; of the file only what kinematics needs is looked at."""

import math
import os
import re
import warnings
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from pisigma.files.errors import RobotError, nearest_choice, printable
from pisigma.files.input_file import read_input
from pisigma.robot.row import LARGEST
from pisigma.robot.urdf_frames import Frame, frame_of

JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")

MOST_ELEMENTS = 10_000
"""Links and joints of a file; a whole cell has some hundreds."""

_KEPT = {"origin": ("xyz", "rpy"), "axis": ("xyz",), "parent": ("link",), "child": ("link",)}
_KEPT |= {"limit": ("lower", "upper"), "mimic": ("joint", "multiplier", "offset")}
_VECTORS = {("origin", "xyz"), ("origin", "rpy"), ("axis", "xyz")}


def read_urdf(path: str | os.PathLike[str], root: Any = None) -> tuple[Any, Callable[[str], str]]:
    """Read a URDF file.

    Args:
        path: the file.
        root: of its XML where that was read already; see `parse_xml`.

    Returns:
        The robot as pytorch-kinematics' URDF parser gives it, of links and joints only; and a function that
        says where a joint stands in the file, for complaints.

    Raises:
        RobotError: the file cannot be read, is no XML, truncated, xacro or no URDF, or a part of it is
            missing, stands twice or is no number; the message names file and line.
    """
    from lxml import etree

    root = parse_xml(path) if root is None else root
    reduced = etree.Element("robot", name=root.get("name") or Path(path).stem)
    lines: dict[tuple[str, str], int] = {}
    for element in root.iterchildren("{*}link", "{*}joint"):
        kind = etree.QName(element).localname
        name = element.get("name")
        if not name:
            raise RobotError(f"{path}, line {element.sourceline}: a {kind} has no name; give it one.")
        if (kind, name) in lines:
            raise RobotError(
                f"{path}, line {element.sourceline}: the {kind} '{name}' stands twice, first in line "
                f"{lines[kind, name]}; names must differ."
            )
        lines[kind, name] = element.sourceline
        if len(lines) > MOST_ELEMENTS:
            raise RobotError(
                f"{path}: holds more than {MOST_ELEMENTS:,} links and joints; fewer were wanted."
            )
        copied = etree.SubElement(reduced, kind, name=name)
        if kind == "joint":
            _copy_joint(element, copied, str(path))
    if not any(kind == "link" for kind, _ in lines):
        raise RobotError(f"{path}: holds no link; a URDF with links and joints was wanted.")
    return _parse_urdf(reduced), lambda joint: f"{path}, line {lines['joint', joint]}"


def parse_xml(path: str | os.PathLike[str], everything: bool = False) -> Any:
    """The root of the XML, which is `robot`, as lxml has it.

    Args:
        path: the file.
        everything: whether comments and processing instructions are wanted too.

    Raises:
        RobotError: see `read_urdf`.
    """
    from lxml import etree

    content = read_input(path, RobotError)
    gone = {"remove_comments": not everything, "remove_pis": not everything}
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, **gone)
    try:
        root = etree.fromstring(content, parser)
    except (etree.XMLSyntaxError, ValueError) as problem:
        if re.search(rb"<\s*xacro:", content):
            raise _is_xacro(path) from None
        line = f", line {problem.lineno}" if isinstance(problem, etree.XMLSyntaxError) else ""
        what = re.sub(r", line \d+, column \d+.*", "", " ".join(str(problem).split())) or "it is empty"
        raise RobotError(
            f"{path}{line}: is truncated or no XML ({what}); a whole URDF file was wanted."
        ) from None
    if any(_is_of_xacro(element) for element in root.iter()):
        _insert_properties(root, path)
    if etree.QName(root).localname != "robot":
        raise RobotError(f"{path}: the root is <{root.tag}>; a URDF starts with <robot name=...>.")
    return root


XACRO = "http://www.ros.org/wiki/xacro"


def _is_of_xacro(element: Any) -> bool:
    return "xacro" in str(element.tag)


def _insert_properties(root: Any, path: str | os.PathLike[str]) -> None:
    """Put the values of xacro's plain properties where they are named, as in files of `pisigma export`."""
    from lxml import etree

    values: dict[str, str] = {}
    for element in filter(_is_of_xacro, list(root.iter())):
        if etree.QName(element).localname != "property" or set(element.attrib) != {"name", "value"}:
            raise _is_xacro(path)
        values[element.get("name")] = element.get("value")
        element.getparent().remove(element)
    for element in root.iter():
        for key, text in element.attrib.items():
            filled = re.sub(r"\$\{(\w+)\}", lambda name: values.get(name[1], name[0]), text)
            if "$" in filled:
                raise _is_xacro(path)
            element.set(key, filled)


def _is_xacro(path: str | os.PathLike[str]) -> RobotError:
    return RobotError(
        f"{path}: is xacro, which is not read; expand it first (`xacro {Path(path).name} > robot.urdf`)."
    )


def _copy_joint(element: Any, copied: Any, source: str) -> None:
    """Copy of a joint what kinematics needs, checked."""
    from lxml import etree

    name = element.get("name")
    place = f"{source}, line {element.sourceline}: joint '{name}'"
    kind = element.get("type")
    if kind not in JOINT_TYPES:
        raise RobotError(f"{place}: the type cannot be '{kind}'; {nearest_choice(kind or '', JOINT_TYPES)}")
    copied.set("type", kind)
    for child in element.iterchildren(*(f"{{*}}{tag}" for tag in _KEPT)):
        tag = etree.QName(child).localname
        if copied.find(tag) is not None:
            raise RobotError(f"{place}: has <{tag}> twice; remove one.")
        part = etree.SubElement(copied, tag)
        for key in _KEPT[tag]:
            if child.get(key) is not None:
                _check_value(child, tag, key, f"{source}, line {child.sourceline}: joint '{name}'")
                part.set(key, child.get(key))
    for tag in ("parent", "child"):
        part = copied.find(tag)
        if part is None or not part.get("link"):
            raise RobotError(f'{place}: <{tag} link="..."/> is missing; name the {tag} link.')
    for tag, key in (("axis", "xyz"), ("mimic", "joint")):
        part = copied.find(tag)
        if part is not None and part.get(key) is None:
            raise RobotError(f'{place}: <{tag}> lacks {key}="..."; add it.')
    limit = copied.find("limit")
    if limit is not None:  # the parser wants two more, which no kinematics needs
        limit.set("effort", "0")
        limit.set("velocity", "0")


def _check_value(element: Any, tag: str, key: str, place: str) -> None:
    """Refuse what is no number, or not three of them where a vector is wanted."""
    text = element.get(key)
    if tag not in ("origin", "axis", "limit", "mimic") or key == "joint":
        return
    count = 3 if (tag, key) in _VECTORS else 1
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    most = LARGEST**2 if tag == "limit" else LARGEST / 1e3  # some write 1e16 for no limit
    if len(numbers) != count or not all(abs(number) <= most for number in numbers):
        wanted = "three finite numbers with spaces between" if count == 3 else "a finite number"
        raise RobotError(
            f'{place}: {key}="{text}" of <{tag}> is not {wanted}, {most:.0e} at most; correct it.'
        )


def _parse_urdf(reduced: Any) -> Any:
    """The links and joints through pytorch-kinematics' URDF parser."""
    from lxml import etree

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the import, nothing that a user could mend
        from pytorch_kinematics.urdf_parser_py.urdf import URDF
    return URDF.from_xml_string(etree.tostring(reduced))


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
        lower: smallest joint value [rad or m]; -inf of a continuous joint, and of one that mimics another.
        upper: largest joint value [rad or m].
        mimic: the joint that it mimics, by how many [rad or m] it moves per [rad or m] of that one, and where it stands
            at 0 of that one; None where it is commanded.
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
    """A serial chain, fixed joints gone into the origins.

    Attributes:
        name: of the robot.
        base: the link that poses are given in.
        tip: the link whose pose is meant.
        joints: those that move, from base to tip.
        end: the tip in the frame behind the last joint.
        source: the file.
        content: of the file, with the values of its properties; None where it is of none.
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
        base: name of the link where it begins; the root where none is given.
        tip: name of the link where it ends; may be left out where only one link below the base has no child.

    Raises:
        RobotError: the file cannot be used, there is no such link or no way between them, or a joint of the
            chain mimics one outside of it, floats, is planar, or lacks its axis or limits.
    """
    from lxml import etree

    root = parse_xml(path, everything=True)
    urdf, place = read_urdf(path, root)
    links = list(urdf.link_map)
    _check_tree(urdf, place)
    for option, link in (("base", base), ("tip", tip)):
        if link is not None and link not in urdf.link_map:
            raise RobotError(f"{path}: there is no {option} link '{link}'; {nearest_choice(link, links)}")
    base = base or _root(urdf, str(path))
    tip = tip or _only_tip(urdf, base, str(path))
    origin, joints, way = np.eye(4), [], _way(urdf, base, tip, str(path))
    commanded = {joint.name for joint in way if joint.type != "fixed" and joint.mimic is None}
    for joint in way:
        origin = origin @ origin_of(joint)
        if joint.type != "fixed":
            joints.append(_moving(joint, origin, place(joint.name), commanded))
            origin = np.eye(4)
    if not joints:
        raise RobotError(
            f"{path}: no joint moves between the links '{base}' and '{tip}'; choose others with base and tip."
        )
    content = etree.tostring(root.getroottree(), xml_declaration=True, encoding="UTF-8")
    return Chain(urdf.name, base, tip, tuple(joints), origin, printable(str(path), cut=False), content)


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
    raise RobotError(
        f"{path}: below '{base}' the chain has {len(ends)} ends ({names}); say with tip which link is meant."
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


def _moving(joint: Any, origin: Frame, place: str, commanded: Collection[str]) -> ChainJoint:
    what = f"{place}: joint '{joint.name}'"
    if joint.mimic is not None and joint.mimic.joint not in commanded:
        raise RobotError(
            f"{what} mimics '{joint.mimic.joint}', which is no commanded joint of the chain; choose base and tip so "
            "that both are between them, or none, or make it a joint of its own."
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
    kind: Literal["revolute", "prismatic"] = "prismatic" if joint.type == "prismatic" else "revolute"
    if joint.mimic is None:
        return ChainJoint(joint.name, kind, origin, axis / length, *_limits(joint, what))
    multiplier, offset = joint.mimic.multiplier, joint.mimic.offset or 0.0
    mimic = joint.mimic.joint, 1.0 if multiplier is None else float(multiplier), float(offset)
    return ChainJoint(joint.name, kind, origin, axis / length, -math.inf, math.inf, mimic)


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
