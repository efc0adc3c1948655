"""A xacro file with the calibrated origins of a URDF file as properties."""

import re

from pisigma.deployment.export.controllers.controller_file import ControllerFile, FileContent
from pisigma.deployment.export.urdf import updated_urdf_text
from pisigma.files.errors import OutputError
from pisigma.robot.urdf_file import XACRO


def urdf_to_xacro(urdf: str) -> str:
    """Convert URDF text to xacro with the origins of its joints as properties at the top."""
    from lxml import etree

    root = etree.fromstring(urdf.encode())
    top = etree.Element("robot", root.attrib, nsmap={**root.nsmap, "xacro": XACRO})
    properties = []
    for joint in root.iterchildren("{*}joint"):
        for origin in joint.iterchildren("{*}origin"):
            for key in ("xyz", "rpy"):
                name = re.sub(r"\W", "_", f"{joint.get('name')}_{key}")
                value = origin.get(key, "0 0 0")
                properties.append(etree.Element(f"{{{XACRO}}}property", name=name, value=value))
                origin.set(key, f"${{{name}}}")
    comments = [node for node in root if node.tag is etree.Comment]
    top.extend([*comments, *properties, *[node for node in root if node.tag is not etree.Comment]])
    etree.indent(top)
    return f'<?xml version="1.0"?>\n{etree.tostring(top, encoding="unicode")}\n'


def write_xacro(content: FileContent) -> str:
    """Return the xacro file, made from the URDF file that describes the nominal robot.

    Raises:
        OutputError: the robot was not loaded from a URDF file.
    """
    urdf = updated_urdf_text(content.request, content.robot, content.nominal, content.comments)
    if urdf is None:
        raise OutputError(
            "--format xacro needs the URDF file of the robot",
            option="--like",
            remedy="give that file with --like",
        )
    return urdf_to_xacro(urdf)


FILE = ControllerFile(
    name="xacro",
    contents="a xacro overlay",
    suffixes=(".xacro",),
    source="Written from the published description (wiki.ros.org/xacro), and expanded with the package xacro 2.1.1.",
    requirements=(
        "The origins of the joints are properties, so one calibration can be replaced by another; `xacro FILE` "
        "expands it. The link calibrated_frame is the frame of the poses, calibrated_tool the tool.",
    ),
    text=write_xacro,
    read=None,
    check=lambda robot: None,
    options=frozenset(("like", "tip")),
    contains="description",
)
FORMAT = FILE.export_format()
