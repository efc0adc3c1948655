"""Joint offsets alone: the most that a controller can take which knows nothing but its zero positions."""

from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.deployment.export.dh_table import TABLE_SUFFIXES, cells, csv_table, head
from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.deployment.export.geometry import offset_remarks
from pisigma.deployment.export.projection import Departure, joint_offsets, project_model
from pisigma.files.errors import RobotError
from pisigma.files.yaml_file import yaml_text
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot
from pisigma.robot.row import FRAME_COLUMNS, in_file_units


@dataclass(frozen=True, eq=False)
class JointOffsets:
    """The robot as drawn with the joint offsets, base and tool that come nearest to a model.

    Attributes:
        robot: as drawn but for theta of turning and d of sliding joints, base and tool.
        values: per axis of the controller [rad or m], as it counts: the real robot commanded to q stands where the
            drawn one stands at q + offset.
        unobservable: joints whose offset is 0 because base or tool take the same in.
        lost: what is given up: departure from the whole model.
        nominal: the departure of the robot as drawn, with the model's base and tool, for comparison.
    """

    robot: Robot
    values: Float64[np.ndarray, " axes"]
    unobservable: tuple[str, ...]
    lost: Departure
    nominal: Departure

    def departures(self) -> dict[str, object]:
        """Both departures, by their keys in files."""
        return {"off_the_whole_model": asdict(self.lost), "robot_as_drawn": asdict(self.nominal)}


def fit_joint_offsets(model: CalibratedModel) -> JointOffsets:
    """Fit joint offsets, base and tool of the robot as drawn to a model; see `project_model`.

    Raises:
        ModelError: the model stores no joint values, or predicts none of their poses.
        RobotError: see `joints_by_axes`.
    """
    nominal = model.robot
    fit = project_model(model, nominal, joint_offsets(nominal))
    return JointOffsets(
        robot=fit.robot,
        values=offsets_between(nominal, fit.robot),
        unobservable=tuple(
            j.name for j, free in zip(nominal.joints, fit.observable, strict=True) if not free
        ),
        lost=fit.departure(fit.robot),
        nominal=fit.departure(nominal),
    )


def offsets_between(nominal: Robot, moved: Robot) -> Float64[np.ndarray, " axes"]:
    """Offsets [rad or m] of a robot's zeros against another's, as the controller counts.

    Raises:
        RobotError: see `joints_by_axes`.
    """
    change = (moved.dh - nominal.dh).reshape(-1)[list(joint_offsets(nominal))]
    offsets: np.ndarray = np.linalg.solve(joints_by_axes(nominal), change)
    return offsets


def joints_by_axes(robot: Robot) -> Float64[np.ndarray, "dof axes"]:
    """How theta or d of every joint changes with the offset of every axis that the controller commands.

    Raises:
        RobotError: a joint is passive or driven by a four-bar linkage, whose zero is not that of an axis alone.
    """
    if robot.coupling is None:
        return np.diag(robot.directions)
    if robot.coupling.passive or robot.coupling.four_bars:
        raise RobotError(
            f"robot '{robot.name}' has joints that are passive or driven by a linkage: no offset of an axis of "
            "the controller stands for theirs. Take --format dh or targets."
        )
    matrix: np.ndarray = robot.directions[:, None] * robot.coupling.matrix
    return matrix


MEANING = (
    "The real robot commanded to q stands where the robot as drawn stands at q + offset: command q - offset, "
    "or put the offset into the controller's zero positions. Base and tool were fitted anew for this."
)


def departure_sentence(what: str, lost: Departure, nominal: Departure) -> str:
    """How far off the whole model something is, and for comparison the robot as drawn."""
    return (
        f"{what} off the whole model by {lost.mean_mm:.4g} mm in the mean, {lost.p95_mm:.4g} mm in 95 "
        f"% of its poses, {lost.max_mm:.4g} mm at most, and {lost.mean_mrad:.4g} mrad in the mean (the robot as "
        f"drawn, on the model's base and tool: {nominal.mean_mm:.4g}, {nominal.p95_mm:.4g}, "
        f"{nominal.max_mm:.4g} mm and {nominal.mean_mrad:.4g} mrad)."
    )


def offset_sentences(offsets: JointOffsets) -> tuple[str, ...]:
    """What the offsets mean and what they give up."""
    said = [MEANING, departure_sentence("Offsets alone are", offsets.lost, offsets.nominal)]
    if offsets.unobservable:
        said.append(f"Base or tool take in the offset of {', '.join(offsets.unobservable)}, which is 0 here.")
    return tuple(said)


def offsets_csv(offsets: JointOffsets, comments: tuple[str, ...] = ()) -> str:
    """One line a joint, then base and tool; cells that do not apply are empty."""
    frame = in_file_units(FRAME_COLUMNS, offsets.robot.base)
    columns = ("part", "name", "type", "offset_deg", "offset_mm", *frame)
    lines = [{"part": "joint", **entry} for entry in _joints(offsets)]
    lines += [{"part": p, **cells(FRAME_COLUMNS, getattr(offsets.robot, p))} for p in ("base", "tool")]
    return csv_table(columns, lines, (*comments, *offset_sentences(offsets)))


def offsets_yaml(offsets: JointOffsets, comments: tuple[str, ...] = ()) -> str:
    """Offsets, base, tool and what they give up."""
    document: dict[str, object] = {"robot": offsets.robot.name, "joints": _joints(offsets)}
    for part in ("base", "tool"):
        document[part] = in_file_units(FRAME_COLUMNS, getattr(offsets.robot, part))
    body = yaml_text(document | offsets.departures())
    return head((*comments, *offset_sentences(offsets))) + body


def _joints(offsets: JointOffsets) -> list[dict[str, object]]:
    return [
        {"name": axis.name, "type": axis.type, f"offset_{axis.file_unit}": axis.in_file_unit(value)}
        for axis, value in zip(offsets.robot.axes, offsets.values, strict=True)
    ]


def _write(request: ExportRequest) -> Exported:
    model = request.load()
    offsets, said = fit_joint_offsets(model), offset_remarks(model)
    text = (offsets_csv if request.as_csv else offsets_yaml)(offsets, said)
    return Exported(text, model_facts(model) | offsets.departures(), (*said, *offset_sentences(offsets)))


FORMAT = ExportFormat(
    "offsets", "a table of joint offsets", TABLE_SUFFIXES, _write, frozenset(("payload_kg", "temperature_c"))
)
