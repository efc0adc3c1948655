"""Which camera measures, as it is asked for: files, and numbers in their units."""

import math
from dataclasses import dataclass
from typing import Annotated

from pisigma.files.errors import PlanningError
from pisigma.files.setting import FILE, Option
from pisigma.measurement.camera.camera_files import CameraFiles, Repeatability

FINEST_PX, COARSEST_PX = 1e-3, 100.0
"""Of the noise of a corner."""


@dataclass(frozen=True)
class CameraSettings:
    """Camera and board of a plan.

    Attributes:
        camera: YAML file of the camera (of pisigma, ROS or OpenCV), for the sensor camera.
        board: YAML file of the board, for the sensor camera.
        is_fixed: the camera is fixed and the board is on the flange (default: the other way round).
        sigma_px: standard deviation of u and v of a detected corner [px].
        repeatability_mm: standard deviation of the robot's position repeatability, per axis [mm].
        repeatability_deg: standard deviation of the robot's orientation repeatability, per axis [deg].

    Raises:
        PlanningError: a number is none that it can be.
    """

    camera: Annotated[str, FILE]
    board: Annotated[str, FILE]
    is_fixed: Annotated[bool, Option("--fixed-camera")] = False
    sigma_px: float = 0.3
    repeatability_mm: float = 0.02
    repeatability_deg: float = 0.01

    def __post_init__(self) -> None:
        """Refuse noise that is none."""
        if not FINEST_PX <= self.sigma_px <= COARSEST_PX:
            raise PlanningError(
                f"sigma_px: {FINEST_PX:g} to {COARSEST_PX:g} px was wanted, got {self.sigma_px:g}."
            )
        _ = self.repeatability

    @property
    def repeatability(self) -> Repeatability:
        """Of the robot."""
        return Repeatability(self.repeatability_mm / 1e3, math.radians(self.repeatability_deg))

    @property
    def files(self) -> CameraFiles:
        """What reads the corners that are measured."""
        return CameraFiles((self.camera,), (self.board,), self.is_fixed, self.repeatability)
