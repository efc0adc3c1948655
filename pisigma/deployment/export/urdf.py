"""The calibrated geometry as URDF: the robot's file with calibrated origins, or a new file."""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.deployment.export.geometry import check_geometry, chosen_geometry
from pisigma.files.errors import OutputError, Place, RobotError, missing_extra
from pisigma.files.model_files import DRAWING
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot
from pisigma.robot.robot_fields import RobotFields
from pisigma.robot.urdf_chain import Chain, origin_of, read_chain
from pisigma.robot.urdf_file import parse_xml, read_urdf
from pisigma.robot.urdf_frames import Frame, frame_of, inverse, row_frame
from pisigma.robot.urdf_rows import URDF_SOURCE, ChainRows, rows_of_chain
from pisigma.robot.writing import (
    EFFORT,
    INERTIA,
    MASS,
    VELOCITY,
    add_inertia,
    comment_text,
    origin_attributes,
    robot_to_urdf,
    unused_name,
)

if TYPE_CHECKING:
    from pisigma.model.inverse.corrected_ik import CorrectedIK

_SOURCE = re.compile(re.escape(URDF_SOURCE) + r".+, from link '(?P<base>.*)' to link '(?P<tip>.*)'")
CALIBRATED_FRAME = "calibrated_frame"
CALIBRATED_TOOL = "calibrated_tool"
_MISSING = (
    f"Masses, inertias, efforts and velocities that were missing or 0 in the file are placeholders ({MASS} kg, "
    f"{INERTIA} kg m2, {EFFORT}, {VELOCITY}), in {{links}}. Enter the maker's values before you simulate forces."
)
_SAME = 1e-9
"""Largest difference of rows that are treated as equal to the rows of the file [m or rad]."""


def check_tip(request: ExportRequest) -> None:
    """Check that a tip is given only together with the file that contains this link."""
    if request.tip is not None and request.like is None:
        raise OutputError(
            "the option names a link of the file given with --like",
            option="--tip",
            value=request.tip,
            remedy="give --like too, or omit --tip",
        )


def _check(request: ExportRequest) -> None:
    check_tip(request)
    check_geometry(request)


def _write(request: ExportRequest) -> Exported:
    model = request.load()
    chosen = chosen_geometry(model, request.geometry)
    text = updated_urdf_text(request, chosen.robot, model.robot, chosen.comments) or robot_to_urdf(
        chosen.robot, chosen.comments
    )
    facts = model_facts(model) | {"geometry": chosen.name}
    return Exported(text, facts, chosen.comments, warnings=_warnings(request, model.robot, text))


def updated_urdf_text(
    request: ExportRequest, robot: Robot, nominal: Robot, comments: tuple[str, ...]
) -> str | None:
    """Return the URDF file of --like, or by default of the model folder, with the geometry of a robot.

    Args:
        request: model and options.
        robot: robot with the geometry to write.
        nominal: robot of the model, whose `source` names the links.
        comments: sentences for the top of the file.

    Returns:
        The text; None if there is no URDF file.
    """
    source = _SOURCE.search(nominal.source)
    like = request.like or (request.model / DRAWING if nominal.urdf else None)
    if like is None:
        return None
    base, tip = source.group("base", "tip") if source else (None, None)
    return update_urdf(robot, nominal, like, request.tip or tip, comments, base)


def to_pinocchio(model: "CalibratedModel | CorrectedIK") -> Any:
    """Return the identified geometry as a `pinocchio.Model`, without the joint correction of a hybrid.

    If the robot was loaded from a URDF file, the pose of the model is that of the frame `calibrated_tool` in
    `calibrated_frame`, and masses, inertias and limits are those of the file; otherwise it is the pose of `tool0` in
    `base_link`. The joints are in the order of the robot. Pinocchio represents joints without limits by their cosine
    and sine. See `update_urdf`.

    Args:
        model: result of `pisigma.load` or of a calibration.

    Raises:
        MissingExtraError: pinocchio is not installed.
        OutputError: URDF cannot express the robot.
    """
    try:
        import pinocchio
    except ImportError as problem:
        raise missing_extra(problem) or problem from None
    calibrated = model if isinstance(model, CalibratedModel) else model.model
    chosen = chosen_geometry(calibrated, None)
    with TemporaryDirectory() as folder:
        if calibrated.robot.urdf:
            Path(folder, DRAWING).write_bytes(calibrated.robot.urdf)
        request = ExportRequest(Path(folder), Path(folder))
        text = updated_urdf_text(request, chosen.robot, calibrated.robot, ())
    text = text or robot_to_urdf(chosen.robot)
    return pinocchio.buildModelFromXML(text, mimic="<mimic" in text)


def _warnings(request: ExportRequest, nominal: Robot, text: str) -> tuple[str, ...]:
    """Return warnings about the other content of the file."""
    if _SOURCE.search(nominal.source) and request.like is None and nominal.urdf is None:
        return (
            "The model was made by a version that did not store the URDF file of the robot: use --like FILE to keep "
            "its links, meshes, masses and limits; this file has placeholders.",
        )
    return missing_mesh_warnings(re.findall(r'<mesh\s[^>]*filename="([^":]+)"', text), request.out.parent)


def missing_mesh_warnings(names: Sequence[str], folder: Path) -> tuple[str, ...]:
    """Return a warning if files of meshes do not exist in a folder."""
    missing = [name for name in names if not (folder / name).is_file()]
    if not missing:
        return ()
    return (
        f"{len(missing)} meshes that the file names by relative paths, such as {missing[0]}, do not exist; write the "
        "file to the folder of the meshes, otherwise simulators that read meshes reject it.",
    )


FORMAT = ExportFormat("urdf", "a URDF", (".urdf",), _write, frozenset(("like", "tip", "geometry")), _check)


def update_urdf(
    calibrated: Robot,
    nominal: Robot,
    path: str | os.PathLike[str],
    tip: str | None = None,
    comments: tuple[str, ...] = (),
    base: str | None = None,
) -> str:
    """Return a URDF file with the origins of a calibrated robot; links, meshes, limits and all else are kept.

    Every joint after the first has its calibrated pose in the preceding link. The poses of links do not change
    relative to their joints, so that meshes still fit. Two links are added: `calibrated_frame`, the parent of the
    base, is the frame of the model's poses, and `calibrated_tool`, a child of the tip, is the model's tool; the
    forward kinematics between them is that of the calibrated robot. Masses, inertias, efforts and velocities that are
    missing or 0 are replaced by placeholders, because simulators require them; a comment states this.

    Args:
        calibrated: robot with identified geometry.
        nominal: robot as loaded from the file, except for base and tool.
        path: URDF file.
        tip: link that was the tool.
        comments: sentences to write at the top.
        base: link whose frame is that of the poses; None for the root.

    Raises:
        RobotError: the file cannot be used, or describes another robot.
    """
    from lxml import etree

    chain = read_chain(path, base, tip)
    rows = rows_of_chain(chain)
    _check_same(rows.fields, nominal, str(path))
    urdf, _ = read_urdf(path)
    root = parse_xml(path, keep_comments=True)
    elements = {element.get("name"): element for element in root.iterchildren("{*}joint")}
    for name, origin in _new_origins(chain, rows, calibrated, urdf).items():
        _set_origin(elements[name], origin)
    _widen_limits(elements, nominal)
    if filled := _fill_in(root):
        comments = (*comments, _MISSING.format(links=", ".join(filled)))
    T_frame_base = frame_of(calibrated.base) @ inverse(frame_of(rows.fields.base))
    last = row_frame(*calibrated.dh[-1].tolist()) @ frame_of(calibrated.tool)
    mount = None
    if chain.base in urdf.parent_map:
        mount = _add_link(root, f"{chain.base}_mount")
        next(elements[urdf.parent_map[chain.base][0]].iterchildren("{*}child")).set("link", mount)
    frame = _add_link(root, CALIBRATED_FRAME, mount, inverse(T_frame_base))
    _add_joint(root, frame, (frame, chain.base), T_frame_base)
    _add_link(root, CALIBRATED_TOOL, chain.tip, inverse(chain.end) @ rows.T_joint_row[-1] @ last)
    for sentence in reversed(comments):
        root.insert(0, etree.Comment(comment_text(sentence)))
    etree.indent(root)
    return f'<?xml version="1.0"?>\n{etree.tostring(root, encoding="unicode")}\n'


def _check_same(described: RobotFields, nominal: Robot, path: str) -> None:
    """Raise an error if a file describes another robot."""
    kinds, wanted = ([(row.name, row.type, row.direction) for row in r.rows] for r in (described, nominal))
    if kinds != wanted:
        joints, other = (", ".join(row.name for row in r.rows) for r in (described, nominal))
        raise RobotError(
            f"expected the joints {other} of the model, got {joints}",
            expected=f"the joints {other}",
            value=joints,
            at=Place(path),
            option="--like",
            remedy="give the file that the robot was loaded from, and the same tip",
        )
    remedy = "give the file that the robot was loaded from"
    check_same_geometry_as_nominal((described.dh - nominal.dh)[:-1], _SAME, path, remedy)


def check_same_geometry_as_nominal(
    differences: Float64[np.ndarray, "rows parameters"],
    max_difference: float,
    path: str | os.PathLike[str],
    remedy: str,
) -> None:
    """Raise an error if the geometry of a file differs from that of the nominal robot.

    Args:
        differences: differences of the DH parameters [m or rad].
        max_difference: largest difference that is accepted [m or rad].
        path: the file, for the message.
        remedy: action that corrects the fault, for the message.

    Raises:
        RobotError: a difference is larger.
    """
    if (far := float(np.abs(differences).max(initial=0.0))) > max_difference:
        raise RobotError(
            f"the geometry of the file differs from that of the nominal robot by {far:.2g} m or rad",
            expected="the geometry of the nominal robot",
            value=far,
            at=Place(path),
            option="--like",
            remedy=remedy,
        )


def _new_origins(chain: Chain, rows: ChainRows, calibrated: Robot, urdf: Any) -> dict[str, Frame]:
    """Compute the origins of the movable joints in the preceding links, except for the first."""
    origins: dict[str, Frame] = {}
    for i, joint in enumerate(chain.joints[1:], 1):
        whole = (
            rows.T_joint_row[i - 1] @ row_frame(*calibrated.dh[i - 1].tolist()) @ inverse(rows.T_joint_row[i])
        )
        # Fixed joints in between remain; their product precedes the origin of the joint.
        before = joint.origin @ inverse(origin_of(urdf.joint_map[joint.name]))
        origins[joint.name] = inverse(before) @ whole
    return origins


def _widen_limits(elements: dict[str, Any], nominal: Robot) -> None:
    """Widen limits of the file that calibration rows exceed, as in the model."""
    for axis in nominal.axes:
        limit = next(elements[axis.name].iterchildren("{*}limit"), None)
        if limit is None or limit.get("lower") is None or limit.get("upper") is None:
            continue
        if axis.lower < float(limit.get("lower")) - _SAME:
            limit.set("lower", repr(axis.lower))
        if axis.upper > float(limit.get("upper")) + _SAME:
            limit.set("upper", repr(axis.upper))


def _fill_in(root: Any) -> tuple[str, ...]:
    """Fill in placeholders for missing or zero values that simulators require, and return the links and joints."""
    from lxml import etree

    links = {element.get("name"): element for element in root.iterchildren("{*}link")}
    joints, filled = list(root.iterchildren("{*}joint")), []
    fixed: dict[str, list[str]] = {}
    for joint in joints:
        if joint.get("type") == "fixed":
            fixed.setdefault(_link_of(joint, "parent"), []).append(_link_of(joint, "child"))
    for joint in joints:
        if joint.get("type") == "fixed":
            continue
        together, link = [_link_of(joint, "child")], links[_link_of(joint, "child")]
        for name in together:
            together += fixed.get(name, [])
        if not any(_has_mass(links[name]) for name in together):
            for before in list(link.iterchildren("{*}inertial")):
                link.remove(before)
            add_inertia(etree.SubElement(link, "inertial"))
            filled.append(link.get("name"))
        for limit in joint.iterchildren("{*}limit"):
            lacking = {"effort": EFFORT, "velocity": VELOCITY}
            lacking = {key: value for key, value in lacking.items() if not _positive(limit.get(key))}
            limit.attrib.update(lacking)
            filled += [joint.get("name")] if lacking else []
    return tuple(dict.fromkeys(filled))


def _link_of(joint: Any, end: str) -> str:
    return str(next(joint.iterchildren(f"{{*}}{end}")).get("link"))


def _has_mass(link: Any) -> bool:
    """Return whether a link has a mass and an inertia that a simulator accepts."""
    mass, inertia = (next(link.iterfind(f"{{*}}inertial/{{*}}{name}"), None) for name in ("mass", "inertia"))
    if mass is None or inertia is None:
        return False
    return _positive(mass.get("value")) and all(_positive(inertia.get(key)) for key in ("ixx", "iyy", "izz"))


def _positive(text: str | None) -> bool:
    try:
        return float(text or 0) > 0
    except ValueError:
        return False


def _set_origin(element: Any, origin: Frame) -> None:
    from lxml import etree

    part = next(element.iterchildren("{*}origin"), None)
    if part is None:
        part = etree.SubElement(element, "origin")
        element.insert(0, part)
    part.attrib.update(origin_attributes(origin))


def _add_link(root: Any, name: str, parent: str | None = None, origin: Frame | None = None) -> str:
    """Add a link, with a fixed joint to its parent if it has a parent, and return its name."""
    from lxml import etree

    name = unused_name(name, {element.get("name") for element in root.iterchildren("{*}link")})
    etree.SubElement(root, "link", name=name)
    if parent is not None and origin is not None:
        _add_joint(root, name, (parent, name), origin)
    return name


def _add_joint(root: Any, name: str, links: tuple[str, str], origin: Frame) -> None:
    """Add a fixed joint, named after a link, from the first of two links to the second."""
    from lxml import etree

    joints = {element.get("name") for element in root.iterchildren("{*}joint")}
    joint = etree.SubElement(root, "joint", name=unused_name(f"{name}_joint", joints), type="fixed")
    _set_origin(joint, origin)
    etree.SubElement(joint, "parent", link=links[0])
    etree.SubElement(joint, "child", link=links[1])
