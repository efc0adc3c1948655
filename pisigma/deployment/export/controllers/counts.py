"""Joint offsets in encoder counts, such as Epson's home offsets and FANUC's mastering counts."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from pisigma.deployment.export.approximation import joint_offset_indices
from pisigma.deployment.export.controllers.controller_file import (
    ControllerFile,
    FileContent,
    untested_sentence,
)
from pisigma.deployment.export.dh_table import csv_table, parameter_columns
from pisigma.deployment.export.export_format import ExportRequest
from pisigma.deployment.export.joint_offsets import joint_derivatives_by_axis, offsets_between, read_offsets
from pisigma.files.errors import OutputError
from pisigma.robot.description import Robot
from pisigma.robot.row import FRAME_COLUMNS, in_file_units

COLUMNS = ("counts_per_turn", "present_count", "new_count")


@dataclass(frozen=True)
class EncoderCounts:
    """Zero positions of joints in encoder counts.

    The controller computes a joint value as (encoder - count) / (counts per turn), so an offset that is added to the
    joint value is subtracted from the count.

    Attributes:
        per_turn: encoder counts per turn of the joint, including the gear, or per 1 mm of a prismatic joint; negative
            if the encoder counts in the opposite direction.
        present: current counts of the controller.
        new: counts to enter.
    """

    per_turn: Float64[np.ndarray, " axes"]
    present: Int64[np.ndarray, " axes"]
    new: Int64[np.ndarray, " axes"]

    def offsets(self, robot: Robot) -> Float64[np.ndarray, " axes"]:
        """Return the joint offsets [rad or m] that result from the new counts."""
        offsets: np.ndarray = (self.present - self.new) / self.per_turn * _unit(robot)
        return offsets


def _unit(robot: Robot) -> Float64[np.ndarray, " axes"]:
    """Return one turn or 1 mm for every axis of the controller [rad or m]."""
    return np.where([axis.type == "revolute" for axis in robot.axes], 2 * np.pi, 1e-3)


def write_counts(content: FileContent) -> str:
    """Return one line per joint with its counts and the offset of the rounded counts, then base and tool."""
    nominal, robot, request = content.nominal, content.robot, content.request
    per_turn = _numbers(request.counts_per_turn, "counts-per-turn", nominal)
    present = _numbers(request.present_counts, "present-counts", nominal)
    if (present % 1).any() or not per_turn.all():
        raise OutputError(
            "expected integers in --present-counts and no zero in --counts-per-turn",
            option="--present-counts" if (present % 1).any() else "--counts-per-turn",
            value=request.present_counts if (present % 1).any() else request.counts_per_turn,
        )
    moved = offsets_between(nominal, robot) / _unit(nominal) * per_turn
    counts = EncoderCounts(per_turn, present.astype(np.int64), np.rint(present - moved).astype(np.int64))
    lines: list[dict[str, object]] = []
    columns = (counts.per_turn, counts.present, counts.new, counts.offsets(nominal))
    for axis, *values, offset in zip(nominal.axes, *columns, strict=True):
        entry = {"part": "joint", "name": axis.name, f"offset_{axis.file_unit}": axis.in_file_unit(offset)}
        lines.append(entry | {column: f"{value:.17g}" for column, value in zip(COLUMNS, values, strict=True)})
    lines += [
        {"part": part, **parameter_columns(FRAME_COLUMNS, getattr(robot, part))} for part in ("base", "tool")
    ]
    frame = in_file_units(FRAME_COLUMNS, robot.base)
    return csv_table(("part", "name", "offset_deg", "offset_mm", *COLUMNS, *frame), lines, content.comments)


def _numbers(stated: str | None, option: str, robot: Robot) -> Float64[np.ndarray, " axes"]:
    """Read the numbers of an option, one per joint."""
    try:
        values = np.array([float(word) for word in (stated or "").split(",")])
    except ValueError:
        values = np.array([np.nan])
    if len(values) != len(robot.axes) or not np.isfinite(values).all():
        raise OutputError(
            expected=f"{len(robot.axes)} comma-separated numbers, one per joint of robot '{robot.name}'",
            value=stated or "",
            option=f"--{option}",
        )
    return values


def check_robot(robot: Robot) -> None:
    """Raise an error for robots whose axes have no separate zero positions; see `joint_derivatives_by_axis`."""
    joint_derivatives_by_axis(robot)


def _refuse(request: ExportRequest) -> None:
    for name, value in (
        ("counts-per-turn", request.counts_per_turn),
        ("present-counts", request.present_counts),
    ):
        if value is None:
            raise OutputError(
                "this format needs one number per joint in encoder counts",
                option=f"--{name}",
                remedy="give both --counts-per-turn (encoder counts per turn of the joint, including its gear, or "
                "per 1 mm) and --present-counts (current counts of the controller)",
            )


_SIGN = (
    "The controller has to compute joint values as (encoder - count) / (counts per turn); test one joint first, and "
    "give negative counts per turn if it moves in the opposite direction.",
    "The file includes neither link lengths nor angles between axes. Command the joint values of the controller as "
    "before; set the base and tool below on the controller.",
)


def _file(name: str, contents: str, source: str, meaning: str) -> ControllerFile:
    return ControllerFile(
        name=name,
        contents=contents,
        suffixes=(".csv",),
        source=untested_sentence(source),
        requirements=(meaning, *_SIGN),
        text=write_counts,
        read=read_offsets,
        check=check_robot,
        parameters=joint_offset_indices,
        options=frozenset(("counts_per_turn", "present_counts")),
        refuse=_refuse,
        contains="joint_zeros",
    )


EPSON = _file(
    "epson",
    "the home offsets of an Epson controller",
    "download.epson.biz/robots, SPEL+ language reference, Hofs and HofsJointAccuracy",
    "Enter the new counts with Hofs (or HofsJointAccuracy), joint 1 first; the current counts are those that Hofs "
    "displays.",
).export_format()
FANUC = _file(
    "fanuc-mastering",
    "the mastering counts of a FANUC controller",
    "industrialmonitordirect.com, Reset FANUC Extended Axis Master Count; position = (encoder - master count) * scale",
    "Enter the new counts into $DMR_GRP[1].$MASTER_COUN, joint 1 first; the current counts are those of that variable. "
    "Counts per turn are the encoder counts per motor turn times the gear ratio of the joint.",
).export_format()
