"""Cameras, boards and robot repeatability, which files of corners require."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, get_args

from pisigma.files.errors import IdentificationError, MeasurementError, Phrase, check_choice
from pisigma.files.setting import KEY, Option, as_texts

IntrinsicsChoice = Literal["fixed", "prior", "free"]
_MAX_REPEATABILITY = 0.01, 0.105
"""Largest repeatability [m] and [rad]; larger values must be in a different unit."""


@dataclass(frozen=True)
class Repeatability:
    """Repeatability of a robot: deviation of the pose at given joint values, independent in each image.

    Attributes:
        length: repeatability of the robot's position in images: standard deviation per axis [m].
        angle: repeatability of the robot's orientation in images: standard deviation per axis [rad].
    """

    length: Annotated[float, Option("--repeatability-mm", unit="mm", is_key_only=True)] = 2e-5
    angle: Annotated[float, Option("--repeatability-deg", unit="deg", is_key_only=True)] = math.radians(0.01)

    def __post_init__(self) -> None:
        """Check both standard deviations."""
        if not (0 <= self.length <= _MAX_REPEATABILITY[0] and 0 <= self.angle <= _MAX_REPEATABILITY[1]):
            raise IdentificationError(
                option="repeatability",
                expected="standard deviations of 0 to 10 mm and 0 to 6 deg",
                value=Phrase(f"{self.length * 1e3:g} mm and {math.degrees(self.angle):g} deg"),
            )


@dataclass(frozen=True)
class CameraFiles:
    """Cameras and boards for files of detected corners (columns image, corner, u_px, v_px and joint values).

    Attributes:
        cameras: camera file (YAML of pisigma, ROS or OpenCV) for rows that are corners of boards in images. Requires a
            board. With several cameras, the column camera of the rows names them.
        boards: board file (YAML: rows, columns, square_mm). With several boards, the column board of the rows names
            them.
        is_fixed: all cameras are fixed and the boards are on the flange, not the other way round. If only some cameras
            are fixed, state is_fixed in their files instead.
        repeatability: repeatability of the robot.
        intrinsics: treatment of the cameras' intrinsics: fixed (as in the camera files), prior (within the stated
            standard deviations, or those of a typical calibration if none are stated) or free.

    Raises:
        MeasurementError: no camera or no board is given.
        IdentificationError: `intrinsics` is not a valid choice.
    """

    cameras: Annotated[tuple[str, ...], Option("--camera", kind=list[Path], read=as_texts)]
    boards: Annotated[tuple[str, ...], Option("--board", kind=list[Path], read=as_texts)]
    is_fixed: Annotated[bool, Option("--fixed-camera")] = False
    repeatability: Repeatability = field(default_factory=Repeatability)
    intrinsics: Annotated[IntrinsicsChoice, KEY] = "prior"

    def __post_init__(self) -> None:
        """Refuse unknown choices of intrinsics, cameras without boards, and boards without cameras."""
        check_choice(IdentificationError, "intrinsics", self.intrinsics, get_args(IntrinsicsChoice))
        if not self.cameras or not self.boards:
            missing = "--board" if self.cameras else "--camera"
            raise MeasurementError(
                "--camera and --board are needed together", option=missing, remedy="give both"
            )

    @property
    def files(self) -> tuple[str, ...]:
        """Paths of all camera files and board files."""
        return (*self.cameras, *self.boards)

    @property
    def options(self) -> list[str]:
        """Command-line options that state the cameras and boards."""
        words = [word for path in self.cameras for word in ("--camera", path)]
        words += [word for path in self.boards for word in ("--board", path)]
        usual, stated = Repeatability(), self.repeatability
        words += ["--fixed-camera"] if self.is_fixed else []
        words += ["--set", f"intrinsics={self.intrinsics}"] if self.intrinsics != "prior" else []
        if stated.length != usual.length:
            words += ["--set", f"repeatability_mm={stated.length * 1e3:g}"]
        if stated.angle != usual.angle:
            words += ["--set", f"repeatability_deg={math.degrees(stated.angle):g}"]
        return words
