"""Settings of a camera that measures: files, and numbers in the units of files."""

import math
from dataclasses import dataclass
from typing import Annotated

from pisigma.files.errors import PlanningError
from pisigma.files.setting import FILE, KEY, Option
from pisigma.measurement.camera.camera_files import CameraFiles, Repeatability

MIN_SIGMA_PX, MAX_SIGMA_PX = 1e-3, 100.0
"""Valid range of the noise of a corner [px]; other values are slips of the unit."""


@dataclass(frozen=True)
class CameraSettings:
    """Camera and board of a plan.

    Attributes:
        camera: YAML file of the camera (of pisigma, ROS or OpenCV), for the sensor camera.
        board: YAML file of the board, for the sensor camera.
        is_fixed: state that the camera is fixed and the board is on the flange (default: the opposite).
        sigma_px: standard deviation of u and v of a detected corner [px].
        repeatability_mm: standard deviation of the robot's position repeatability, per axis [mm].
        repeatability_deg: standard deviation of the robot's orientation repeatability, per axis [deg].

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
        if not MIN_SIGMA_PX <= self.sigma_px <= MAX_SIGMA_PX:
            expected = f"{MIN_SIGMA_PX:g} to {MAX_SIGMA_PX:g} px"
            raise PlanningError(expected=expected, value=self.sigma_px, option="sigma_px")
        _ = self.repeatability

    @property
    def repeatability(self) -> Repeatability:
        """Repeatability of the robot [m, rad]."""
        return Repeatability(self.repeatability_mm / 1e3, math.radians(self.repeatability_deg))

    @property
    def files(self) -> CameraFiles:
        """Camera files by which measured corners are read."""
        return CameraFiles((self.camera,), (self.board,), self.is_fixed, self.repeatability)
