"""Which camera measures, as it is asked for: files, and numbers in their units."""

import math
from dataclasses import dataclass

from pisigma.files.errors import PlanningError
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.camera_files import CameraFiles, Repeatability
from pisigma.planning.board_sight import BoardSight

FINEST_PX, COARSEST_PX = 1e-3, 100.0
"""Of the noise of a corner."""


@dataclass(frozen=True)
class CameraSettings:
    """Which camera sees which board.

    Attributes:
        camera: file of the camera.
        board: file of the board.
        is_fixed: whether the camera stands beside the robot and the board is on the flange; else the other way round.
        sigma_px: standard deviation of u and v of a corner [px].
        repeatability_mm: of the robot: standard deviation of each coordinate of a position [mm].
        repeatability_deg: of the robot: standard deviation of a turn about each axis [deg].

    Raises:
        PlanningError: a number is none that it can be.
    """

    camera: str
    board: str
    is_fixed: bool = False
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

    def sight(self) -> BoardSight:
        """Read the files of camera and board.

        Raises:
            MeasurementError: a file cannot be used; the message says which and where.
        """
        camera, board = Camera.load(self.camera), Board.load(self.board)
        is_fixed = self.is_fixed or camera.is_fixed
        return BoardSight(camera, board, is_fixed, self.sigma_px, self.repeatability)
