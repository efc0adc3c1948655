"""A robot as URDF text: a frame per joint, exact to the last digit."""

from collections.abc import Collection
from xml.etree import ElementTree

import numpy as np

from pisigma.errors import OutputError
from pisigma.robot.description import Robot, Row
from pisigma.robot.urdf_frames import Frame, frame_of, row_frame, shift, turn, xyzrpy_of

BASE_LINK = "base_link"
TOOL_LINK = "tool0"


def robot_to_urdf(robot: Robot, comments: tuple[str, ...] = ()) -> str:
    """The robot as URDF with the same forward kinematics from `base_link` to `tool0`.

    A joint stands where its row has it after `RotZ(theta) · Trans(0, 0, d)` and moves about or along its own z
    axis, or the other way round where its direction is -1; `Trans(a, 0, 0) · RotX(alpha) · RotY(beta)` leads
    on to the next. No common normal is needed, so parallel axes stay where they are. Base and tool are fixed
    joints, links are named `link_1` and so on, joints like the rows. `effort` and `velocity`, which the
    format asks for, are written as 0: not known.

    Args:
        robot: the robot.
        comments: sentences to write at the top.

    Raises:
        OutputError: a joint has limits that the format cannot say.
    """
    root = ElementTree.Element("robot", name=robot.name)
    for sentence in comments:
        root.append(ElementTree.Comment(comment_text(sentence)))
    names = {row.name for row in robot.rows}
    link = "link_0"
    _link(root, BASE_LINK)
    _link(root, link)
    _joint(root, unused_name("base_joint", names), "fixed", (BASE_LINK, link), frame_of(robot.base))
    behind = np.eye(4)
    for number, (row, (theta, d, a, alpha, beta)) in enumerate(
        zip(robot.rows, robot.dh.tolist(), strict=True), 1
    ):
        following = f"link_{number}"
        _link(root, following)
        origin = behind @ turn(2, theta) @ shift(0.0, 0.0, d)
        element = _joint(root, row.name, _type(row, robot.name), (link, following), origin)
        if row.type != "fixed":
            ElementTree.SubElement(element, "axis", xyz=f"0 0 {row.direction}")
        if np.isfinite(row.upper):
            ElementTree.SubElement(
                element, "limit", lower=repr(row.lower), upper=repr(row.upper), effort="0", velocity="0"
            )
        link, behind = following, row_frame(0.0, 0.0, a, alpha, beta)
    _link(root, TOOL_LINK)
    tool = behind @ frame_of(robot.tool)
    _joint(root, unused_name("tool_joint", names), "fixed", (link, TOOL_LINK), tool)
    ElementTree.indent(root)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def _link(root: ElementTree.Element, name: str) -> None:
    ElementTree.SubElement(root, "link", name=name)


def _joint(
    root: ElementTree.Element, name: str, kind: str, links: tuple[str, str], origin: Frame
) -> ElementTree.Element:
    element = ElementTree.SubElement(root, "joint", name=name, type=kind)
    ElementTree.SubElement(element, "origin", origin_attributes(origin))
    ElementTree.SubElement(element, "parent", link=links[0])
    ElementTree.SubElement(element, "child", link=links[1])
    return element


def _type(row: Row, robot: str) -> str:
    """What the format calls the joint."""
    bounded = np.isfinite([row.lower, row.upper])
    if row.type == "fixed" or bounded.all():
        return row.type
    if row.type == "revolute" and not bounded.any():
        return "continuous"
    raise OutputError(
        f"robot '{robot}', joint '{row.name}': URDF wants a lower and an upper limit of a {row.type} joint, "
        f"but it has {'one only' if bounded.any() else 'none'}; give the robot both."
    )


def origin_attributes(T: Frame) -> dict[str, str]:
    """`xyz` and `rpy` of a frame with all digits; `rpy` turns about the fixed axes x, y, z, in this order."""
    x, y, z, roll, pitch, yaw = (repr(float(value) + 0.0) for value in xyzrpy_of(T))
    return {"xyz": f"{x} {y} {z}", "rpy": f"{yaw} {pitch} {roll}"}


def unused_name(name: str, names: Collection[str]) -> str:
    """The name, with lines under it until none of the others is the same."""
    while name in names:
        name += "_"
    return name


def comment_text(sentence: str) -> str:
    """A sentence as the content of an XML comment."""
    return f" {' '.join(sentence.split()).replace('--', '- -')} "
