"""Write robots as YAML or URDF text."""

from collections.abc import Collection
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64

from pisigma.files.errors import OutputError, RobotError
from pisigma.files.yaml_writing import yaml_text
from pisigma.robot.coupling_section import coupling_document
from pisigma.robot.description import Robot
from pisigma.robot.row import DH_COLUMNS, FRAME_COLUMNS, Row, in_file_units
from pisigma.robot.urdf_frames import Frame, frame_of, rotation, row_frame, translation, xyz_zyx_of


def robot_to_yaml(robot: Robot) -> str:
    """Format a robot as YAML text that `Robot.load` restores, up to the rounding of the unit conversion.

    Raises:
        RobotError: a row has only one limit, which the format cannot express.
    """
    return yaml_text(robot_document(robot))


def robot_document(robot: Robot) -> dict[str, object]:
    """Return a robot as the plain values of a YAML file.

    Raises:
        RobotError: a row has only one limit, which the format cannot express.
    """
    rows = []
    axes = {axis.name: axis for axis in robot.axes}
    for joint, parameters in zip(robot.rows, robot.dh, strict=True):
        # Files contain the limits of the controller's values, of which a passive joint has none.
        row = axes.get(joint.name, replace(joint, lower=-np.inf, upper=np.inf))
        entry: dict[str, object] = {"name": row.name, "type": row.type, "direction": row.direction}
        entry |= {"drawn_at_mm": [value * 1e3 for value in row.urdf_origin]} if any(row.urdf_origin) else {}
        rows.append(entry | _limits_entry(row) | in_file_units(DH_COLUMNS, parameters))
    document: dict[str, object] = {
        "name": robot.name,
        "maker": robot.maker,
        "source": robot.source,
        "rows": rows,
    }
    document |= {part: in_file_units(FRAME_COLUMNS, getattr(robot, part)) for part in ("base", "tool")}
    if robot.coupling is not None:
        document["coupling"] = coupling_document(robot.coupling, robot.joints)
    return document


def _limits_entry(row: Row) -> dict[str, list[float]]:
    bounded = np.isfinite([row.lower, row.upper])
    if not bounded.any():
        return {}
    if not bounded.all():
        raise RobotError(
            f"row '{row.name}' has only one limit", expected="two limits or none", value=row.name
        )
    return {f"limits_{row.file_unit}": [row.in_file_unit(row.lower), row.in_file_unit(row.upper)]}


BASE_LINK = "base_link"
TOOL_LINK = "tool0"
MASS, INERTIA, EFFORT, VELOCITY = "1", "0.01", "1000", "10"
_PLACEHOLDERS = (
    f"Masses ({MASS} kg), inertias ({INERTIA} kg m2), efforts ({EFFORT}) and velocities ({VELOCITY}) are "
    "placeholders, not values of the robot: only the kinematics was calibrated. Enter the values of the maker to "
    "simulate forces."
)


def robot_to_urdf(robot: Robot, comments: tuple[str, ...] = ()) -> str:
    """Format a robot as URDF with the same forward kinematics from `base_link` to `tool0`.

    The frame of a joint is that of its row after `RotZ(theta) · Trans(0, 0, d)`. The joint moves about or along its z
    axis, in the opposite sense if its direction is -1; `Trans(a, 0, 0) · RotX(alpha) · RotY(beta)` leads to the next
    joint. The description needs no common normals, so parallel axes keep their positions. Base and tool are fixed
    joints, links are named `link_1` and so on, joints like the rows. `effort` and `velocity`, which the format
    requires, and masses and inertias, without which MuJoCo rejects the file, are `_PLACEHOLDERS`, as a comment in the
    file states. A coupled joint is followed by one joint on the same axis for each other axis of the controller that
    moves it, which mimics that axis.

    Args:
        robot: the robot.
        comments: sentences to write at the top.

    Raises:
        OutputError: URDF cannot express a joint's limits or the linkage that drives it.
    """
    root = ElementTree.Element("robot", name=robot.name)
    for sentence in (*comments, _PLACEHOLDERS):
        root.append(ElementTree.Comment(comment_text(sentence)))
    names = {row.name for row in robot.rows}
    link = "link_0"
    ElementTree.SubElement(root, "link", name=BASE_LINK)
    _joint(root, unused_name("base_joint", names), "fixed", (BASE_LINK, link), frame_of(robot.base))
    behind, number = np.eye(4), 0
    for row, (theta, d, a, alpha, beta) in zip(robot.rows, _at_rest(robot).tolist(), strict=True):
        behind = behind @ rotation(2, theta) @ translation(0.0, 0.0, d)
        for moving, mimic in _movers(robot, row):
            number += 1
            links = link, f"link_{number}"
            element = _joint(root, moving.name, _type(moving, robot.name), links, behind)
            _add_motion(element, moving, mimic)
            if moving.type != "fixed":
                made = next(one for one in root.iter("link") if one.get("name") == links[1])
                add_inertia(ElementTree.SubElement(made, "inertial"))
            link, behind = links[1], np.eye(4)
        behind = row_frame(0.0, 0.0, a, alpha, beta)
    tool = behind @ frame_of(robot.tool)
    _joint(root, unused_name("tool_joint", names), "fixed", (link, TOOL_LINK), tool)
    ElementTree.indent(root)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


_Mimic = tuple[str, float]
"""Name of a mimicked joint, and motion [rad or m] per [rad or m] of that joint."""


def _at_rest(robot: Robot) -> Float64[np.ndarray, "rows 5"]:
    """Return the DH parameters of a robot with all controller values at 0.

    Raises:
        OutputError: a linkage drives a joint, which is then not proportional to the controller's values.
    """
    if robot.coupling is None:
        return robot.dh
    if robot.coupling.four_bars:
        driven = robot.joints[robot.coupling.four_bars[0][0]].name
        raise OutputError(
            f"robot '{robot.name}': a four-bar linkage drives the joint '{driven}', which URDF cannot express",
            value=driven,
            remedy="write a robot file (--format dh with .yaml) instead",
        )
    dh = robot.dh.copy()
    for joint, row, offset in zip(robot.joints, robot.joint_rows, robot.coupling.offset, strict=True):
        dh[row, 0 if joint.type == "revolute" else 1] += joint.direction * offset
    return dh


def _movers(robot: Robot, row: Row) -> list[tuple[Row, _Mimic | None]]:
    """Return the joints on the axis of a row: the commanded one first, then those that mimic other axes."""
    if robot.coupling is None or row.type == "fixed":
        return [(row, None)]
    factors = robot.coupling.matrix[[joint.name for joint in robot.joints].index(row.name)].tolist()
    result: list[tuple[Row, _Mimic | None]] = []
    for axis, factor in zip(robot.axes, factors, strict=True):
        if axis.name == row.name:
            result.insert(0, (axis, None))
            factor -= 1.0
        if factor:
            lower, upper = sorted((factor * axis.lower, factor * axis.upper))
            follower = replace(row, name=f"{row.name}_by_{axis.name}", lower=lower, upper=upper)
            result.append((follower, (axis.name, factor)))
    mover, mimic = result[0]
    return [(replace(mover, name=row.name), mimic), *result[1:]]


def _add_motion(element: ElementTree.Element, row: Row, mimic: _Mimic | None) -> None:
    """Add axis, limits and mimic of a joint to its element."""
    if row.type != "fixed":
        ElementTree.SubElement(element, "axis", xyz=f"0 0 {row.direction}")
    if np.isfinite(row.upper):
        ElementTree.SubElement(
            element, "limit", lower=repr(row.lower), upper=repr(row.upper), effort=EFFORT, velocity=VELOCITY
        )
    if mimic is not None:
        ElementTree.SubElement(element, "mimic", joint=mimic[0], multiplier=repr(mimic[1]))


def add_inertia(inertial: Any) -> None:
    """Add the placeholder mass and inertia to an element."""
    for name, values in (
        ("mass", {"value": MASS}),
        (
            "inertia",
            dict.fromkeys(("ixy", "ixz", "iyz"), "0") | dict.fromkeys(("ixx", "iyy", "izz"), INERTIA),
        ),
    ):
        inertial.append(inertial.makeelement(name, values))


def _joint(
    root: ElementTree.Element, name: str, kind: str, links: tuple[str, str], origin: Frame
) -> ElementTree.Element:
    """Add a joint between two links (parent, child), preceded by its child link."""
    ElementTree.SubElement(root, "link", name=links[1])
    element = ElementTree.SubElement(root, "joint", name=name, type=kind)
    ElementTree.SubElement(element, "origin", origin_attributes(origin))
    ElementTree.SubElement(element, "parent", link=links[0])
    ElementTree.SubElement(element, "child", link=links[1])
    return element


def _type(row: Row, robot: str) -> str:
    """Return the URDF type of a joint.

    Raises:
        OutputError: the joint lacks a limit that URDF requires.
    """
    bounded = np.isfinite([row.lower, row.upper])
    if row.type == "fixed" or bounded.all():
        return row.type
    if row.type == "revolute" and not bounded.any():
        return "continuous"
    raise OutputError(
        f"robot '{robot}', joint '{row.name}': URDF requires two limits for a {row.type} joint, "
        f"got {'one' if bounded.any() else 'none'}",
        expected="two limits",
        value=row.name,
        remedy="give the joint both limits",
    )


def origin_attributes(T: Frame) -> dict[str, str]:
    """Return `xyz` and `rpy` of a frame with all digits; `rpy` are rotations about the fixed axes x, y, z in order."""
    x, y, z, roll, pitch, yaw = (repr(float(value) + 0.0) for value in xyz_zyx_of(T))
    return {"xyz": f"{x} {y} {z}", "rpy": f"{yaw} {pitch} {roll}"}


def unused_name(name: str, names: Collection[str]) -> str:
    """Append underscores to a name until it differs from all others."""
    while name in names:
        name += "_"
    return name


def comment_text(sentence: str) -> str:
    """Return a sentence as the content of an XML comment, which may not contain `--`."""
    return f" {' '.join(sentence.split()).replace('--', '- -')} "
