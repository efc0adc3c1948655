"""Staubli's `arm.cfx`: differences of DH parameters including beta, one element `DH` per joint in `dhOffset`."""

from typing import Any

import numpy as np

from pisigma.deployment.export.controllers.controller_file import (
    ControllerFile,
    FileContent,
    check_plain_joints,
    frame_sentences,
    untested_sentence,
    with_frames_from_comments,
)
from pisigma.files.errors import Place, RobotError
from pisigma.files.input_file import read_input
from pisigma.robot.description import Robot
from pisigma.robot.row import DH_COLUMNS
from pisigma.robot.writing import comment_text

ARRAY, ELEMENT, NAME = "DhArray", "DH", "dhOffset"
ATTRIBUTES = ("theta", "d", "a", "b", "alpha", "beta")
"""Keys in the order of the manufacturer, in degrees and millimetres. b is a shift along y, which is 0 here."""
_FACTORS = np.array([np.pi / 180 if name in ("theta", "alpha", "beta") else 1e-3 for name in DH_COLUMNS])


def write_arm(content: FileContent) -> str:
    """Return the element `dhOffset`, inside the controller's file if one is given."""
    from lxml import etree

    difference = (content.robot.dh - content.nominal.dh) / _FACTORS
    array = etree.Element(ARRAY, name=NAME)
    for index, values in enumerate(difference.tolist()):
        stated = dict(zip(DH_COLUMNS, values, strict=True)) | {"b": 0.0}
        etree.SubElement(
            array, ELEMENT, index=str(index), **{name: repr(stated[name]) for name in ATTRIBUTES}
        )
    etree.indent(array)
    if content.request.like is not None:
        source = str(content.request.like)
        root = _parse(read_input(source, RobotError), source)
        before = _array(root, source)
        array.tail = before.tail
        before.getparent().replace(before, array)
        array = root
    comments = (comment_text(line) for line in (*content.comments, *frame_sentences(content.robot)))
    lines = ['<?xml version="1.0" encoding="utf-8"?>', *(f"<!--{line}-->" for line in comments)]
    return "\n".join([*lines, etree.tostring(array, encoding="unicode")]) + "\n"


def read_arm(text: str, source: str, nominal: Robot) -> Robot:
    """Apply an `arm.cfx` to the nominal robot.

    Base and tool come from the comments that pisigma writes, or else from the nominal robot.

    Raises:
        RobotError: the file is not XML or has no `dhOffset` for the robot's joints, or b is not 0.
    """
    check_robot(nominal)
    elements = list(_array(_parse(text.encode(), source), source).iterchildren(ELEMENT))
    if len(elements) != nominal.dof:
        raise RobotError(
            f"expected {nominal.dof} joints of robot '{nominal.name}' in {NAME}, got {len(elements)}",
            expected=f"{nominal.dof} joints",
            value=len(elements),
            at=Place(source),
        )
    dh = nominal.dh.copy()
    for row, element in zip(dh, elements, strict=True):
        values = {name: _number(element, name, source) for name in ATTRIBUTES}
        if values["b"]:
            raise RobotError(
                "expected b = 0, because DH + Hayati rows have no such parameter",
                expected="0",
                value=values["b"],
                at=Place(source, element.sourceline, "b"),
            )
        row += np.array([values[name] for name in DH_COLUMNS]) * _FACTORS
    return with_frames_from_comments(nominal.with_geometry(dh=dh), text)


def _parse(content: bytes, source: str) -> Any:
    from lxml import etree

    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False)
    try:
        return etree.fromstring(content, parser)
    except (etree.XMLSyntaxError, ValueError):
        raise RobotError(
            expected="a complete XML file", at=Place(source), remedy="give the controller's arm.cfx"
        ) from None


def _array(root: Any, source: str) -> Any:
    array = next((element for element in root.iter(ARRAY) if element.get("name") == NAME), None)
    if array is None:
        raise RobotError(
            expected=f'an element <{ARRAY} name="{NAME}">',
            at=Place(source),
            remedy="give the controller's arm.cfx",
        )
    return array


def _number(element: Any, name: str, source: str) -> float:
    try:
        value = float(element.get(name, "0"))
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise RobotError(
            expected="a finite number", value=element.get(name), at=Place(source, element.sourceline, name)
        )
    return value


def check_robot(robot: Robot) -> None:
    """Raise an error for robots with rows that are not joints.

    Raises:
        RobotError: there is a fixed row.
    """
    check_plain_joints(robot, "an arm.cfx")


FILE = ControllerFile(
    name="staubli",
    contents="the dhOffset of a Staubli arm.cfx",
    suffixes=(".cfx",),
    source=untested_sentence("github.com/ros-industrial/staubli_experimental/issues/35"),
    requirements=(
        "The controller adds these differences to its nominal DH parameters, which have to be those of this robot's "
        "description. Its order of multiplication is not published; RotZ(theta) Trans(a, b, d) RotX(alpha) RotY(beta) "
        "is assumed. Compare the controller's position with that of pisigma at several joint values before you use it.",
        "The file includes neither base nor tool: set them on the controller.",
    ),
    text=write_arm,
    read=read_arm,
    check=check_robot,
    options=frozenset(("like",)),
)
FORMAT = FILE.export_format()
