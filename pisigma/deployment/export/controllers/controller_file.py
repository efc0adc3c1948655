"""Files of robot controllers: parameters, writing and reading, and loss of accuracy."""

import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib import import_module
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from pisigma.deployment.export.approximation import (
    ToolDeviation,
    all_parameter_indices,
    approximate_model,
    departure_from_nominal,
)
from pisigma.deployment.export.dh_table import TABLE_SUFFIXES
from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.deployment.export.geometry import corrects_joints, pose_remarks
from pisigma.deployment.export.joint_offsets import departure_sentence, read_offsets
from pisigma.deployment.export.registry import BUILT_IN
from pisigma.files.errors import Place, RobotError
from pisigma.files.input_file import read_text
from pisigma.lifetime.cell.exports import Contents
from pisigma.robot.description import Robot
from pisigma.robot.row import FRAME_COLUMNS, in_file_units

_CONDITIONS = frozenset(("payload_kg", "temperature_c"))
_NUMBER = r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?"
MAX_CHANGE = 5.0
"""Largest plausible mean distance [mm] between the tools of a calibrated and the nominal robot on the same base; the
largest in five published calibrations of Universal Robots arms is 4.2 mm."""

_LEVER = 0.1
"""Distance from the flange [m] of points to which the limit also applies, so that rotations of the flange count."""


@dataclass(frozen=True)
class FileContent:
    """Data from which the text of a file is written.

    Attributes:
        robot: robot with the geometry for the file.
        nominal: robot of the controller without the file.
        request: model, file and options.
        comments: sentences for the comments of the file.
    """

    robot: Robot
    nominal: Robot
    request: ExportRequest
    comments: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ControllerFrames:
    """Frames of a controller relative to the frames of a robot description.

    Attributes:
        sentence: sentence that states the frames.
        base_in_pose_frame: the controller's base frame in the frame of the description's poses, as `FRAME_COLUMNS`.
        tool_in_controller_flange: the description's tool relative to the controller's flange.
    """

    sentence: str
    base_in_pose_frame: Float64[np.ndarray, " 6"]
    tool_in_controller_flange: Float64[np.ndarray, " 6"]

    def to_json(self) -> dict[str, object]:
        """Return plain values for `--json`."""
        base, tool = (
            in_file_units(FRAME_COLUMNS, one)
            for one in (self.base_in_pose_frame, self.tool_in_controller_flange)
        )
        return {"said": self.sentence, "base": base, "tool": tool}


@dataclass(frozen=True, eq=False)
class ControllerRobot:
    """A controller's description of a robot.

    Attributes:
        nominal: robot of the controller without the file, in its frames and parameters.
        frames: frames of the controller relative to frames of the robot description; None if they are equal.
        published_values: values published by the manufacturer or a user with which the file was tested, and their
            source; None if there are none.
    """

    nominal: Robot
    frames: ControllerFrames | None = None
    published_values: str | None = None

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return sentences on the tests of the file and the frames of its poses."""
        tried = (
            f"Reading and writing were tested against {self.published_values}."
            if self.published_values
            else f"No published values were found to test this file for robot '{self.nominal.name}': compare the "
            "controller's position with that of pisigma at several joint values before you use it."
        )
        return (tried, self.frames.sentence) if self.frames else (tried,)


@dataclass(frozen=True)
class ControllerFile:
    """One kind of file.

    Attributes:
        name: name of the `--format`.
        contents: contents of a file, with an article.
        suffixes: suffixes of its files.
        source: sentence on the source of the format and its tests; see `untested_sentence`.
        controller_robot: function that returns the controller's description of a robot, or raises a `PisigmaError` if
            there is none.
        requirements: sentences on what the file requires of the controller.
        text: function that returns the text of a file.
        read: function of text, file name and nominal robot that returns the robot of a file; None if the file includes
            base and tool and is loaded as a robot file.
        check: function that raises a `PisigmaError` for robots that the file cannot describe.
        parameters: function that returns the indices into the flattened `Robot.dh` of the parameters in the file.
        options: options of `OPTIONS` that the format accepts.
        refuse: function that raises a `PisigmaError` for invalid requests before anything is loaded.
        contains: contents of a file of this format.
        marker: beginning of a line that other files with these suffixes do not have; empty if there are no others.
    """

    name: str
    contents: str
    suffixes: tuple[str, ...]
    source: str
    requirements: tuple[str, ...]
    text: Callable[[FileContent], str]
    read: Callable[[str, str, Robot], Robot] | None
    check: Callable[[Robot], None]
    controller_robot: Callable[[Robot], ControllerRobot] = ControllerRobot
    parameters: Callable[[Robot], Sequence[int]] = all_parameter_indices
    options: frozenset[str] = field(default_factory=frozenset)
    refuse: Callable[[ExportRequest], None] = lambda request: None
    contains: Contents = "kinematics"
    marker: str = ""

    def export_format(self) -> ExportFormat:
        """Return the file as a format for `pisigma export`."""
        return ExportFormat(
            self.name,
            self.contents,
            self.suffixes,
            self.write,
            self.options | _CONDITIONS,
            self.refuse,
            self.contains,
        )

    def write(self, request: ExportRequest) -> Exported:
        """Project the model onto the parameters of the file, and evaluate the loss of accuracy by rereading the file.

        Raises:
            PisigmaError: the model cannot be loaded or projected, or the file cannot describe its robot.
        """
        model = request.load()
        nominal = model.robot
        self.check(nominal)
        parameters = self.parameters(nominal)
        whole = len(parameters) == nominal.dh.size
        start = model.calibrated if whole and model.calibrated is not None else nominal
        fit = approximate_model(model, start, parameters)
        draft, held = FileContent(fit.robot, nominal, request), fit.robot
        if self.read is not None:
            held = self.read(self.text(draft), str(request.out), nominal)
        lost, of_nominal = fit.deviation_of(held), fit.deviation_of(nominal)
        title = f"{self.contents[0].upper()}{self.contents[1:]} of model {model.name} (robot {nominal.name})."
        described = self.controller_robot(model.nominal or nominal)
        sentences = [
            title,
            self.source,
            *described.remarks,
            departure_sentence("This file deviates", lost, of_nominal),
        ]
        if corrects_joints(model):
            sentences.append(
                "It does not include a learned joint correction: its geometry is the nearest approximation of the "
                "whole model."
            )
        sentences += [*self.requirements, *pose_remarks(model)]
        facts = {"off_the_whole_model": asdict(lost), "robot_as_drawn": asdict(of_nominal)}
        facts |= {part: in_file_units(FRAME_COLUMNS, getattr(held, part)) for part in ("base", "tool")}
        if described.frames:
            facts["frames"] = described.frames.to_json()
        text = self.text(replace(draft, comments=tuple(sentences)))
        return Exported(text, model_facts(model) | facts, tuple(sentences))


def untested_sentence(source: str) -> str:
    """Return the sentence about a file that was not tested on a controller."""
    return f"Written from the published description ({source}), not tested on a controller."


def frame_sentences(robot: Robot) -> tuple[str, ...]:
    """Return base and tool as comments for files without them; `with_frames_from_comments` reads them back."""
    sentences = []
    for part in ("base", "tool"):
        values = in_file_units(FRAME_COLUMNS, getattr(robot, part)).items()
        sentences.append(f"{part}: " + ", ".join(f"{column} {value + 0.0!r}" for column, value in values))
    return tuple(sentences)


def with_frames_from_comments(robot: Robot, text: str) -> Robot:
    """Return the robot with base and tool from the comments of a text, if there are any."""
    frames: dict[str, np.ndarray] = {}
    for part in ("base", "tool"):
        columns = in_file_units(FRAME_COLUMNS, np.zeros(6))
        pattern = f"{part}: " + ", ".join(f"{column} ({_NUMBER})" for column in columns)
        if match := re.search(pattern, text):
            values = [float(value) for value in match.groups()]
            frames[part] = np.array([*(value / 1e3 for value in values[:3]), *np.deg2rad(values[3:])])
    return robot.with_geometry(base=frames.get("base"), tool=frames.get("tool"))


def check_plain_joints(robot: Robot, kind: str, count: int | None = None) -> None:
    """Check that all rows of a robot are joints, and optionally their number and type.

    Args:
        robot: robot to check.
        kind: name of the file for messages.
        count: expected number of joints, which must all be revolute and not reversed; None for any number and type.

    Raises:
        RobotError: the robot does not comply.
    """
    turning = sum(robot.revolute)
    if count is not None and ((turning, robot.dof) != (count, count) or (robot.directions < 0).any()):
        raise RobotError(
            f"{kind} requires {count} revolute joints without reversed directions; robot '{robot.name}' has {turning} "
            f"revolute and {robot.dof - turning} prismatic joints, {int((robot.directions < 0).sum())} of them "
            "reversed",
            value=robot.name,
            expected=f"{count} revolute joints",
            remedy="choose another --format",
        )
    if len(robot.rows) != robot.dof:
        raise RobotError(
            f"{kind} has one row per joint, but robot '{robot.name}' has {len(robot.rows) - robot.dof} additional "
            "fixed rows",
            value=robot.name,
            expected="one row per joint",
            remedy="choose --format urdf or dh",
        )


@dataclass(frozen=True, eq=False)
class ControllerReading:
    """Result of reading a controller's file.

    Attributes:
        robot: nominal robot with the parameters of the file; its `source` names the file and the frames of its poses.
        deviation_from_nominal: distance between its tool and that of the nominal robot, in the same frame.
        frames: frames of the controller relative to frames of the nominal robot; None if they are equal.
        remarks: sentences on the description of the format, its tests, and the frames of poses.
    """

    robot: Robot
    deviation_from_nominal: ToolDeviation
    frames: ControllerFrames | None
    remarks: tuple[str, ...]


def read_controller_file(path: Path, nominal: Robot, max_change_mm: float = MAX_CHANGE) -> ControllerReading:
    """Read a controller's file as a robot.

    Supported files are Universal Robots' calibration.conf, the kinematics YAML of their ROS driver, Staubli's arm.cfx,
    and tables of joint offsets or counts written by pisigma. Xacro and URDF files need no nominal robot; load them with
    `Robot.load`.

    Args:
        path: file to read.
        nominal: robot of the controller without the file, which provides names and limits, and base and tool if the
            file has none.
        max_change_mm: largest accepted mean distance [mm] between the two tools in the same frame, and between points
            at `_LEVER` from them due to their rotations.

    Raises:
        RobotError: the file cannot be read, is of another kind, does not match the robot, or changes it by more than
            `max_change_mm`.
    """
    suffix, kinds = path.suffix.lower(), _kinds()
    suffixes = dict.fromkeys([*(one for kind in kinds for one in kind.suffixes), *TABLE_SUFFIXES])
    if suffix not in suffixes:
        raise RobotError(
            expected=f"a controller's file with the suffix {' or '.join(suffixes)}",
            value=suffix,
            at=Place(path),
        )
    text = read_text(path, RobotError, "text")
    suited = (kind for kind in kinds if suffix in kind.suffixes and f"\n{kind.marker}" in f"\n{text}")
    file = next(suited, None)
    read = read_offsets if file is None or file.read is None else file.read
    robot = read(text, str(path), nominal)
    described = file.controller_robot(nominal) if file else ControllerRobot(nominal)
    # The base and tool of the file define the frames of its poses and are not treated as changes by the calibration.
    there = nominal.with_geometry(base=robot.base, tool=robot.tool)
    change = departure_from_nominal(
        robot, with_frames_from_comments(described.nominal, text) if file else there
    )
    if not max(change.mean_mm, _LEVER * change.mean_mrad) <= max_change_mm:
        raise RobotError(
            f"expected a calibration that moves the tool by at most {max_change_mm:g} mm and "
            f"{max_change_mm / _LEVER:g} mrad on average, got {change.mean_mm:.4g} mm and "
            f"{change.mean_mrad:.4g} mrad relative to robot '{nominal.name}'",
            expected=f"a mean change of at most {max_change_mm:g} mm",
            value=change.mean_mm,
            at=Place(path),
            remedy="check that --like is the robot of this file and that its units are radians and metres, or state "
            "--max-change-mm",
        )
    frames = described.frames
    source = f"Read from {path.name} with the nominal robot '{nominal.name}'."
    source = f"{source} {frames.sentence}" if frames else source
    remarks = (
        (file.source, *described.remarks)
        if file
        else ("Tables of offsets and counts are a format of pisigma.",)
    )
    return ControllerReading(replace(robot, source=source), change, frames, remarks)


def _kinds() -> list[ControllerFile]:
    """Return the registered kinds of manufacturers' files that are read with a nominal robot."""
    modules = dict.fromkeys(module for module, _ in BUILT_IN.values() if module.startswith(__package__))
    files = [getattr(import_module(module.partition(":")[0]), "FILE", None) for module in modules]
    return [file for file in files if file is not None and file.read is not None]
