"""Reading the XML of a URDF file: only what kinematics needs, checked, and then parsed.

Meshes, inertias, materials, transmissions and simulator tags are not looked at.
"""

import math
import os
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pisigma.errors import RobotError, nearest_choice

JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")

_KEPT = {"origin": ("xyz", "rpy"), "axis": ("xyz",), "parent": ("link",), "child": ("link",)}
_KEPT |= {"limit": ("lower", "upper"), "mimic": ("joint",)}
_VECTORS = {("origin", "xyz"), ("origin", "rpy"), ("axis", "xyz")}


def read_urdf(path: str | os.PathLike[str]) -> tuple[Any, Callable[[str], str]]:
    """Read a URDF file.

    Returns:
        The robot as pytorch-kinematics' URDF parser gives it, of links and joints only; and a function that
        says where a joint stands in the file, for complaints.

    Raises:
        RobotError: the file cannot be read, is no XML, truncated, xacro or no URDF, or a part of it is
            missing, stands twice or is no number; the message names file and line.
    """
    from lxml import etree

    root = parse_xml(path)
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

    try:
        content = Path(path).read_bytes()
    except OSError as problem:
        raise RobotError(f"{path}: cannot be read ({problem.strerror}); check the path.") from None
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
    if any("xacro" in str(element.tag) for element in root.iter()):
        raise _is_xacro(path)
    if etree.QName(root).localname != "robot":
        raise RobotError(f"{path}: the root is <{root.tag}>; a URDF starts with <robot name=...>.")
    return root


def _is_xacro(path: str | os.PathLike[str]) -> RobotError:
    return RobotError(
        f"{path}: is xacro, which is not read; expand it first (`xacro {Path(path).name} > robot.urdf`)."
    )


def _copy_joint(element: Any, copied: Any, source: str) -> None:
    """Copy of a joint what kinematics needs, checked."""
    from lxml import etree

    name = element.get("name")
    place = f"{source}, line {element.sourceline}: joint '{name}'"
    given = element.get("type")
    if given not in JOINT_TYPES:
        raise RobotError(f"{place}: the type cannot be '{given}'; {nearest_choice(given or '', JOINT_TYPES)}")
    copied.set("type", given)
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
    if tag not in ("origin", "axis", "limit"):
        return
    count = 3 if (tag, key) in _VECTORS else 1
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(math.isfinite(number) for number in numbers):
        wanted = "three finite numbers with spaces between" if count == 3 else "a finite number"
        raise RobotError(f'{place}: {key}="{text}" of <{tag}> is not {wanted}; correct it.')


def _parse_urdf(reduced: Any) -> Any:
    """The links and joints through pytorch-kinematics' URDF parser."""
    from lxml import etree

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the import, nothing that a user could mend
        from pytorch_kinematics.urdf_parser_py.urdf import URDF
    return URDF.from_xml_string(etree.tostring(reduced))
