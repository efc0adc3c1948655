"""Sections for coupled joints in robot files, in millimetres and degrees."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydantic import Field

from pisigma.files.errors import RobotError, choice_remedy
from pisigma.files.yaml_file import Section
from pisigma.robot.coupling import Coupling, FourBar, dh_limits
from pisigma.robot.row import MAX_MAGNITUDE, BoundedFloat, Row


class FourBarSection(Section):
    """A four-bar linkage that drives a joint; see `FourBar`.

    Attributes:
        ground_mm: length of the ground bar [mm].
        crank_mm: length of the crank [mm].
        coupler_mm: length of the coupler [mm].
        rocker_mm: length of the rocker [mm].
        zero_deg: angle of the crank relative to the ground bar where the sum of factors and offset is 0 [deg].
    """

    ground_mm: float = Field(gt=0, le=MAX_MAGNITUDE)
    crank_mm: float = Field(gt=0, le=MAX_MAGNITUDE)
    coupler_mm: float = Field(gt=0, le=MAX_MAGNITUDE)
    rocker_mm: float = Field(gt=0, le=MAX_MAGNITUDE)
    zero_deg: BoundedFloat

    def to_si(self) -> FourBar:
        """Return the linkage in SI units."""
        lengths = (self.ground_mm, self.crank_mm, self.coupler_mm, self.rocker_mm)
        ground, crank, coupler, rocker = (length / 1e3 for length in lengths)
        return FourBar(ground, crank, coupler, rocker, float(np.deg2rad(self.zero_deg)))


class CoupledJointSection(Section):
    """Relation of one joint to the controller's values: `q_dh = f(sum of factor · q_controller + offset)`.

    Attributes:
        joint: name of the joint's row.
        factors: motion of the joint [deg or mm] per 1 deg or 1 mm of the controller's value, by row name. Values that
            are not named, including the joint's own, have the factor 0. The errors of the joint may depend only on the
            named values, so a value may be named with the factor 0.
        offset_deg: offset of a revolute joint [deg].
        offset_mm: offset of a prismatic joint [mm].
        four_bar: linkage that drives the joint, if any.
        limits_deg: mechanical stops of a revolute joint, in addition to the limits of the controller's values.
        limits_mm: mechanical stops of a prismatic joint.
    """

    joint: str
    factors: dict[str, BoundedFloat] = Field(min_length=1)
    offset_deg: BoundedFloat = 0.0
    offset_mm: BoundedFloat = 0.0
    four_bar: FourBarSection | None = None
    limits_deg: tuple[BoundedFloat, BoundedFloat] | None = None
    limits_mm: tuple[BoundedFloat, BoundedFloat] | None = None


def rows_and_coupling(
    rows: Sequence[Row], sections: Sequence[CoupledJointSection]
) -> tuple[tuple[Row, ...], Coupling | None]:
    """Return the rows with the limits of their DH values, and the coupling of DH values and controller values.

    The value of a joint without a section equals the controller's value. A joint that has a section but no factor in
    any section is passive: the controller has no value for it.

    Args:
        rows: rows of the robot, with the limits of the controller's values.
        sections: sections of the file.

    Raises:
        RobotError: a section names an unknown joint, or has a unit or factor that does not fit its joint.
    """
    if not sections:
        return tuple(rows), None
    joints = [row for row in rows if row.type != "fixed"]
    _check_names(sections, [joint.name for joint in joints])
    by_name = {section.joint: section for section in sections}
    used = {name for section in sections for name, factor in section.factors.items() if factor}
    axes = [joint for joint in joints if joint.name in used or joint.name not in by_name]
    for joint in joints:
        if joint not in axes and np.isfinite([joint.lower, joint.upper]).any():
            raise RobotError(
                f"the joint '{joint.name}' is passive, so the controller has no limits for it",
                expected="no limits",
                value=joint.name,
                option="coupling",
                remedy="remove the limits",
            )
    plain = [CoupledJointSection(joint=joint.name, factors={joint.name: 1.0}) for joint in joints]
    stated = [by_name.get(section.joint, section) for section in plain]
    pairs = list(zip(joints, stated, strict=True))
    coupling = Coupling(
        axes=tuple(axes),
        revolute=tuple(joint.type == "revolute" for joint in joints),
        matrix=np.array([[_factor(section, joint, axis) for axis in axes] for joint, section in pairs]),
        offset=np.array([_offset(joint, section) for joint, section in pairs]),
        is_factor_stated=np.array(
            [[s.joint in by_name and axis.name in s.factors for axis in axes] for s in stated]
        ),
        four_bars=tuple((i, s.four_bar.to_si()) for i, s in enumerate(stated) if s.four_bar is not None),
        stops=tuple(
            (index, (joint.from_file_unit(limits[0]), joint.from_file_unit(limits[1])))
            for index, (joint, section) in enumerate(pairs)
            if (limits := section.limits_deg or section.limits_mm)
        ),
    )
    limits = iter(dh_limits(coupling).tolist())
    return tuple(row if row.type == "fixed" else _within(row, *next(limits)) for row in rows), coupling


def _check_names(sections: Sequence[CoupledJointSection], names: Sequence[str]) -> None:
    """Check that every section names existing joints, and that no joint has two sections."""
    for name in (name for section in sections for name in (section.joint, *section.factors)):
        if name not in names:
            remedy = choice_remedy(name, names)
            raise RobotError(f"there is no joint '{name}'", value=name, option="coupling", remedy=remedy)
    joints = [section.joint for section in sections]
    if twice := [name for name in names if joints.count(name) > 1]:
        problem = f"the joint '{twice[0]}' has two entries"
        raise RobotError(problem, value=twice[0], option="coupling", remedy="merge them into one entry")


def _factor(section: CoupledJointSection, joint: Row, axis: Row) -> float:
    """Return the motion of a joint [rad or m] per [rad or m] of an axis."""
    factor = section.factors.get(axis.name, 0.0)
    return factor if axis.type == joint.type else factor * axis.in_file_unit(1.0) / joint.in_file_unit(1.0)


def _within(row: Row, lower: float, upper: float) -> Row:
    return replace(row, lower=lower, upper=upper)


def _offset(joint: Row, section: CoupledJointSection) -> float:
    """Return the offset of a joint [rad or m].

    Raises:
        RobotError: the section has entries of the other joint type.
    """
    is_prismatic = joint.type == "prismatic"
    of_revolute = section.offset_deg, section.limits_deg, section.four_bar
    of_prismatic = section.offset_mm, section.limits_mm
    if any(of_revolute if is_prismatic else of_prismatic):
        unit = joint.file_unit
        raise RobotError(
            f"the joint '{joint.name}' is {joint.type}, but its entry has keys of the other joint type",
            expected=f"offset_{unit} and limits_{unit}",
            value=joint.name,
            option="coupling",
            remedy=f"state offset_{unit} and limits_{unit} only",
        )
    return section.offset_mm / 1e3 if is_prismatic else float(np.deg2rad(section.offset_deg))


def coupling_document(coupling: Coupling, joints: Sequence[Row]) -> list[dict[str, object]]:
    """Return the sections of a coupling as plain values; the inverse of `rows_and_coupling`."""
    result: list[dict[str, object]] = []
    bars, stops = dict(coupling.four_bars), dict(coupling.stops)
    for index, (joint, factors) in enumerate(zip(joints, coupling.matrix.tolist(), strict=True)):
        stated = {
            axis.name: factor
            * (joint.in_file_unit(1.0) / axis.in_file_unit(1.0) if axis.type != joint.type else 1.0)
            for axis, factor, named in zip(
                coupling.axes, factors, coupling.is_factor_stated[index], strict=True
            )
            if factor or named
        }
        offset = float(coupling.offset[index])
        if not coupling.is_factor_stated[index].any():
            continue
        entry: dict[str, object] = {"joint": joint.name, "factors": stated}
        entry |= {f"offset_{joint.file_unit}": joint.in_file_unit(offset)} if offset else {}
        if index in stops:
            entry[f"limits_{joint.file_unit}"] = [joint.in_file_unit(bound) for bound in stops[index]]
        if index in bars:
            bar = bars[index]
            lengths = ("ground", "crank", "coupler", "rocker")
            entry["four_bar"] = {f"{name}_mm": getattr(bar, name) * 1e3 for name in lengths} | {
                "zero_deg": float(np.rad2deg(bar.zero))
            }
        result.append(entry)
    return result
