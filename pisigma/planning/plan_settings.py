"""What is to be planned, as it is asked for: numbers in the units of files, and files by their paths."""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, get_args

from pisigma.files.errors import PlanningError, check_choice
from pisigma.files.setting import FILE, Option
from pisigma.planning.camera_settings import CameraSettings

if TYPE_CHECKING:
    from pisigma.planning.tour import Pace

SensorKind = Literal["position", "pose", "distance", "camera"]
Criterion = Literal["D", "I"]
Box = tuple[float, float, float, float, float, float]
SHORTEST_MM, LONGEST_MM = 1e-3, 1e3
"""Of a standard deviation of an instrument, and of an error of a robot: others are slips of the unit."""
FILES = ("candidates_from", "task", "measured")
"""Settings that are files."""


def box(stated: str) -> tuple[float, ...]:
    """Lowest and highest x, y, z [mm], from "X,Y,Z,X,Y,Z"."""
    try:
        numbers = tuple(map(float, stated.split(",")))
    except ValueError:
        numbers = ()
    if len(numbers) != 6:
        raise PlanningError(
            f"--box: six numbers such as -500,200,100,500,900,800 were wanted, got '{stated}'."
        )
    return numbers


@dataclass(frozen=True)
class PlanSettings:
    """What is to be planned.

    Attributes:
        count: poses to calibrate with.
        check: poses to measure besides, which judge the calibration (set test).
        sensor: what is measured: position (of a reflector), pose, distance (from a fixed point), or camera (corners of
            a board).
        camera: which camera sees which board; None where none measures.
        sigma_mm: standard deviation of a measured length [mm]. None: of laser trackers.
        criterion: I: what lowers the uncertainty of the tool's position over the task most; D: that of all unknowns.
        limit_mm: length below which 95 % of the tool's position errors over the task stay [mm], as in `measure`: how
            many poses does it need?
        candidates: poses to draw, of which some are chosen.
        candidates_from: choose from the joint values of this CSV file instead.
        box_mm: box of the reflector's positions: lowest and then highest x, y, z in the robot's base frame [mm].
        task: CSV file of joint values, or of poses of the drawing's or the model's tool, where the robot shall be
            accurate. None: everywhere.
        measured: measurements that are there already (CSV).
        seed: seed of what is drawn.
        speed_deg_s: speed of every joint that turns between the poses [deg/s].
        settling_s: time at every pose until it is measured [s].

    Raises:
        PlanningError: a setting is no choice, or no number that it can be.
    """

    __pydantic_config__: ClassVar = {"extra": "forbid", "allow_inf_nan": False}

    count: int = 40
    check: int = 10
    sensor: SensorKind = "position"
    camera: CameraSettings | None = None
    sigma_mm: float | None = None
    criterion: Criterion = "I"
    limit_mm: float | None = None
    candidates: int = 5000
    candidates_from: Annotated[str | None, FILE] = None
    box_mm: Annotated[Box | None, Option("--box", kind=str, read=box, metavar="X,Y,Z,X,Y,Z")] = None
    task: Annotated[str | None, FILE] = None
    measured: Annotated[str | None, FILE] = None
    seed: int = 0
    speed_deg_s: float = 30.0
    settling_s: float = 3.0

    def __post_init__(self) -> None:
        """Refuse settings that are none."""
        from pisigma.files.yaml_file import MOST_POSES

        check_choice(PlanningError, "sensor", self.sensor, get_args(SensorKind))
        check_choice(PlanningError, "criterion", self.criterion, get_args(Criterion))
        if (self.sensor == "camera") != (self.camera is not None):
            raise PlanningError(
                f"sensor '{self.sensor}': files of a camera and of a board were wanted for the sensor 'camera', and "
                "for no other one."
            )
        for name, least in (("count", 1), ("check", 0), ("candidates", 1), ("seed", 0)):
            most = 2**63 - 1 if name == "seed" else MOST_POSES
            if not least <= getattr(self, name) <= most:
                raise PlanningError(f"{name}: {least} to {most:,} was wanted, got {getattr(self, name):,}.")
        for name in ("sigma_mm", "limit_mm"):
            value = getattr(self, name)
            if value is not None and not SHORTEST_MM <= value <= LONGEST_MM:
                raise PlanningError(
                    f"{name}: {SHORTEST_MM:g} to {LONGEST_MM:g} mm was wanted, got {value:g}."
                )
        box = self.box_mm
        if box is not None and not all(lower < upper for lower, upper in zip(box[:3], box[3:], strict=True)):
            raise PlanningError(
                "box: the lowest x, y, z and then the highest were wanted [mm], got "
                f"{', '.join(f'{value:g}' for value in box)}."
            )
        _ = self.pace

    @property
    def pace(self) -> "Pace":
        """How fast the robot goes from pose to pose."""
        from pisigma.planning.tour import Pace

        return Pace(speed=math.radians(self.speed_deg_s), settling=self.settling_s)

    def with_files_from(self, folder: Path) -> "PlanSettings":
        """The same with the paths of its files seen from the working directory instead of a folder."""
        return self.with_files(lambda path: os.path.normpath(folder / path))

    def with_files(self, path_of: Callable[[str], str]) -> "PlanSettings":
        """The same with other paths of its files."""
        stated: dict[str, Any] = {
            name: path_of(file) for name in FILES if (file := getattr(self, name)) is not None
        }
        camera = self.camera
        if camera is not None:
            camera = replace(camera, camera=path_of(camera.camera), board=path_of(camera.board))
        return replace(self, camera=camera, **stated)
