"""Staubli's `arm.cfx`: differences of DH parameters with beta, one element `DH` a joint in `dhOffset`."""

from typing import Any

import numpy as np

from pisigma.deployment.export.controllers.controller_file import (
    ControllerFile,
    FileText,
    check_plain_joints,
    frame_sentences,
    untried,
    with_frames,
)
from pisigma.files.errors import RobotError
from pisigma.files.input_file import read_input
from pisigma.robot.description import Robot
from pisigma.robot.row import DH_COLUMNS
from pisigma.robot.writing import comment_text

ARRAY, ELEMENT, NAME = "DhArray", "DH", "dhOffset"
ATTRIBUTES = ("theta", "d", "a", "b", "alpha", "beta")
"""In the order of the maker; degrees and millimetres. b is a shift along y, which is 0 here."""
_FACTORS = np.array([np.pi / 180 if name in ("theta", "alpha", "beta") else 1e-3 for name in DH_COLUMNS])


def write_arm(content: FileText) -> str:
    """The element `dhOffset`, in the controller's own file where one is stated."""
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
    comments = (comment_text(line) for line in (*content.said, *frame_sentences(content.robot)))
    lines = ['<?xml version="1.0" encoding="utf-8"?>', *(f"<!--{line}-->" for line in comments)]
    return "\n".join([*lines, etree.tostring(array, encoding="unicode")]) + "\n"


def read_arm(text: str, source: str, nominal: Robot) -> Robot:
    """The robot that an `arm.cfx` makes of the nominal one.

    Base and tool are those of the comments that pisigma writes, else the nominal robot's.

    Raises:
        RobotError: the file is no XML or holds no `dhOffset` of the robot's joints, or b is not 0.
    """
    check_robot(nominal)
    elements = list(_array(_parse(text.encode(), source), source).iterchildren(ELEMENT))
    if len(elements) != nominal.dof:
        raise RobotError(
            f"{source}: {NAME} has {len(elements)} joints, robot '{nominal.name}' {nominal.dof}."
        )
    dh = nominal.dh.copy()
    for row, element in zip(dh, elements, strict=True):
        values = {name: _number(element, name, source) for name in ATTRIBUTES}
        if values["b"]:
            raise RobotError(
                f"{source}, line {element.sourceline}: b is not 0, which DH + Hayati rows cannot hold."
            )
        row += np.array([values[name] for name in DH_COLUMNS]) * _FACTORS
    return with_frames(nominal.with_geometry(dh=dh), text)


def _parse(content: bytes, source: str) -> Any:
    from lxml import etree

    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False)
    try:
        return etree.fromstring(content, parser)
    except (etree.XMLSyntaxError, ValueError):
        raise RobotError(f"{source}: is no whole XML file; give the controller's arm.cfx.") from None


def _array(root: Any, source: str) -> Any:
    array = next((element for element in root.iter(ARRAY) if element.get("name") == NAME), None)
    if array is None:
        raise RobotError(
            f'{source}: holds no element <{ARRAY} name="{NAME}">; give the controller\'s arm.cfx.'
        )
    return array


def _number(element: Any, name: str, source: str) -> float:
    try:
        value = float(element.get(name, "0"))
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise RobotError(f"{source}, line {element.sourceline}: {name} is no finite number; correct it.")
    return value


def check_robot(robot: Robot) -> None:
    """Refuse robots that have anything but joints in their rows.

    Raises:
        RobotError: there is a fixed row.
    """
    check_plain_joints(robot, "an arm.cfx")


FILE = ControllerFile(
    name="staubli",
    contents="the dhOffset of a Staubli arm.cfx",
    suffixes=(".cfx",),
    source=untried("github.com/ros-industrial/staubli_experimental/issues/35"),
    relies=(
        "The controller adds these differences to its nominal DH parameters, which have to be those of this robot's "
        "description. In which order it multiplies is not published; taken is RotZ(theta) Trans(a, b, d) RotX(alpha) "
        "RotY(beta). Compare the controller's position with pisigma's at several joint values before you use it.",
        "The file holds neither base nor tool: set them on the controller.",
    ),
    text=write_arm,
    read=read_arm,
    check=check_robot,
    options=frozenset(("like",)),
)
FORMAT = FILE.export_format()
