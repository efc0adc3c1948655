"""Settings of a plan: numbers in the units of files, and paths of files."""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, get_args

from pisigma.files.errors import PlanningError, check_choice
from pisigma.files.setting import FILE, KEY, Option
from pisigma.measurement.camera.camera_files import CameraFiles, Repeatability

if TYPE_CHECKING:
    from pisigma.planning.tour import Pace

_MIN_SIGMA_PX, _MAX_SIGMA_PX = 1e-3, 100.0
"""Valid range of the noise of a corner [px]; other values are in a wrong unit."""


@dataclass(frozen=True)
class CameraSettings:
    """Camera and board of a plan.

    Attributes:
        camera: camera file (YAML of pisigma, ROS or OpenCV), for the sensor camera.
        board: board file (YAML), for the sensor camera.
        is_fixed: the camera is fixed and the board is on the flange, not the other way round.
        sigma_px: standard deviation of u and v of a detected corner [px].
        repeatability_mm: repeatability of the robot's position: standard deviation per axis [mm].
        repeatability_deg: repeatability of the robot's orientation: standard deviation per axis [deg].

    Raises:
        PlanningError: the noise is outside its valid range.
    """

    camera: Annotated[str, FILE]
    board: Annotated[str, FILE]
    is_fixed: Annotated[bool, Option("--fixed-camera")] = False
    sigma_px: Annotated[float, KEY] = 0.3
    repeatability_mm: Annotated[float, KEY] = 0.02
    repeatability_deg: Annotated[float, KEY] = 0.01

    def __post_init__(self) -> None:
        """Refuse values outside their valid range."""
        if not _MIN_SIGMA_PX <= self.sigma_px <= _MAX_SIGMA_PX:
            expected = f"{_MIN_SIGMA_PX:g} to {_MAX_SIGMA_PX:g} px"
            raise PlanningError(expected=expected, value=self.sigma_px, option="sigma_px")
        _ = self.repeatability

    @property
    def repeatability(self) -> Repeatability:
        """Repeatability of the robot [m, rad]."""
        return Repeatability(self.repeatability_mm / 1e3, math.radians(self.repeatability_deg))

    @property
    def files(self) -> CameraFiles:
        """Camera files with which measured corners are read."""
        return CameraFiles((self.camera,), (self.board,), self.is_fixed, self.repeatability)


SensorKind = Literal["position", "pose", "distance", "camera"]
Criterion = Literal["D", "I"]
Box = tuple[float, float, float, float, float, float]
_MIN_LENGTH_MM, _MAX_LENGTH_MM = 1e-3, 1e3
"""Range of instruments' standard deviations and robots' errors [mm]; other values are in the wrong unit."""
_FILES = ("candidates_from", "task", "measured")
"""Names of the settings that are paths of files."""


def parse_box(text: str) -> tuple[float, ...]:
    """Return the lowest and the highest x, y, z [mm] from "X,Y,Z,X,Y,Z"."""
    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError:
        numbers = ()
    if len(numbers) != 6:
        raise PlanningError(
            expected="six numbers, such as -500,200,100,500,900,800", value=text, option="box"
        )
    return numbers


@dataclass(frozen=True)
class PlanSettings:
    """Settings of a plan.

    Attributes:
        count: number of poses to calibrate with.
        check: number of additional poses to verify the calibration with (rows of the set "test").
        sensor: what is measured: position (of a reflector), pose, distance (from a fixed point) or camera (corners of a
            board).
        camera: camera and board, for the sensor camera only.
        sigma_mm: standard deviation of a measured length [mm]. None: that of a laser tracker.
        criterion: optimality criterion: I (uncertainty of the tool's position over the task) or D (uncertainty of all
            unknowns).
        limit_mm: limit on the 95 % quantile of the tool's position errors over the task [mm], as in `measure`. The plan
            then states the number of poses needed.
        candidates: number of random candidate poses to choose from.
        candidates_from: CSV file of candidate joint values to choose from, instead of random ones.
        box_mm: box of reflector positions: minimum, then maximum x, y, z in the robot's base frame [mm].
        task: CSV file of joint values or tool poses where the robot has to be accurate. Poses refer to the tool of the
            nominal robot or of the model. None: the whole workspace.
        measured: existing measurements (CSV).
        seed: random seed.
        speed_deg_s: joint speed between the poses [deg/s].
        settling_s: time to wait at every pose before it is measured [s].

    Raises:
        PlanningError: a setting is not a valid choice, or a number is out of range.
    """

    __pydantic_config__: ClassVar = {"extra": "forbid", "allow_inf_nan": False}

    count: int = 40
    check: int = 10
    sensor: SensorKind = "position"
    camera: CameraSettings | None = None
    sigma_mm: Annotated[float | None, KEY] = None
    criterion: Annotated[Criterion, KEY] = "I"
    limit_mm: float | None = None
    candidates: Annotated[int, KEY] = 5000
    candidates_from: Annotated[str | None, Option(kind=Path, read=str, is_key_only=True)] = None
    box_mm: Annotated[
        Box | None, Option("--box", kind=str, read=parse_box, metavar="X,Y,Z,X,Y,Z", is_key_only=True)
    ] = None
    task: Annotated[str | None, FILE] = None
    measured: Annotated[str | None, FILE] = None
    seed: Annotated[int, KEY] = 0
    speed_deg_s: Annotated[float, KEY] = 30.0
    settling_s: Annotated[float, KEY] = 3.0

    def __post_init__(self) -> None:
        """Check choices and ranges."""
        from pisigma.files.yaml_file import MAX_POSES

        check_choice(PlanningError, "sensor", self.sensor, get_args(SensorKind))
        check_choice(PlanningError, "criterion", self.criterion, get_args(Criterion))
        if (self.sensor == "camera") != (self.camera is not None):
            raise PlanningError(
                "the sensor camera needs files of a camera and of a board"
                if self.camera is None
                else f"files of a camera and of a board are for the sensor camera, got '{self.sensor}'",
                value=self.sensor,
                option="sensor",
            )
        for name, least in (("count", 1), ("check", 0), ("candidates", 1), ("seed", 0)):
            most = 2**63 - 1 if name == "seed" else MAX_POSES
            if not least <= getattr(self, name) <= most:
                raise PlanningError(
                    expected=f"an integer from {least} to {most:,}", value=getattr(self, name), option=name
                )
        for name in ("sigma_mm", "limit_mm"):
            value = getattr(self, name)
            if value is not None and not _MIN_LENGTH_MM <= value <= _MAX_LENGTH_MM:
                raise PlanningError(
                    expected=f"{_MIN_LENGTH_MM:g} to {_MAX_LENGTH_MM:g} mm", value=value, option=name
                )
        box = self.box_mm
        if box is not None and not all(lower < upper for lower, upper in zip(box[:3], box[3:], strict=True)):
            raise PlanningError(
                expected="the lowest x, y, z and then the highest [mm]",
                value=", ".join(f"{value:g}" for value in box),
                option="box_mm",
            )
        _ = self.pace

    @property
    def pace(self) -> "Pace":
        """Joint speed [rad/s] and settling time [s] between poses."""
        from pisigma.planning.tour import Pace

        return Pace(speed=math.radians(self.speed_deg_s), settling=self.settling_s)

    def with_files_from(self, folder: Path) -> "PlanSettings":
        """Return the settings with file paths relative to the working directory instead of `folder`."""
        return self.with_files(lambda path: os.path.normpath(folder / path))

    def with_files(self, path_of: Callable[[str], str]) -> "PlanSettings":
        """Return the settings with `path_of` applied to every file path."""
        stated: dict[str, Any] = {
            name: path_of(file) for name in _FILES if (file := getattr(self, name)) is not None
        }
        camera = self.camera
        if camera is not None:
            camera = replace(camera, camera=path_of(camera.camera), board=path_of(camera.board))
        return replace(self, camera=camera, **stated)
