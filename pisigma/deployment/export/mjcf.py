"""The calibrated geometry as MJCF: an existing model with calibrated bodies, or one made from the calibrated URDF."""

import itertools
import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.deployment.export.geometry import check_geometry, chosen_geometry
from pisigma.deployment.export.urdf import (
    CALIBRATED_FRAME,
    CALIBRATED_TOOL,
    check_same_geometry_as_nominal,
    check_tip,
    missing_mesh_warnings,
    updated_urdf_text,
)
from pisigma.robot.description import Robot
from pisigma.robot.mjcf_file import MjcfDrawing, numbers
from pisigma.robot.row import Row
from pisigma.robot.urdf_chain import Chain, ChainJoint
from pisigma.robot.urdf_frames import Frame, frame_of, inverse, rotation, row_frame, translation
from pisigma.robot.urdf_rows import rows_of_chain
from pisigma.robot.writing import comment_text, robot_to_urdf, unused_name

_SAME = 2e-3
"""Largest difference from rows of the existing model [m or rad], which may be rounded to millimetres."""
_SNAP = 1e-5
"""Largest deviation from a right angle [rad] that is due to rounding."""
_DIGITS = 6
"""Number of decimals of the file's positions [m] that are used."""
_MESHES = (".stl", ".obj", ".msh")
"""Suffixes of meshes that MuJoCo reads."""
_ORIENTATIONS = ("quat", "euler", "axisangle", "xyaxes", "zaxis")
_HINGES = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slide"}


def _write(request: ExportRequest) -> Exported:
    model = request.load()
    chosen = chosen_geometry(model, request.geometry)
    facts, warnings = model_facts(model) | {"geometry": chosen.name}, []
    if request.like is not None and request.like.suffix.lower() != ".urdf":
        text = update_mjcf(chosen.robot, model.robot, request.like, request.tip, chosen.comments)
    else:
        urdf = updated_urdf_text(request, chosen.robot, model.robot, chosen.comments)
        text, left_out = urdf_to_mjcf(urdf or robot_to_urdf(chosen.robot, chosen.comments))
        if left_out:
            warnings.append(
                f"{len(left_out)} meshes, such as {left_out[0]}, are not in the file, because MuJoCo reads only "
                f"{', '.join(_MESHES)}."
            )
    directory = re.search(r'<compiler\s[^>]*meshdir="([^"]*)"', text)
    folder = request.out.parent / (directory.group(1) if directory else "")
    warnings += missing_mesh_warnings(re.findall(r'<mesh\s[^>]*file="([^"]+)"', text), folder)
    return Exported(text, facts, chosen.comments, warnings=tuple(warnings))


def _check(request: ExportRequest) -> None:
    check_tip(request)
    check_geometry(request)


FORMAT = ExportFormat(
    "mjcf", "an MJCF model", (".xml", ".mjcf"), _write, frozenset(("like", "tip", "geometry")), _check
)


def urdf_to_mjcf(urdf: str) -> tuple[str, tuple[str, ...]]:
    """Convert a URDF to MJCF with the same forward kinematics, masses, inertias, limits, shapes and meshes.

    Links become bodies, and joints keep their names. A joint that mimics another becomes an equality constraint, which
    MuJoCo satisfies during a simulation. Meshes that MuJoCo cannot read are left out.

    Returns:
        The MJCF text, and the files of the meshes that were left out.
    """
    from lxml import etree

    root = etree.fromstring(urdf.encode())
    mjcf = etree.Element("mujoco", model=root.get("name") or "robot")
    for comment in root.iterchildren(etree.Comment):
        mjcf.append(etree.Comment(comment.text))
    etree.SubElement(mjcf, "compiler", angle="radian", autolimits="true")
    asset, world = etree.SubElement(mjcf, "asset"), etree.SubElement(mjcf, "worldbody")
    links = {link.get("name"): link for link in root.iterchildren("{*}link")}
    children: dict[str, list[Any]] = {}
    joints = list(root.iterchildren("{*}joint"))
    for joint in joints:
        children.setdefault(joint.find("{*}parent").get("link"), []).append(joint)
    (first,) = set(links) - {joint.find("{*}child").get("link") for joint in joints}
    left_out: list[str] = []
    open_links: list[tuple[Any, str, Any]] = [(world, first, None)]
    while open_links:
        parent, name, joint = open_links.pop()
        body = etree.SubElement(parent, "body", name=name)
        if joint is not None:
            _place(body, _urdf_frame(joint))
            _add_joint(body, joint)
        left_out += _add_content(body, links[name], asset)
        open_links += [(body, one.find("{*}child").get("link"), one) for one in children.get(name, ())[::-1]]
    _add_mimics(mjcf, joints)
    etree.indent(mjcf)
    return f"{etree.tostring(mjcf, encoding='unicode')}\n", tuple(dict.fromkeys(left_out))


def _urdf_frame(element: Any) -> Frame:
    """Return the frame of the origin of a URDF element."""
    origin = element.find("{*}origin")
    if origin is None:
        return np.eye(4)
    xyz, rpy = (numbers(origin.get(key, "0 0 0")) for key in ("xyz", "rpy"))
    return frame_of([*xyz, *rpy[::-1]])


def _add_joint(body: Any, joint: Any) -> None:
    """Add a URDF joint that moves to a body."""
    from lxml import etree

    if (kind := _HINGES.get(joint.get("type"))) is None:
        return
    axis, limit, dynamics = (joint.find(f"{{*}}{name}") for name in ("axis", "limit", "dynamics"))
    made = etree.SubElement(body, "joint", name=joint.get("name"), type=kind)
    made.set("axis", "1 0 0" if axis is None else axis.get("xyz"))
    if limit is not None and joint.get("type") != "continuous":
        made.set("range", f"{limit.get('lower', '0')} {limit.get('upper', '0')}")
    for key, name in (("damping", "damping"), ("friction", "frictionloss")):
        if dynamics is not None and dynamics.get(key):
            made.set(name, dynamics.get(key))


def _add_content(body: Any, link: Any, asset: Any) -> list[str]:
    """Add inertia and shapes of a URDF link to a body, and return the files of the meshes that are left out."""
    from lxml import etree

    inertial = link.find("{*}inertial")
    if inertial is not None and inertial.find("{*}mass") is not None:
        T, given = _urdf_frame(inertial), inertial.find("{*}inertia")
        upper = [float(given.get(key, 0)) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")]
        a, b, c, d, e, f = upper
        about = T[:3, :3] @ np.array([[a, b, c], [b, d, e], [c, e, f]]) @ T[:3, :3].T
        moments = (*about.diagonal(), about[0, 1], about[0, 2], about[1, 2])
        mass = inertial.find("{*}mass").get("value")
        etree.SubElement(body, "inertial", pos=_text(T[:3, 3]), mass=mass, fullinertia=_text(moments))
    left_out = []
    for kind, shown in (
        ("visual", {"group": "2", "contype": "0", "conaffinity": "0"}),
        ("collision", {"group": "3"}),
    ):
        for shape in link.iterchildren(f"{{*}}{kind}"):
            geometry = _geometry(shape, asset)
            if isinstance(geometry, str):
                left_out.append(geometry)
            else:
                geom = etree.SubElement(body, "geom", shown | geometry)
                _place(geom, _urdf_frame(shape))
    return left_out


def _geometry(shape: Any, asset: Any) -> dict[str, str] | str:
    """Return the attributes of a URDF shape as a geom, or the file of a mesh that MuJoCo cannot read."""
    from lxml import etree

    (form,) = shape.find("{*}geometry").iterchildren("{*}*")
    kind, half = etree.QName(form).localname, {"box": "size", "cylinder": "length"}
    if kind == "mesh":
        file = form.get("filename").removeprefix("package://").removeprefix("file://")
        if Path(file).suffix.lower() not in _MESHES:
            return str(file)
        scale = form.get("scale", "1 1 1")
        known = {(mesh.get("file"), mesh.get("scale")): mesh.get("name") for mesh in asset}
        name = known.get((file, scale)) or unused_name(Path(file).stem, known.values())
        if (file, scale) not in known:
            etree.SubElement(asset, "mesh", name=name, file=file, scale=scale)
        geom = {"type": "mesh", "mesh": name}
    else:
        sizes = [float(value) / 2 for value in numbers(form.get(half[kind]))] if kind in half else []
        radius = numbers(form.get("radius")) if kind != "box" else []
        geom = {"type": kind, "size": _text([*radius, *sizes])}
    color = shape.find("{*}material/{*}color")
    return geom if color is None else geom | {"rgba": color.get("rgba")}


def _add_mimics(mjcf: Any, joints: Sequence[Any]) -> None:
    """Add an equality constraint for every URDF joint that mimics another."""
    from lxml import etree

    mimics = [(joint, joint.find("{*}mimic")) for joint in joints if joint.find("{*}mimic") is not None]
    equality = etree.SubElement(mjcf, "equality") if mimics else None
    for joint, mimic in mimics:
        line = f"{mimic.get('offset', '0')} {mimic.get('multiplier', '1')} 0 0 0"
        etree.SubElement(
            equality, "joint", joint1=joint.get("name"), joint2=mimic.get("joint"), polycoef=line
        )


def _place(element: Any, T: Frame) -> None:
    """State the pose of an element in its parent, with all digits."""
    from scipy.spatial.transform import Rotation

    for name in _ORIENTATIONS:
        element.attrib.pop(name, None)
    element.set("pos", _text(T[:3, 3]))
    element.set("quat", _text(Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)))


def _text(values: Sequence[float] | Float64[np.ndarray, " values"]) -> str:
    return " ".join(repr(float(value) + 0.0) for value in values)


def update_mjcf(
    calibrated: Robot,
    nominal: Robot,
    path: str | os.PathLike[str],
    tip: str | None = None,
    comments: tuple[str, ...] = (),
) -> str:
    """Return an existing MJCF model with calibrated bodies; meshes, inertias, actuators and all else are kept.

    Every moved body after the first has its calibrated pose in the preceding body. Two sites are added:
    `calibrated_frame`, in the body before the first joint, is the frame of the model's poses, and `calibrated_tool`, in
    the last moved body, is the model's tool.

    Args:
        calibrated: robot with identified geometry.
        nominal: nominal robot, which the file describes.
        path: MJCF file.
        tip: body after the last joint; needed only if the names of joints differ from those of the robot.
        comments: sentences to write at the top.

    Raises:
        RobotError: the file cannot be used, or describes another robot.
    """
    from lxml import etree

    drawing = MjcfDrawing.read(path)
    moved = drawing.moved_bodies(nominal, tip)
    origins = [moved[0].pose @ moved[0].axis_frame]
    for before, body in itertools.pairwise(moved):
        origins.append(inverse(before.axis_frame) @ body.parent_pose @ body.pose @ body.axis_frame)
    frames = _row_frames(nominal, origins, path)
    ahead, *segments = _segments(calibrated)
    for i, body in enumerate(moved[1:], 1):
        joint_frame = moved[i - 1].axis_frame @ frames[i - 1] @ segments[i - 1] @ inverse(frames[i])
        _place(body.element, inverse(body.parent_pose) @ joint_frame @ inverse(body.axis_frame))
    sites = (
        (CALIBRATED_FRAME, moved[0].element.getparent(), origins[0] @ frames[0] @ inverse(ahead)),
        (CALIBRATED_TOOL, moved[-1].element, moved[-1].axis_frame @ frames[-1] @ segments[-1]),
    )
    for name, parent, T in sites:
        names = {site.get("name") for site in drawing.root.iter("site")}
        _place(etree.SubElement(parent, "site", name=unused_name(name, names)), T)
    for sentence in reversed(comments):
        drawing.root.insert(0, etree.Comment(comment_text(sentence)))
    return f"{etree.tostring(drawing.root, encoding='unicode')}\n"


def _segments(robot: Robot) -> list[Frame]:
    """Return the frame of the first row in the frame of the poses, and the transform of every moved row, with tool."""
    segments = [frame_of(robot.base)]
    for row, parameters in zip(robot.rows, robot.dh.tolist(), strict=True):
        if row.type != "fixed":
            segments.append(np.eye(4))
        segments[-1] = segments[-1] @ row_frame(*parameters)
    segments[-1] = segments[-1] @ frame_of(robot.tool)
    return segments


def _row_frames(nominal: Robot, origins: Sequence[Frame], path: str | os.PathLike[str]) -> list[Frame]:
    """Return the frames of the moved rows of the nominal robot in the frames of the file.

    Both are converted to rows in the same way, so they agree up to the position of the first row along its axis.

    Args:
        nominal: the robot.
        origins: frames of the axes in the file, each in the preceding frame.
        path: MJCF file, for the message.

    Raises:
        RobotError: the file describes another robot.
    """
    moving = [row for row in nominal.rows if row.type != "fixed"]
    drawn, own = (
        rows_of_chain(_chain(moving, chosen))
        for chosen in ([_without_rounding(T) for T in origins], [np.eye(4), *_segments(nominal)[1:-1]])
    )
    by = drawn.fields.dh[0] - own.fields.dh[0]
    start = rotation(2, by[0]) @ translation(0.0, 0.0, by[1])
    differences = (drawn.fields.dh - own.fields.dh)[:-1]
    differences[:1, :2] = 0.0
    check_same_geometry_as_nominal(
        differences, _SAME, path, "give the MJCF file of this robot, with the same joints"
    )
    frames = [there @ inverse(here) for there, here in zip(drawn.T_joint_row, own.T_joint_row, strict=True)]
    return [drawn.T_joint_row[0] @ start @ inverse(own.T_joint_row[0]), *frames[1:]]


def _without_rounding(T: Frame) -> Frame:
    """Return a frame with exact right angles, because a row depends on whether its axes intersect."""
    snapped = T.copy()
    snapped[:3, 3] = T[:3, 3].round(_DIGITS)
    if np.abs(T[:3, :3] - T[:3, :3].round()).max() < _SNAP:
        snapped[:3, :3] = T[:3, :3].round()
    return snapped


def _chain(rows: Sequence[Row], origins: Sequence[Frame]) -> Chain:
    """Return a chain of axes along +z or -z, each in the frame of the preceding axis."""
    joints = [
        ChainJoint(row.name, _kind(row), origin, np.array([0.0, 0.0, row.direction]), -math.inf, math.inf)
        for row, origin in zip(rows, origins, strict=True)
    ]
    return Chain("", "", "", tuple(joints), np.eye(4), "")


def _kind(row: Row) -> Literal["revolute", "prismatic"]:
    return "prismatic" if row.type == "prismatic" else "revolute"
