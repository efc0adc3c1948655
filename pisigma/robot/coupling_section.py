"""Coupled joints as robot files state them, in millimetres and degrees."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydantic import Field

from pisigma.files.errors import RobotError, nearest_choice
from pisigma.files.yaml_file import Section
from pisigma.robot.coupling import Coupling, FourBar, hull
from pisigma.robot.row import LARGEST, Bounded, Row


class FourBarSection(Section):
    """The lengths of a linkage, and the angle of its crank where factors and offset give 0; see `FourBar`."""

    ground_mm: float = Field(gt=0, le=LARGEST)
    crank_mm: float = Field(gt=0, le=LARGEST)
    coupler_mm: float = Field(gt=0, le=LARGEST)
    rocker_mm: float = Field(gt=0, le=LARGEST)
    zero_deg: Bounded

    def to_si(self) -> FourBar:
        """The linkage in SI units."""
        lengths = (self.ground_mm, self.crank_mm, self.coupler_mm, self.rocker_mm)
        ground, crank, coupler, rocker = (length / 1e3 for length in lengths)
        return FourBar(ground, crank, coupler, rocker, float(np.deg2rad(self.zero_deg)))


class CoupledJointSection(Section):
    """How one joint follows the controller's values: `q_dh = f(sum of factor · q_controller + offset)`.

    Attributes:
        joint: name of its row.
        factors: by name of a row, how far the joint moves for 1 deg (1 mm) of the controller's value of that name, in
            the joint's own deg (mm); 0 for those that are not named, the joint's own included. What is named, be it
            with 0, is what the errors of the joint may depend on.
        offset_deg: of a joint that turns.
        offset_mm: of a joint that slides.
        four_bar: the linkage that drives it, if one does.
        limits_deg: mechanical stops of a joint that turns, which hold besides the limits of the controller's values.
        limits_mm: the same of a joint that slides.
    """

    joint: str
    factors: dict[str, Bounded] = Field(min_length=1)
    offset_deg: Bounded = 0.0
    offset_mm: Bounded = 0.0
    four_bar: FourBarSection | None = None
    limits_deg: tuple[Bounded, Bounded] | None = None
    limits_mm: tuple[Bounded, Bounded] | None = None


def coupled(
    rows: Sequence[Row], sections: Sequence[CoupledJointSection]
) -> tuple[tuple[Row, ...], Coupling | None]:
    """Give the rows with the limits of their DH values, and how these follow the controller's.

    A joint that no section names is what the controller counts. One that a section names, but of which no section has
    a factor, is passive: the controller has no value for it.

    Args:
        rows: of the robot, with the limits of the controller's values.
        sections: as in the file.

    Raises:
        RobotError: a name, unit or factor does not fit; the message says which.
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
                f"coupling: the joint '{joint.name}' is passive, so the controller has no limits for it; remove them."
            )
    plain = [CoupledJointSection(joint=joint.name, factors={joint.name: 1.0}) for joint in joints]
    stated = [by_name.get(section.joint, section) for section in plain]
    pairs = list(zip(joints, stated, strict=True))
    coupling = Coupling(
        axes=tuple(axes),
        turning=tuple(joint.type == "revolute" for joint in joints),
        matrix=np.array([[_factor(section, joint, axis) for axis in axes] for joint, section in pairs]),
        offset=np.array([_offset(joint, section) for joint, section in pairs]),
        driven=np.array([[s.joint in by_name and axis.name in s.factors for axis in axes] for s in stated]),
        four_bars=tuple((i, s.four_bar.to_si()) for i, s in enumerate(stated) if s.four_bar is not None),
        stops=tuple(
            (index, (joint.from_file_unit(limits[0]), joint.from_file_unit(limits[1])))
            for index, (joint, section) in enumerate(pairs)
            if (limits := section.limits_deg or section.limits_mm)
        ),
    )
    limits = iter(hull(coupling).tolist())
    return tuple(row if row.type == "fixed" else _within(row, *next(limits)) for row in rows), coupling


def _check_names(sections: Sequence[CoupledJointSection], names: Sequence[str]) -> None:
    """Refuse entries of joints that there are not, or twice."""
    for name in (name for section in sections for name in (section.joint, *section.factors)):
        if name not in names:
            raise RobotError(f"coupling: there is no joint '{name}'; {nearest_choice(name, names)}")
    if len({section.joint for section in sections}) < len(sections):
        raise RobotError("coupling: a joint has two entries; join them, one per joint.")


def _factor(section: CoupledJointSection, joint: Row, axis: Row) -> float:
    """By how many [rad or m] a joint moves per [rad or m] of an axis."""
    factor = section.factors.get(axis.name, 0.0)
    return factor if axis.type == joint.type else factor * axis.in_file_unit(1.0) / joint.in_file_unit(1.0)


def _within(row: Row, lower: float, upper: float) -> Row:
    return replace(row, lower=lower, upper=upper)


def _offset(joint: Row, section: CoupledJointSection) -> float:
    """The offset of a joint [rad or m]."""
    sliding = joint.type == "prismatic"
    turning = section.offset_deg, section.limits_deg, section.four_bar
    length = section.offset_mm, section.limits_mm
    if any(turning if sliding else length):
        unit = joint.file_unit
        raise RobotError(
            f"coupling: the joint '{joint.name}' is {joint.type}; state offset_{unit} and limits_{unit} and nothing "
            "that belongs to the other kind."
        )
    return section.offset_mm / 1e3 if sliding else float(np.deg2rad(section.offset_deg))


def coupling_document(coupling: Coupling, joints: Sequence[Row]) -> list[dict[str, object]]:
    """The sections that `coupled` makes a coupling of, as plain values."""
    result: list[dict[str, object]] = []
    bars, stops = dict(coupling.four_bars), dict(coupling.stops)
    for index, (joint, factors) in enumerate(zip(joints, coupling.matrix.tolist(), strict=True)):
        stated = {
            axis.name: factor
            * (joint.in_file_unit(1.0) / axis.in_file_unit(1.0) if axis.type != joint.type else 1.0)
            for axis, factor, named in zip(coupling.axes, factors, coupling.driven[index], strict=True)
            if factor or named
        }
        offset = float(coupling.offset[index])
        if not coupling.driven[index].any():
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
