"""What is to be planned, as it is asked for: numbers in the units of files, and files by their paths."""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import torch
from jaxtyping import Float64
from pydantic import ConfigDict
from torch import Tensor

from pisigma.files.errors import PlanningError, nearest_choice
from pisigma.files.yaml_file import MOST_POSES
from pisigma.measurement.camera.corner_file import read_rows
from pisigma.measurement.csv.reading import holds_measurements, read_joints
from pisigma.measurement.dataset import Measurements
from pisigma.planning.board_views import BoardViews
from pisigma.planning.camera_settings import CameraSettings
from pisigma.planning.candidates import (
    Candidates,
    Workspace,
    draw_candidates,
    read_candidates,
    with_workspace,
)
from pisigma.planning.choice import Criterion
from pisigma.planning.knowledge import Instrument, SensorKind
from pisigma.planning.surroundings.arm_in_cell import ArmInCell
from pisigma.planning.tour import Pace
from pisigma.robot.description import Robot

SHORTEST_MM, LONGEST_MM = 1e-3, 1e3
"""Of a standard deviation of an instrument, and of an error of a robot: others are slips of the unit."""
REACHABLE = 1000
"""Poses that stand for the workspace where a camera measures."""
FILES = ("candidates_from", "task", "measured")
"""Settings that are files."""


@dataclass(frozen=True)
class PlanSettings:
    """What is to be planned.

    Attributes:
        count: poses to calibrate with.
        check: poses that are measured besides, to judge the calibration.
        sensor: what is measured: the position of a reflector, its pose, its distance from a fixed point, or corners of
            a board by a camera.
        camera: which camera sees which board; None where none measures.
        sigma_mm: standard deviation of a measured length [mm]; None for that of laser trackers, see
            `pisigma.planning.knowledge.Instrument`.
        criterion: "D": what lowers the uncertainty of all unknowns most; "I": what lowers that of the tool's position
            over the task most.
        limit_mm: 95 % of the tool's position errors over the task are to stay below [mm], as in `measure`; None for no
            limit.
        candidates: poses that are drawn to choose from.
        candidates_from: file of joint values to choose from instead.
        box_mm: lowest and then highest x, y, z in the robot's base frame where the reflector is measured [mm].
        task: file of joint values, or of poses of the drawing's or the model's tool, where the robot is to be accurate;
            None for wherever it can be measured.
        measured: file of rows that are measured already.
        seed: of what is drawn.
        speed_deg_s: of the joints that turn, from pose to pose [deg/s].
        settling_s: time at every pose [s].

    Raises:
        PlanningError: a setting is no choice, or no number that it can be.
    """

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)

    count: int = 40
    check: int = 10
    sensor: SensorKind = "position"
    camera: CameraSettings | None = None
    sigma_mm: float | None = None
    criterion: Criterion = "I"
    limit_mm: float | None = None
    candidates: int = 5000
    candidates_from: str | None = None
    box_mm: tuple[float, float, float, float, float, float] | None = None
    task: str | None = None
    measured: str | None = None
    seed: int = 0
    speed_deg_s: float = 30.0
    settling_s: float = 3.0

    def __post_init__(self) -> None:
        """Refuse settings that are none."""
        for name, choices in (("sensor", get_args(SensorKind)), ("criterion", get_args(Criterion))):
            value = getattr(self, name)
            if value not in choices:
                raise PlanningError(f"{name} '{value}' is unknown; {nearest_choice(str(value), choices)}")
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
    def pace(self) -> Pace:
        """How fast the robot goes from pose to pose."""
        return Pace(speed=math.radians(self.speed_deg_s), settling=self.settling_s)

    def instrument(self, anchor: Float64[Tensor, " 3"] | None = None) -> Instrument:
        """What measures.

        Args:
            anchor: where distances are from, in the measuring frame [m].

        Raises:
            PlanningError: distances are measured, but from nowhere.
        """
        if self.camera is not None:
            return Instrument(self.sensor, sight=self.camera.sight())
        if self.sensor == "distance" and anchor is None:
            raise PlanningError(
                "where distances are measured from was wanted; state it as the tracker of the cell (--cell)."
            )
        stated: dict[str, Any] = {} if self.sigma_mm is None else {"sigma": self.sigma_mm / 1e3}
        stated |= {} if anchor is None else {"anchor": tuple(anchor.tolist())}
        return Instrument(self.sensor, **stated)

    def find_candidates(self, arm: ArmInCell) -> Candidates:
        """Draw or read the poses to choose from.

        Raises:
            MeasurementError: their file cannot be used.
            PlanningError: a joint that slides has no limits to draw in.
        """
        views, workspace = self.views(arm), self.workspace
        if self.candidates_from is not None:
            candidates = read_candidates(arm, self.candidates_from, workspace, views)
        else:
            candidates = draw_candidates(arm, self.candidates, self.seed, workspace, views)
        if views is None:
            return candidates
        return with_workspace(arm, candidates, draw_candidates(arm, REACHABLE, self.seed, workspace))

    def with_measured(self, arm: ArmInCell) -> ArmInCell:
        """The arm, for which candidates that were measured are free of self-collision.

        Raises:
            MeasurementError: the file of candidates cannot be used.
        """
        if self.candidates_from is None or not holds_measurements(self.candidates_from):
            return arm
        return arm.with_measured(read_joints(self.candidates_from, arm.robot))

    @property
    def workspace(self) -> Workspace | None:
        """Where the reflector is measured, or the target of a camera; None for anywhere."""
        if self.box_mm is None:
            return None
        return torch.tensor(self.box_mm, dtype=torch.float64).reshape(2, 3) / 1e3

    def read_rows(self, path: str | os.PathLike[str], robot: Robot) -> Measurements:
        """Read measured rows, or the corners that a camera saw.

        Raises:
            MeasurementError: the file cannot be used.
        """
        return read_rows(path, robot, None if self.camera is None else self.camera.files)

    def views(self, arm: ArmInCell) -> BoardViews | None:
        """From where the camera has to see its board; None without a camera.

        Raises:
            PlanningError: the cell does not say from where, or where the board is.
        """
        if self.camera is None:
            return None
        view = arm.cell.view
        if view is None or view.T_cell_frame is None:
            frame, target = ("camera", "board") if self.camera.is_fixed else ("board", "camera")
            raise PlanningError(
                f"where the {frame} is and from where images are sharp was wanted; state it in the cell (--cell), as "
                "view: {frame: {x_mm: 400, z_mm: 50, yaw_deg: 180}, near_mm: 300, far_mm: 700}, and where the "
                f"{target} is on the flange as tool."
            )
        return BoardViews.of(self.camera.sight(), view.T_cell_frame, view)

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
