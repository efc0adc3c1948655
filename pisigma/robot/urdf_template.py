"""A calibrated robot put into the URDF file that it was drawn in: only origins change."""

import os
from typing import Any

import numpy as np

from pisigma.errors import RobotError
from pisigma.robot.description import Robot
from pisigma.robot.urdf_chain import Chain, origin_of, read_chain
from pisigma.robot.urdf_file import parse_xml, read_urdf
from pisigma.robot.urdf_frames import Frame, frame_of, inverse, row_frame
from pisigma.robot.urdf_rows import ChainRows, rows_of_chain
from pisigma.robot.urdf_writing import comment_text, origin_attributes, unused_name

FRAME_LINK = "calibrated_frame"
TOOL_LINK = "calibrated_tool"
SAME = 1e-9
"""Largest difference [m or rad] of rows that are taken for those of the file."""


def robot_into_urdf(
    calibrated: Robot,
    nominal: Robot,
    path: str | os.PathLike[str],
    tip: str | None = None,
    comments: tuple[str, ...] = (),
) -> str:
    """The file with the origins of a calibrated robot; links, meshes, limits and all else stay.

    Every joint after the first stands in the link before it where the calibration has it. Links keep their
    places at the joints that carry them, so meshes still fit. Two links are added: `calibrated_frame`, the
    parent of the root, is the frame that the model's poses are given in, and `calibrated_tool`, a child of the
    tip, is the model's tool; from one to the other the forward kinematics is the calibrated robot's.

    Args:
        calibrated: the robot as identified.
        nominal: the robot as loaded from the file, base and tool apart.
        path: the file.
        tip: the link that was the tool.
        comments: sentences to write at the top.

    Raises:
        RobotError: the file cannot be used, or is of another robot.
    """
    from lxml import etree

    chain = read_chain(path, tip=tip)
    rows = rows_of_chain(chain)
    _check_same(rows.robot, nominal, str(path))
    urdf, _ = read_urdf(path)
    root = parse_xml(path, everything=True)
    elements = {element.get("name"): element for element in root.iterchildren("{*}joint")}
    for name, origin in _new_origins(chain, rows, calibrated, urdf).items():
        _set_origin(elements[name], origin)
    T_frame_base = frame_of(calibrated.base) @ inverse(frame_of(rows.robot.base))
    last = row_frame(*calibrated.dh[-1].tolist()) @ frame_of(calibrated.tool)
    _add_link(root, FRAME_LINK, None, chain.base, T_frame_base)
    _add_link(root, TOOL_LINK, chain.tip, None, inverse(chain.end) @ rows.frames[-1] @ last)
    for sentence in reversed(comments):
        root.insert(0, etree.Comment(comment_text(sentence)))
    etree.indent(root)
    return f'<?xml version="1.0"?>\n{etree.tostring(root, encoding="unicode")}\n'


def _check_same(drawn: Robot, nominal: Robot, path: str) -> None:
    """Refuse a file of another robot."""
    kinds, wanted = ([(row.name, row.type, row.direction) for row in r.rows] for r in (drawn, nominal))
    if kinds != wanted:
        joints, other = (", ".join(row.name for row in r.rows) for r in (drawn, nominal))
        raise RobotError(
            f"{path}: has the joints {joints}, but the model those of {other}; give the file that the robot was "
            "loaded from, and the same tip."
        )
    far = float(np.abs(drawn.dh - nominal.dh)[:-1].max(initial=0.0))
    if far > SAME:
        raise RobotError(
            f"{path}: its nominal geometry is not the model's (off by {far:.2g} m or rad); give the file that the "
            "robot was loaded from."
        )


def _new_origins(chain: Chain, rows: ChainRows, calibrated: Robot, urdf: Any) -> dict[str, Frame]:
    """Origins of the joints that move, in the links before them; that of the first stays."""
    found: dict[str, Frame] = {}
    for i, joint in enumerate(chain.joints[1:], 1):
        whole = rows.frames[i - 1] @ row_frame(*calibrated.dh[i - 1].tolist()) @ inverse(rows.frames[i])
        # Fixed joints between the two stay; what is before the joint's own origin is their product.
        before = joint.origin @ inverse(origin_of(urdf.joint_map[joint.name]))
        found[joint.name] = inverse(before) @ whole
    return found


def _set_origin(element: Any, origin: Frame) -> None:
    from lxml import etree

    part = next(element.iterchildren("{*}origin"), None)
    if part is None:
        part = etree.SubElement(element, "origin")
        element.insert(0, part)
    part.attrib.update(origin_attributes(origin))


def _add_link(root: Any, name: str, parent: str | None, child: str | None, origin: Frame) -> None:
    """A link with a fixed joint to the one that is given."""
    from lxml import etree

    name = unused_name(name, {element.get("name") for element in root.iterchildren("{*}link")})
    joints = {element.get("name") for element in root.iterchildren("{*}joint")}
    etree.SubElement(root, "link", name=name)
    joint = etree.SubElement(root, "joint", name=unused_name(f"{name}_joint", joints), type="fixed")
    _set_origin(joint, origin)
    etree.SubElement(joint, "parent", link=parent or name)
    etree.SubElement(joint, "child", link=child or name)
