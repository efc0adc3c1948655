"""Joint offsets alone, for controllers on which only the zero positions can be changed."""

import csv
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.deployment.export.approximation import ToolDeviation, approximate_model, joint_offset_indices
from pisigma.deployment.export.dh_table import TABLE_SUFFIXES, csv_table, header_comment, parameter_columns
from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.deployment.export.geometry import offset_remarks
from pisigma.files.errors import Phrase, Place, RobotError
from pisigma.files.yaml_file import parse_plain_yaml
from pisigma.files.yaml_writing import yaml_text
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot
from pisigma.robot.robot_file import FrameSection
from pisigma.robot.row import FRAME_COLUMNS, Row, in_file_units


@dataclass(frozen=True, eq=False)
class JointOffsets:
    """Nominal robot with the joint offsets, base and tool that approximate a model best.

    Attributes:
        robot: nominal robot except for theta of revolute and d of prismatic joints, base and tool.
        values: offset of every axis of the controller [rad or m], in the direction of the axis: the real robot
            commanded to q is where the nominal robot is at q + offset.
        unobservable: joints whose offset is set to 0 because base or tool have the same effect.
        remaining_deviation: remaining deviation from the whole model.
        nominal: deviation of the nominal robot with the model's base and tool, for comparison.
    """

    robot: Robot
    values: Float64[np.ndarray, " axes"]
    unobservable: tuple[str, ...]
    remaining_deviation: ToolDeviation
    nominal: ToolDeviation

    def departures(self) -> dict[str, object]:
        """Return both deviations, by their keys in files."""
        return {
            "off_the_whole_model": asdict(self.remaining_deviation),
            "robot_as_drawn": asdict(self.nominal),
        }


def fit_joint_offsets(model: CalibratedModel) -> JointOffsets:
    """Fit joint offsets, base and tool of the nominal robot to a model; see `approximate_model`.

    Raises:
        ModelError: the model has no stored joint values, or no predictions at them.
        RobotError: see `joint_derivatives_by_axis`.
    """
    nominal = model.robot
    fit = approximate_model(model, nominal, joint_offset_indices(nominal))
    return JointOffsets(
        robot=fit.robot,
        values=offsets_between(nominal, fit.robot),
        unobservable=tuple(
            j.name for j, free in zip(nominal.joints, fit.observable, strict=True) if not free
        ),
        remaining_deviation=fit.deviation_of(fit.robot),
        nominal=fit.deviation_of(nominal),
    )


def offsets_between(nominal: Robot, corrected: Robot) -> Float64[np.ndarray, " axes"]:
    """Return the offsets of a corrected robot's zero positions from nominal, per axis of the controller [rad or m].

    Raises:
        RobotError: see `joint_derivatives_by_axis`.
    """
    change = (corrected.dh - nominal.dh).reshape(-1)[list(joint_offset_indices(nominal))]
    offsets: np.ndarray = np.linalg.solve(joint_derivatives_by_axis(nominal), change)
    return offsets


def joint_derivatives_by_axis(robot: Robot) -> Float64[np.ndarray, "dof axes"]:
    """Return the derivative of theta or d of every joint with respect to the offset of every axis of the controller.

    Raises:
        RobotError: a joint is passive or driven by a four-bar linkage, so its zero is not that of a single axis.
    """
    if robot.coupling is None:
        return np.diag(robot.directions)
    if robot.coupling.has_passive_joints or robot.coupling.four_bars:
        raise RobotError(
            f"robot '{robot.name}' has joints that are passive or driven by a linkage, whose offsets are not offsets "
            "of an axis of the controller",
            value=robot.name,
            remedy="choose --format dh or targets",
        )
    matrix: np.ndarray = robot.directions[:, None] * robot.coupling.matrix
    return matrix


_MEANING = (
    "The real robot commanded to q is where the nominal robot is at q + offset: command q - offset, or enter the "
    "offset into the controller's zero positions. Base and tool were fitted together with the offsets."
)


def departure_sentence(
    subject_and_verb: str, departure: ToolDeviation, nominal_deviation: ToolDeviation
) -> str:
    """Return a sentence on the deviation from the whole model, compared with that of the nominal robot."""
    return (
        f"{subject_and_verb} from the whole model by {departure.mean_mm:.4g} mm on average, "
        f"{departure.p95_mm:.4g} mm at the 95 % quantile, {departure.max_mm:.4g} mm at most, "
        f"and {departure.mean_mrad:.4g} mrad on average (the nominal robot with "
        f"the model's base and tool: {nominal_deviation.mean_mm:.4g}, {nominal_deviation.p95_mm:.4g}, "
        f"{nominal_deviation.max_mm:.4g} mm and {nominal_deviation.mean_mrad:.4g} mrad)."
    )


def offset_sentences(offsets: JointOffsets) -> tuple[str, ...]:
    """Return sentences on the meaning of the offsets and their loss of accuracy."""
    sentences = [
        _MEANING,
        departure_sentence("Offsets alone deviate", offsets.remaining_deviation, offsets.nominal),
    ]
    if offsets.unobservable:
        sentences.append(
            f"Offsets of {', '.join(offsets.unobservable)} are 0 because the base or the tool has the same effect."
        )
    return tuple(sentences)


def offsets_csv(offsets: JointOffsets, comments: tuple[str, ...] = ()) -> str:
    """Return joint offsets as CSV: one line per joint, then base and tool; cells that do not apply are empty."""
    frame = in_file_units(FRAME_COLUMNS, offsets.robot.base)
    columns = ("part", "name", "type", "offset_deg", "offset_mm", *frame)
    lines = [{"part": "joint", **entry} for entry in _joints(offsets)]
    lines += [
        {"part": p, **parameter_columns(FRAME_COLUMNS, getattr(offsets.robot, p))} for p in ("base", "tool")
    ]
    return csv_table(columns, lines, (*comments, *offset_sentences(offsets)))


def offsets_yaml(offsets: JointOffsets, comments: tuple[str, ...] = ()) -> str:
    """Return offsets, base, tool and the loss of accuracy as YAML."""
    document: dict[str, object] = {"robot": offsets.robot.name, "joints": _joints(offsets)}
    for part in ("base", "tool"):
        document[part] = in_file_units(FRAME_COLUMNS, getattr(offsets.robot, part))
    body = yaml_text(document | offsets.departures())
    return header_comment((*comments, *offset_sentences(offsets))) + body


def _joints(offsets: JointOffsets) -> list[dict[str, object]]:
    return [
        {"name": axis.name, "type": axis.type, f"offset_{axis.file_unit}": axis.in_file_unit(value)}
        for axis, value in zip(offsets.robot.axes, offsets.values, strict=True)
    ]


def read_offsets(text: str, source: str, nominal: Robot) -> Robot:
    """Apply a table of joint offsets to the nominal robot, with base and tool of the table.

    The table is CSV or YAML as written by `--format offsets`, or CSV with counts, which then determine the offsets.

    Raises:
        RobotError: an entry is missing or not a number, or the joints differ from the joints of the robot.
    """
    entries = _csv_entries(text) if text.lstrip("# ").find("part,") >= 0 else _yaml_entries(text, source)
    joints = {str(entry.get("name")): entry for entry in entries if entry.get("part") == "joint"}
    if set(joints) != {axis.name for axis in nominal.axes}:
        names = ", ".join(axis.name for axis in nominal.axes)
        raise RobotError(
            expected=f"offsets of the joints {names}",
            value=Phrase(", ".join(joints) or "none"),
            at=Place(source),
        )
    offsets = np.array([_offset(axis, joints[axis.name], source) for axis in nominal.axes])
    dh = nominal.dh.copy()
    dh.reshape(-1)[list(joint_offset_indices(nominal))] += joint_derivatives_by_axis(nominal) @ offsets
    frames = {
        str(entry["part"]): _frame(entry, source)
        for entry in entries
        if entry.get("part") in ("base", "tool")
    }
    return nominal.with_geometry(dh=dh, base=frames.get("base"), tool=frames.get("tool"))


def _csv_entries(text: str) -> list[Mapping[str, object]]:
    lines = (line for line in text.splitlines() if not line.startswith("#"))
    return [dict(line) for line in csv.DictReader(lines)]


def _yaml_entries(text: str, source: str) -> list[Mapping[str, object]]:
    content = parse_plain_yaml(text, RobotError, source)
    joints = content.get("joints") if isinstance(content, dict) else None
    if not isinstance(joints, list) or not all(isinstance(joint, dict) for joint in joints):
        raise RobotError(
            expected="a table of joint offsets as written by --format offsets",
            at=Place(source, column="joints"),
        )
    frames = [
        {"part": part, **content[part]} for part in ("base", "tool") if isinstance(content.get(part), dict)
    ]
    return [*({"part": "joint", **joint} for joint in joints), *frames]


def _offset(axis: Row, entry: Mapping[str, object], source: str) -> float:
    """Return the offset [rad or m], from the counts if there are some."""
    turn, millimetre = 2 * np.pi, 1e-3
    if entry.get("new_count"):
        present, new, per_turn = (
            _number(entry, column, source) for column in ("present_count", "new_count", "counts_per_turn")
        )
        return (present - new) / per_turn * (turn if axis.type == "revolute" else millimetre)
    value = _number(entry, f"offset_{axis.file_unit}", source)
    return float(np.deg2rad(value)) if axis.type == "revolute" else value * millimetre


def _frame(entry: Mapping[str, object], source: str) -> np.ndarray:
    columns = FrameSection.model_fields
    return FrameSection(**{column: _number(entry, column, source) for column in columns}).to_si()


def _number(entry: Mapping[str, object], column: str, source: str) -> float:
    try:
        value = float(str(entry.get(column)))
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise RobotError(
            f"expected a finite number for {entry.get('name', entry.get('part'))}, got {entry.get(column)!r}",
            expected="a finite number",
            value=entry.get(column),
            at=Place(source, column=column),
        )
    return value


def _write(request: ExportRequest) -> Exported:
    model = request.load()
    offsets, sentences = fit_joint_offsets(model), offset_remarks(model)
    text = (offsets_csv if request.is_csv else offsets_yaml)(offsets, sentences)
    return Exported(text, model_facts(model) | offsets.departures(), (*sentences, *offset_sentences(offsets)))


FORMAT = ExportFormat(
    "offsets",
    "a table of joint offsets",
    TABLE_SUFFIXES,
    _write,
    frozenset(("payload_kg", "temperature_c")),
    contains="joint_zeros",
)
