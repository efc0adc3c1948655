"""Parse the XML of URDF files and check the parts that affect kinematics; other parts are ignored."""

import os
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pisigma.files.errors import Place, RobotError, choice_remedy
from pisigma.files.input_file import read_input
from pisigma.robot.row import MAX_MAGNITUDE

_JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")

_MAX_ELEMENTS = 10_000
"""Largest number of links and joints in a file; a whole cell has a few hundred."""

_KEPT = {"origin": ("xyz", "rpy"), "axis": ("xyz",), "parent": ("link",), "child": ("link",)}
_KEPT |= {"limit": ("lower", "upper"), "mimic": ("joint", "multiplier", "offset")}
_VECTORS = {("origin", "xyz"), ("origin", "rpy"), ("axis", "xyz")}


def read_urdf(path: str | os.PathLike[str], root_element: Any = None) -> tuple[Any, Callable[[str], Place]]:
    """Read a URDF file.

    Args:
        path: the file.
        root_element: root element if the XML has already been parsed; see `parse_xml`.

    Returns:
        The robot of pytorch-kinematics' URDF parser, with links and joints only, and a function that returns the place
        of a joint in the file.

    Raises:
        RobotError: the file cannot be read, is not valid XML, is truncated, is xacro or not URDF, or an element is
            missing, duplicated or not a number; the exception states file and line.
    """
    from lxml import etree

    root_element = parse_xml(path) if root_element is None else root_element
    reduced = etree.Element("robot", name=root_element.get("name") or Path(path).stem)
    lines: dict[tuple[str, str], int] = {}
    for element in root_element.iterchildren("{*}link", "{*}joint"):
        kind = etree.QName(element).localname
        name = element.get("name")
        if not name:
            at = Place(path, element.sourceline)
            raise RobotError(f"a {kind} has no name", expected="a name", at=at, remedy="give it one")
        if (kind, name) in lines:
            raise RobotError(
                f"the {kind} '{name}' appears twice, first in line {lines[kind, name]}",
                value=name,
                at=Place(path, element.sourceline),
                remedy="use different names",
            )
        lines[kind, name] = element.sourceline
        if len(lines) > _MAX_ELEMENTS:
            expected = f"at most {_MAX_ELEMENTS:,} links and joints"
            raise RobotError(f"expected {expected}", expected=expected, at=Place(path))
        copied = etree.SubElement(reduced, kind, name=name)
        if kind == "joint":
            _copy_joint(element, copied, path)
    if not any(kind == "link" for kind, _ in lines):
        expected = "a URDF with links and joints"
        raise RobotError(f"expected {expected}, got no link", expected=expected, at=Place(path))
    return _parse_urdf(reduced), lambda joint: Place(path, lines["joint", joint])


def parse_xml(path: str | os.PathLike[str], keep_comments: bool = False) -> Any:
    """Parse a URDF file with lxml, and return its root element `robot`.

    Args:
        path: the file.
        keep_comments: whether to keep comments and processing instructions.

    Raises:
        RobotError: see `read_urdf`.
    """
    from lxml import etree

    content = read_input(path, RobotError)
    removed = {"remove_comments": not keep_comments, "remove_pis": not keep_comments}
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, **removed)
    try:
        root = etree.fromstring(content, parser)
    except (etree.XMLSyntaxError, ValueError) as problem:
        if re.search(rb"<\s*xacro:", content):
            raise _is_xacro(path) from None
        line = problem.lineno if isinstance(problem, etree.XMLSyntaxError) else None
        what = re.sub(r", line \d+, column \d+.*", "", " ".join(str(problem).split())) or "it is empty"
        what = f"the file is truncated or not valid XML: {what}"
        raise RobotError(what, expected="a complete URDF file", at=Place(path, line)) from None
    if any(_is_of_xacro(element) for element in root.iter()):
        _insert_properties(root, path)
    if etree.QName(root).localname != "robot":
        what = f"expected a URDF file, which starts with <robot name=...>, got <{root.tag}>"
        raise RobotError(what, expected="a URDF file", value=root.tag, at=Place(path))
    return root


XACRO = "http://www.ros.org/wiki/xacro"


def _is_of_xacro(element: Any) -> bool:
    return "xacro" in str(element.tag)


def _insert_properties(root: Any, path: str | os.PathLike[str]) -> None:
    """Replace references to plain xacro properties, as used in files of `pisigma export`, with their values."""
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
        "the file is a xacro file, which is not supported",
        expected="a URDF file",
        value="xacro",
        at=Place(path),
        remedy=f"expand it first (`xacro {Path(path).name} > robot.urdf`)",
    )


def _copy_joint(element: Any, copied: Any, path: str | os.PathLike[str]) -> None:
    """Copy the parts of a joint that affect kinematics, and check them."""
    from lxml import etree

    name = element.get("name")
    at = Place(path, element.sourceline)
    kind = element.get("type")
    if kind not in _JOINT_TYPES:
        hint = choice_remedy(kind or "", _JOINT_TYPES)
        raise RobotError(f"joint '{name}': unknown type '{kind}'", value=kind, at=at, remedy=hint)
    copied.set("type", kind)
    for child in element.iterchildren(*(f"{{*}}{tag}" for tag in _KEPT)):
        tag = etree.QName(child).localname
        if copied.find(tag) is not None:
            problem = f"joint '{name}': <{tag}> appears twice"
            raise RobotError(problem, value=tag, at=at, remedy="remove one of them")
        part = etree.SubElement(copied, tag)
        for key in _KEPT[tag]:
            if child.get(key) is not None:
                _check_value(child, tag, key, f"joint '{name}'", Place(path, child.sourceline))
                part.set(key, child.get(key))
    for tag in ("parent", "child"):
        part = copied.find(tag)
        if part is None or not part.get("link"):
            problem, remedy = f"joint '{name}' has no <{tag} link=\"...\"/>", f"name the {tag} link"
            raise RobotError(problem, expected=f"<{tag}>", at=at, remedy=remedy)
    for tag, key in (("axis", "xyz"), ("mimic", "joint")):
        part = copied.find(tag)
        if part is not None and part.get(key) is None:
            problem = f"joint '{name}': <{tag}> has no attribute {key}"
            raise RobotError(problem, expected=f"<{tag} {key}>", at=at, remedy="add it")
    limit = copied.find("limit")
    if limit is not None:  # the parser requires effort and velocity, which kinematics does not need
        limit.set("effort", "0")
        limit.set("velocity", "0")


def _check_value(element: Any, tag: str, key: str, joint: str, at: Place) -> None:
    """Check that an attribute is a finite number, or three of them if it is a vector."""
    text = element.get(key)
    if tag not in ("origin", "axis", "limit", "mimic") or key == "joint":
        return
    count = 3 if (tag, key) in _VECTORS else 1
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    # some files use 1e16 to state that there is no limit
    largest = MAX_MAGNITUDE**2 if tag == "limit" else MAX_MAGNITUDE / 1e3
    if len(numbers) != count or not all(abs(number) <= largest for number in numbers):
        expected = "three finite numbers separated by spaces" if count == 3 else "a finite number"
        expected += f" up to {largest:.0e}"
        problem = f'{joint}: expected {expected} in <{tag} {key}>, got "{text}"'
        raise RobotError(problem, expected=expected, value=text, at=at)


def _parse_urdf(reduced: Any) -> Any:
    """Read links and joints with pytorch-kinematics' URDF parser."""
    from lxml import etree

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # users cannot act on the warnings of this import
        from pytorch_kinematics.urdf_parser_py.urdf import URDF
    return URDF.from_xml_string(etree.tostring(reduced))
