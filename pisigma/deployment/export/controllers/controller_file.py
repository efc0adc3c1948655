"""What a controller's own file is: what it can hold, how it is written and read, and what it gives up."""

import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np
from jaxtyping import Float64

from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.deployment.export.geometry import condition_remarks, corrects_joints, frame_remarks
from pisigma.deployment.export.joint_offsets import departure_sentence
from pisigma.deployment.export.projection import project_model, whole_geometry
from pisigma.files.errors import RobotError
from pisigma.robot.description import Robot
from pisigma.robot.row import FRAME_COLUMNS, in_file_units

CONDITIONS = frozenset(("payload_kg", "temperature_c"))
_NUMBER = r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?"


@dataclass(frozen=True)
class FileText:
    """What the text of a file is made from.

    Attributes:
        robot: with the geometry that the file is to hold.
        nominal: the robot as the controller has it without the file.
        request: the model, the file and the options.
        said: sentences for its comments.
    """

    robot: Robot
    nominal: Robot
    request: ExportRequest
    said: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Frames:
    """How the frames of a controller lie to those that a robot is drawn in.

    Attributes:
        said: it as a sentence.
        base: the controller's base frame in the frame of the drawing's poses, as `FRAME_COLUMNS`.
        tool: the drawing's tool on the controller's flange.
    """

    said: str
    base: Float64[np.ndarray, " 6"]
    tool: Float64[np.ndarray, " 6"]

    def to_json(self) -> dict[str, object]:
        """The plain values for `--json`."""
        parts = {part: in_file_units(FRAME_COLUMNS, getattr(self, part)) for part in ("base", "tool")}
        return {"said": self.said, **parts}


@dataclass(frozen=True, eq=False)
class Convention:
    """How a controller has a robot.

    Attributes:
        nominal: the robot as the controller has it without the file, in its own frames and parameters.
        frames: how these lie to the frames of the robot's drawing; None where they are the same.
        published: values that the maker or a user published of this robot and that the file was tried against, with
            their source; None where there are none.
    """

    nominal: Robot
    frames: Frames | None = None
    published: str | None = None

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the file was tried against, and in which frames its poses are, as sentences."""
        tried = (
            f"Reading and writing were tried against {self.published}."
            if self.published
            else f"No published values were found to try this file against for robot '{self.nominal.name}': compare "
            "the controller's position with pisigma's at several joint values before you use it."
        )
        return (tried, self.frames.said) if self.frames else (tried,)


@dataclass(frozen=True)
class ControllerFile:
    """One kind of file.

    Attributes:
        name: what `--format` calls it.
        contents: what a file holds, with its article.
        suffixes: endings that its files may have.
        source: where it is described, and where it was tried, as a sentence; see `untried`.
        convention: how the controller has a robot that is drawn otherwise; raises a `PisigmaError` where it cannot have
            it.
        relies: sentences on what has to be true of the controller.
        text: gives the text of a file.
        read: gives the robot that a text says, from the nominal one; the second argument is the file's name. None where
            the file holds base and tool too and is loaded as a robot file.
        check: refuses robots that the file cannot hold; raises a `PisigmaError`.
        parameters: indices into the flattened `Robot.dh` that the file can hold.
        options: those of `OPTIONS` that it takes.
        refuse: refuses requests before anything is loaded; raises a `PisigmaError`.
    """

    name: str
    contents: str
    suffixes: tuple[str, ...]
    source: str
    relies: tuple[str, ...]
    text: Callable[[FileText], str]
    read: Callable[[str, str, Robot], Robot] | None
    check: Callable[[Robot], None]
    convention: Callable[[Robot], Convention] = Convention
    parameters: Callable[[Robot], Sequence[int]] = whole_geometry
    options: frozenset[str] = field(default_factory=frozenset)
    refuse: Callable[[ExportRequest], None] = lambda request: None

    def export_format(self) -> ExportFormat:
        """The format of `pisigma export`."""
        return ExportFormat(
            self.name, self.contents, self.suffixes, self.write, self.options | CONDITIONS, self.refuse
        )

    def write(self, request: ExportRequest) -> Exported:
        """Project the model on what the file can hold, and state what that gives up, judged by reading the file back.

        Raises:
            PisigmaError: the model cannot be loaded or projected, or the file cannot hold its robot.
        """
        model = request.load()
        nominal = model.robot
        self.check(nominal)
        parameters = self.parameters(nominal)
        whole = len(parameters) == nominal.dh.size
        start = model.calibrated if whole and model.calibrated is not None else nominal
        fit = project_model(model, start, parameters)
        draft, held = FileText(fit.robot, nominal, request), fit.robot
        if self.read is not None:
            held = self.read(self.text(draft), str(request.out), nominal)
        lost, drawn = fit.departure(held), fit.departure(nominal)
        title = f"{self.contents[0].upper()}{self.contents[1:]} of model {model.name} (robot {nominal.name})."
        convention = self.convention(model.drawn or nominal)
        said = [title, self.source, *convention.remarks, departure_sentence("This file is", lost, drawn)]
        if corrects_joints(model):
            said.append(
                "It holds no learned joint correction: its geometry is the one that comes nearest to both."
            )
        said += [*self.relies, *condition_remarks(model), *frame_remarks(model)]
        facts = {"off_the_whole_model": asdict(lost), "robot_as_drawn": asdict(drawn)}
        facts |= {part: in_file_units(FRAME_COLUMNS, getattr(held, part)) for part in ("base", "tool")}
        if convention.frames:
            facts["frames"] = convention.frames.to_json()
        text = self.text(replace(draft, said=tuple(said)))
        return Exported(text, model_facts(model) | facts, tuple(said))


def untried(source: str) -> str:
    """The sentence on a file that nobody could try."""
    return f"Written from the published description ({source}), not tried on a controller."


def frame_sentences(robot: Robot) -> tuple[str, ...]:
    """Base and tool as comments, which the files themselves cannot hold; `with_frames` reads them back."""
    sentences = []
    for part in ("base", "tool"):
        values = in_file_units(FRAME_COLUMNS, getattr(robot, part)).items()
        sentences.append(f"{part}: " + ", ".join(f"{column} {value + 0.0!r}" for column, value in values))
    return tuple(sentences)


def with_frames(robot: Robot, text: str) -> Robot:
    """The robot with the base and the tool that stand in the comments of a text; its own where there are none."""
    frames: dict[str, np.ndarray] = {}
    for part in ("base", "tool"):
        columns = in_file_units(FRAME_COLUMNS, np.zeros(6))
        pattern = f"{part}: " + ", ".join(f"{column} ({_NUMBER})" for column in columns)
        if match := re.search(pattern, text):
            values = [float(value) for value in match.groups()]
            frames[part] = np.array([*(value / 1e3 for value in values[:3]), *np.deg2rad(values[3:])])
    return robot.with_geometry(base=frames.get("base"), tool=frames.get("tool"))


def check_plain_joints(robot: Robot, kind: str, count: int | None = None) -> None:
    """Refuse robots that have anything but joints in their rows, or other than so many that turn.

    Args:
        robot: the robot.
        kind: what the file is called, for the complaint.
        count: joints that are wanted, all turning and counting as their axes turn; None for any.

    Raises:
        RobotError: it is no such robot.
    """
    turning = sum(robot.revolute)
    if count is not None and ((turning, robot.dof) != (count, count) or (robot.directions < 0).any()):
        raise RobotError(
            f"{kind} is for robots with {count} joints that turn and count as their axes do; robot '{robot.name}' has "
            f"{turning} that turn and {robot.dof - turning} that slide, {int((robot.directions < 0).sum())} counted "
            "the other way. Take another --format."
        )
    if len(robot.rows) != robot.dof:
        raise RobotError(
            f"{kind} has one row a joint; robot '{robot.name}' has {len(robot.rows) - robot.dof} fixed rows besides. "
            "Take --format urdf or dh."
        )
