"""What the pixels of files of corners mean: cameras, boards, and how well the robot repeats."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, get_args

from pisigma.files.errors import IdentificationError, MeasurementError, nearest_choice
from pisigma.files.setting import Option, texts

IntrinsicsChoice = Literal["fixed", "prior", "free"]
MOST_REPEATABILITY = 0.01, 0.105
"""[m] and [rad] More is that of no robot, but of another unit."""


@dataclass(frozen=True)
class Repeatability:
    """By how much the robot misses, anew in every image, the pose that its joint values mean.

    Attributes:
        length: of images: standard deviation with which a position repeats, per axis [m].
        angle: of images: standard deviation with which a direction repeats, per axis [rad].
    """

    length: Annotated[float, Option("--repeatability-mm", unit="mm")] = 2e-5
    angle: Annotated[float, Option("--repeatability-deg", unit="deg")] = math.radians(0.01)

    def __post_init__(self) -> None:
        """Refuse what is no standard deviation."""
        if not (0 <= self.length <= MOST_REPEATABILITY[0] and 0 <= self.angle <= MOST_REPEATABILITY[1]):
            raise IdentificationError(
                f"repeatability: standard deviations of 0 to 10 mm and 0 to 6 deg were wanted, got "
                f"{self.length * 1e3:g} mm and {math.degrees(self.angle):g} deg."
            )


@dataclass(frozen=True)
class CameraFiles:
    """What the pixels of files of corners mean.

    Attributes:
        cameras: cameras (YAML of pisigma, ROS or OpenCV) whose corners a file holds: columns image, corner, u_px, v_px
            and joints; with boards. Of several, the column camera has the names.
        boards: boards that the cameras see (YAML: rows, columns, square_mm). Of several, the column board has the
            names.
        is_fixed: every camera is fixed and the boards are on the flange, not the other way round; of several cameras,
            state is_fixed: true in the files of those that are.
        repeatability: of the robot.
        intrinsics: of cameras: fixed: as their files state them; prior: within the standard deviations in their files,
            or those of a usual calibration where they state none; free: as the images show them.

    Raises:
        MeasurementError: no camera or no board is stated.
        IdentificationError: the intrinsics are no choice.
    """

    cameras: Annotated[tuple[str, ...], Option("--camera", kind=list[Path], read=texts)]
    boards: Annotated[tuple[str, ...], Option("--board", kind=list[Path], read=texts)]
    is_fixed: Annotated[bool, Option("--fixed-camera")] = False
    repeatability: Repeatability = field(default_factory=Repeatability)
    intrinsics: IntrinsicsChoice = "prior"

    def __post_init__(self) -> None:
        """Refuse what is no choice, cameras without boards, and boards without cameras."""
        if self.intrinsics not in get_args(IntrinsicsChoice):
            choices = nearest_choice(self.intrinsics, get_args(IntrinsicsChoice))
            raise IdentificationError(f"intrinsics '{self.intrinsics}' is no choice; {choices}")
        if not self.cameras or not self.boards:
            raise MeasurementError("--camera and --board belong together; give both.")

    @property
    def files(self) -> tuple[str, ...]:
        """Of cameras and boards."""
        return (*self.cameras, *self.boards)

    @property
    def options(self) -> list[str]:
        """Options by which commands read the same."""
        words = [word for path in self.cameras for word in ("--camera", path)]
        words += [word for path in self.boards for word in ("--board", path)]
        usual, stated = Repeatability(), self.repeatability
        words += ["--fixed-camera"] if self.is_fixed else []
        words += ["--intrinsics", self.intrinsics] if self.intrinsics != "prior" else []
        if stated.length != usual.length:
            words += ["--repeatability-mm", f"{stated.length * 1e3:g}"]
        if stated.angle != usual.angle:
            words += ["--repeatability-deg", f"{math.degrees(stated.angle):g}"]
        return words
