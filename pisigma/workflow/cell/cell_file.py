"""`cell.yaml`: robot, sensor and limit of a cell, and the settings of every step, as on the command line."""

import os
import textwrap
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

import yaml
from pydantic import Field

from pisigma.files.errors import PisigmaError, Place, PlanningError
from pisigma.files.scratch import FILE, scratch_beside
from pisigma.files.setting import attribute_descriptions, build_settings, flat_settings, settings_by_key
from pisigma.files.setting_values import checked_values
from pisigma.files.yaml_file import Section, place_of_key, read_yaml
from pisigma.files.yaml_writing import yaml_text
from pisigma.lifetime.cell.facts import CellFacts
from pisigma.lifetime.cell.layout import CELL_FILE, is_cell_of_arms
from pisigma.lifetime.cell.status import VERIFICATION_POSES, is_check_due
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.planning.surroundings.surroundings import Surroundings
from pisigma.robot.description import Robot
from pisigma.robot.robot_file import robot_file
from pisigma.robot.row import BoundedFloat
from pisigma.validation.uncertainty.instrument import Instrument
from pisigma.workflow.settings.calibration import CalibrationSettings
from pisigma.workflow.settings.comparison import ComparisonSettings
from pisigma.workflow.settings.evaluation import EvaluationSettings
from pisigma.workflow.settings.importing import ImportSettings
from pisigma.workflow.settings.measuring import MeasureSettings
from pisigma.workflow.settings.monitoring import MonitorSettings
from pisigma.workflow.settings.recalibration import RecalibrationSettings
from pisigma.workflow.settings.verification import VerificationSettings

STEPS: dict[str, type] = {
    "plan": PlanSettings,
    "measure": MeasureSettings,
    "import": ImportSettings,
    "calibrate": CalibrationSettings,
    "verify": VerificationSettings,
    "monitor": MonitorSettings,
    "recalibrate": RecalibrationSettings,
    "compare": ComparisonSettings,
    "evaluate": EvaluationSettings,
}
"""Class of the settings of every step, by its section of `cell.yaml`, which has the name of the command."""
CAMERA_KEYS = ("camera", "board", "fixed_camera", "intrinsics", "repeatability_mm", "repeatability_deg")
STATED_ABOVE = {"plan": ("limit_mm", "sensor"), "measure": ("limit_mm",)}
"""Keys of steps whose values `cell.yaml` states once for the whole cell, in addition to `CAMERA_KEYS`. `monitor` has
another limit."""
MEASURED_JOINTS = (
    "The rows contain joint values that the encoders read, so the model corrects these and not the deviation of the "
    "controller: a commanded pose is reached if the encoders then read the corrected joint values."
)
_MAX_WIDTH = 100
_COMMENT: Mapping[str, Any] = {"initial_indent": "# ", "subsequent_indent": "# "}

SensorName = Literal["tracker", "camera", "sockets", "draw-wire", "touch"]
_PLANNED_SENSORS: dict[SensorName, str] = {"camera": "camera", "draw-wire": "distance"}
"""Names that `pisigma plan` uses for the sensors that do not measure positions."""

Group = TypeVar("Group")
_Steps = dict[str, Any] | None


class CameraSection(Section):
    """Cameras and boards of a cell; their paths are inside the cell.

    Attributes:
        camera: camera files (YAML of pisigma, ROS or OpenCV).
        board: board files (YAML: rows, columns, square_mm).
        fixed_camera: whether the cameras are fixed and the boards are on the flange, not the other way round.
        intrinsics: fixed, prior or free.
        repeatability_mm: repeatability of the robot's position: standard deviation per axis [mm].
        repeatability_deg: repeatability of the robot's orientation: standard deviation per axis [deg].
    """

    camera: tuple[str, ...]
    board: tuple[str, ...]
    fixed_camera: bool = False
    intrinsics: Literal["fixed", "prior", "free"] = "prior"
    repeatability_mm: Annotated[BoundedFloat, Field(ge=0)] = 0.02
    repeatability_deg: Annotated[BoundedFloat, Field(ge=0)] = 0.01


class CellDocument(Section):
    """The content of `cell.yaml`.

    Attributes:
        robot: catalogue name, or a robot file (YAML or URDF) inside the cell.
        base: base link of the URDF file; poses are in its frame. None for its root.
        tip: tool link of the URDF file; None for its only leaf link.
        sensor: sensor that measures the robot.
        limit_mm: limit on the 95 % quantile of the position errors [mm]; None for no limit.
        joint_values: whether rows contain the joint values that were commanded (the default) or those that the encoders
            read ("measured"), to which the controller then has to move without a deviation.
        instrument: measuring instrument and its calibration certificate; None if it is not stated.
        pose_repeatability_mm: pose repeatability RP according to ISO 9283 that the maker of the robot states [mm];
            None if it is not stated.
        expansion_per_k: coefficient of linear expansion of the arm [1/K], about 1.2e-5 for steel and 2.3e-5 for
            aluminium; None if it is not stated.
        camera: cameras and boards; None without cameras.
        surroundings: obstacles around the robot and limits of its motion; None for none.
        plan: settings of `pisigma plan`, by the keys of its option `--set`.
        measure: settings of `pisigma measure`.
        import_: settings of `pisigma import`.
        calibrate: settings of `pisigma calibrate`.
        verify: settings of `pisigma verify`.
        monitor: settings of `pisigma monitor`.
        recalibrate: settings of `pisigma recalibrate`.
        compare: settings of `pisigma compare`.
        evaluate: settings of `pisigma evaluate`.
    """

    robot: str
    base: str | None = None
    tip: str | None = None
    sensor: SensorName = "tracker"
    limit_mm: Annotated[BoundedFloat, Field(gt=0)] | None = None
    joint_values: Literal["commanded", "measured"] = "commanded"
    instrument: Instrument | None = None
    pose_repeatability_mm: Annotated[BoundedFloat, Field(gt=0)] | None = None
    expansion_per_k: Annotated[BoundedFloat, Field(ge=0, le=1e-3)] | None = None
    camera: CameraSection | None = None
    surroundings: Surroundings | None = None
    plan: _Steps = None
    measure: _Steps = None
    import_: _Steps = Field(default=None, alias="import")
    calibrate: _Steps = None
    verify: _Steps = None
    monitor: _Steps = None
    recalibrate: _Steps = None
    compare: _Steps = None
    evaluate: _Steps = None


@dataclass(frozen=True)
class CellFile:
    """Content of the file `cell.yaml` of a cell.

    Attributes:
        path: path of the file.
        document: its content.
    """

    path: Path
    document: CellDocument

    @staticmethod
    def read(folder: Path) -> "CellFile":
        """Read the file of a cell, and check the settings of every step.

        Raises:
            PlanningError: the file is missing or not a valid `cell.yaml`; the message names file, line and key. Or it
                lists several arms.
            PisigmaError: a setting of a step is not valid.
        """
        if is_cell_of_arms(folder):
            raise PlanningError(
                "the cell has several arms",
                expected="a cell of one robot",
                at=place_of_key(folder / CELL_FILE, ("arms",)),
                remedy="calibrate them with `pisigma calibrate`, then use the models and files of one arm",
            )
        return CellFile._checked(folder / CELL_FILE)

    @staticmethod
    def write(folder: Path, text: str) -> "CellFile":
        """Replace the file of a cell by a text if it is valid, completely or not at all.

        Raises:
            PlanningError: the text is not a valid `cell.yaml`, in which case the message names line and key; or the
                robot cannot be loaded, or does not fit the surroundings.
        """
        path = folder / CELL_FILE
        with scratch_beside(path, FILE) as scratch:
            scratch.write_text(text, encoding="utf-8", newline="\n")
            try:
                read = CellFile._checked(scratch)
                robot = Robot.load(read.robot, read.document.base, read.document.tip)
                ArmInSurroundings.from_robot(robot, read.document.surroundings)
            except PisigmaError as problem:
                refusal = PlanningError(str(problem).replace(str(scratch), str(path)))
                refusal.file, refusal.line, refusal.column = str(path), problem.line, problem.column
                raise refusal from None
            scratch.chmod(0o644)
            os.replace(scratch, path)
        return CellFile.read(folder)

    @staticmethod
    def _checked(path: Path) -> "CellFile":
        read = CellFile(path, read_yaml(path, CellDocument, PlanningError))
        for step in STEPS:
            if step not in ("plan", "import"):
                read.settings_of_step(step)
            else:
                values, settings = read.stated_values(step), settings_by_key(STEPS[step])
                list(checked_values(values, settings, read._place(step).place_of))
        return read

    @property
    def robot(self) -> str:
        """The robot as an argument of `Robot.load`."""
        name = self.document.robot
        return name if robot_file(name) is None else str(path_inside_cell(self.path.parent, name))

    def stated_values(self, step: str) -> dict[str, Any]:
        """Return the values that the file states for a step, by its keys, including the shared keys that it uses."""
        section = dict(getattr(self.document, {"import": "import_"}.get(step, step)) or {})
        known = settings_by_key(STEPS[step])
        shared: dict[str, Any] = {}
        if self.document.limit_mm is not None and "limit_mm" in STATED_ABOVE.get(step, ()):
            shared["limit_mm"] = self.document.limit_mm
        sensor = _PLANNED_SENSORS.get(self.document.sensor, "position")
        if self.document.camera is not None and (step != "plan" or sensor == "camera"):
            shared |= self.document.camera.model_dump(exclude_defaults=True)
        if step == "plan":
            shared["sensor"] = sensor
        return {key: value for key, value in shared.items() if key in known} | section

    def settings_of_step(self, step: str, **overrides: Any) -> Any:
        """Return the settings of a step.

        Args:
            step: a key of `STEPS`.
            **overrides: values that override the file, by its keys; their paths may be outside the cell.

        Raises:
            PisigmaError: a setting is not valid; the message names file, line and key.
        """
        return settings_from(
            STEPS[step],
            self.stated_values(step) | overrides,
            self._place(step),
            self.path.parent,
            frozenset(overrides),
        )

    def measured_joints_warnings(self) -> tuple[str, ...]:
        """Return warnings about models that are fitted to the rows of the cell."""
        return (MEASURED_JOINTS,) if self.document.joint_values == "measured" else ()

    def plan_settings(self, facts: CellFacts, **overrides: Any) -> PlanSettings:
        """Return the settings of the next plan: few poses if a model has to be checked, and new poses in every plan.

        Args:
            facts: facts about the cell.
            **overrides: values that override the file, by its keys.
        """
        settings: PlanSettings = self.settings_of_step("plan", **overrides)
        stated = self.stated_values("plan").keys() | overrides.keys()
        default: dict[str, Any] = {"seed": settings.seed + len(facts.plans)}
        if is_check_due(facts):
            default |= {"count": VERIFICATION_POSES, "check": 0}
        return replace(settings, **{key: value for key, value in default.items() if key not in stated})

    def _place(self, step: str) -> "_Places":
        return _Places(self.path, step)


@dataclass(frozen=True)
class _Places:
    """Places of the keys of a step in a file."""

    path: Path
    step: str

    def place_of(self, key: str) -> Place:
        return place_of_key(self.path, (self.step, key) if key else (self.step,))


def settings_from(
    settings_class: type[Group],
    stated_values: Mapping[str, Any],
    places: _Places,
    folder: Path,
    keys_outside_cell: Collection[str] = (),
) -> Group:
    """Return an instance of a class of settings with the values of a file.

    Args:
        settings_class: class of the settings.
        stated_values: values by their keys, in the units of the command line.
        places: places of the keys in the file.
        folder: folder of the cell, to which paths are relative.
        keys_outside_cell: keys whose paths are relative to the working directory.

    Raises:
        PisigmaError: a key is unknown, or a value has the wrong type or is not valid.
    """

    def place_of(key: str) -> Place | None:
        return None if key in keys_outside_cell else places.place_of(key)

    values = dict(checked_values(stated_values, settings_by_key(settings_class), place_of))
    try:
        built = build_settings(
            settings_class, dict(_with_paths(settings_class, values, folder, keys_outside_cell))
        )
    except PisigmaError as problem:  # the class of the settings refuses a value
        key = problem.option.removeprefix("--").replace("-", "_")
        place = place_of(key if key in values or key in keys_outside_cell else "")
        raise (problem if place is None else problem.with_place(place)) from None
    assert isinstance(built, settings_class)
    return built


def _with_paths(
    group: type, values: Mapping[str, Any], folder: Path, outside: Collection[str]
) -> Iterator[tuple[str, Any]]:
    """Yield keys and values, with the full paths of files inside the cell."""
    known = settings_by_key(group)
    for key, value in values.items():
        if key not in outside and known[key].kind is Path:
            yield key, path_inside_cell(folder, value)
        elif key not in outside and get_args(known[key].kind) == (Path,):
            yield key, [path_inside_cell(folder, one) for one in value]
        else:
            yield key, value


def path_inside_cell(folder: Path, path: str | os.PathLike[str]) -> Path:
    """Return the full path of a file that a cell states; it must be inside the cell.

    Raises:
        PlanningError: the path leads out of the cell.
    """
    whole = folder / path
    if not Path(os.path.realpath(whole)).is_relative_to(os.path.realpath(folder)):
        raise PlanningError(
            expected="a path inside the cell",
            value=str(path),
            at=Place(folder / CELL_FILE),
            remedy="copy the file there",
        )
    return whole


def cell_template(document: Mapping[str, Any], calibrate: Mapping[str, Any] | None = None) -> str:
    """Return the text of a new `cell.yaml`: the known values, and every setting as a comment with help and default.

    Args:
        document: known values by the keys of `CellDocument`.
        calibrate: settings of `pisigma calibrate`, for a short text without comments; None for all settings.
    """
    if calibrate is not None:
        stated = {key: value for key, value in document.items() if value is not None}
        return yaml_text(stated | ({"calibrate": dict(calibrate)} if calibrate else {}))
    lines = ["# A cell: one robot on its mount, and its sensor. Lines that begin with # state defaults."]
    meaning = {key: text.partition("; None")[0] for key, text in attribute_descriptions(CellDocument).items()}
    known = (
        "robot",
        "base",
        "tip",
        "sensor",
        "limit_mm",
        "joint_values",
        "pose_repeatability_mm",
        "expansion_per_k",
    )
    for key in known:
        if document.get(key) is not None:
            lines.append(f"{key}: {_yaml(document[key])}")
        else:
            lines += textwrap.wrap(f"{key}:  # {meaning[key]}", _MAX_WIDTH, **_COMMENT)
    lines.append("# instrument:  # for the uncertainty budget of `pisigma report`; texts in quotation marks")
    for key, text in attribute_descriptions(Instrument).items():
        lines.append(f"#   {key}:  # {text}")
    if document.get("camera") is not None:
        lines += ["camera:", *(f"  {key}: {_yaml(value)}" for key, value in document["camera"].items())]
    lines.append(
        "# surroundings:  # floor, boxes, tracker, joint margins: see the documentation of `pisigma plan`"
    )
    if document.get("sensor") == "camera":
        lines += _VIEW
    for step, group in STEPS.items():
        lines += ["", f"{step}:  # keys of `pisigma {step} --set`"]
        for setting in flat_settings(group):
            key = setting.key
            if key in (*CAMERA_KEYS, *STATED_ABOVE.get(step, ())):
                continue
            lines += textwrap.wrap(setting.help, _MAX_WIDTH, initial_indent="  # ", subsequent_indent="  # ")
            lines.append(f"  # {key}: {_yaml(setting.default)}".rstrip())
    return "\n".join([*lines, ""])


_VIEW = (
    "#   tool: {x_mm: 30, y_mm: 20, z_mm: 60}  # camera on the flange (if it is fixed: the board)",
    "#   view: {frame: {x_mm: 420, z_mm: 50, yaw_deg: 180}, near_mm: 300, far_mm: 700}  # board (if fixed: the camera)",
)
"""Comments on keys that a plan with a camera needs."""


def _yaml(value: Any) -> str:
    if value is None:
        return ""
    return yaml.safe_dump(value, default_flow_style=True, width=1000).removesuffix("\n...\n").strip()
