"""Joint offsets alone, for controllers on which only the zero positions can be changed."""

from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.deployment.export.approximation import Departure, approximate_model, joint_offsets
from pisigma.deployment.export.dh_table import TABLE_SUFFIXES, csv_table, header_comment, parameter_columns
from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.deployment.export.geometry import offset_remarks
from pisigma.files.errors import RobotError
from pisigma.files.yaml_writing import yaml_text
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot
from pisigma.robot.row import FRAME_COLUMNS, in_file_units


@dataclass(frozen=True, eq=False)
class JointOffsets:
    """Nominal robot with the joint offsets, base and tool that approximate a model best.

    Attributes:
        robot: nominal robot except for theta of revolute and d of prismatic joints, base and tool.
        values: offset of every axis of the controller [rad or m], in the direction of the axis: the real robot
            commanded to q is where the nominal robot is at q + offset.
        unobservable: joints whose offset is set to 0 because base or tool have the same effect.
        departure: remaining deviation from the whole model.
        nominal: deviation of the nominal robot with the model's base and tool, for comparison.
    """

    robot: Robot
    values: Float64[np.ndarray, " axes"]
    unobservable: tuple[str, ...]
    departure: Departure
    nominal: Departure

    def departures(self) -> dict[str, object]:
        """Return both deviations, by their keys in files."""
        return {"off_the_whole_model": asdict(self.departure), "robot_as_drawn": asdict(self.nominal)}


def fit_joint_offsets(model: CalibratedModel) -> JointOffsets:
    """Fit joint offsets, base and tool of the nominal robot to a model; see `approximate_model`.

    Raises:
        ModelError: the model has no stored joint values, or no predictions at them.
        RobotError: see `joints_by_axes`.
    """
    nominal = model.robot
    fit = approximate_model(model, nominal, joint_offsets(nominal))
    return JointOffsets(
        robot=fit.robot,
        values=offsets_between(nominal, fit.robot),
        unobservable=tuple(
            j.name for j, free in zip(nominal.joints, fit.observable, strict=True) if not free
        ),
        departure=fit.deviation_of(fit.robot),
        nominal=fit.deviation_of(nominal),
    )


def offsets_between(nominal: Robot, corrected: Robot) -> Float64[np.ndarray, " axes"]:
    """Return the offsets of a corrected robot's zero positions from nominal, per axis of the controller [rad or m].

    Raises:
        RobotError: see `joints_by_axes`.
    """
    change = (corrected.dh - nominal.dh).reshape(-1)[list(joint_offsets(nominal))]
    offsets: np.ndarray = np.linalg.solve(joints_by_axes(nominal), change)
    return offsets


def joints_by_axes(robot: Robot) -> Float64[np.ndarray, "dof axes"]:
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


def departure_sentence(subject_and_verb: str, departure: Departure, nominal: Departure) -> str:
    """Return a sentence on the deviation from the whole model, compared with that of the nominal robot."""
    return (
        f"{subject_and_verb} from the whole model by {departure.mean_mm:.4g} mm on average, "
        f"{departure.p95_mm:.4g} mm at the 95 % quantile, {departure.max_mm:.4g} mm at most, "
        f"and {departure.mean_mrad:.4g} mrad on average (the nominal robot with "
        f"the model's base and tool: {nominal.mean_mm:.4g}, {nominal.p95_mm:.4g}, {nominal.max_mm:.4g} mm "
        f"and {nominal.mean_mrad:.4g} mrad)."
    )


def offset_sentences(offsets: JointOffsets) -> tuple[str, ...]:
    """Return sentences on the meaning of the offsets and their loss of accuracy."""
    sentences = [_MEANING, departure_sentence("Offsets alone deviate", offsets.departure, offsets.nominal)]
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
