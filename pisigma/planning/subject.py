"""What measurements are planned for: a robot as drawn or a calibrated one, and what is known of it."""

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import PlanningError
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model
from pisigma.model.model_source import HoldsModel
from pisigma.planning.board_views import BoardViews
from pisigma.planning.knowledge import Knowledge
from pisigma.planning.plan_inputs import instrument_of, read_planned_rows, views_of
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.surroundings.arm_in_cell import ArmInCell
from pisigma.planning.surroundings.cell import Cell
from pisigma.robot.description import Robot
from pisigma.robot.robot_file import FrameSection
from pisigma.robot.se3 import invert, transform_from_xyzrpy, xyzrpy_from_transform

SAME = 1e-6
"""[m or rad] A model was calibrated with the camera and the board of a plan that are so near to where it has them."""
STEEPEST = 1.52
"""[rad] Pitch of base and tool at most where derivatives are taken."""


@dataclass(frozen=True, eq=False)
class Subject:
    """What is planned for.

    Attributes:
        robot: as drawn.
        model: None for a robot that was not calibrated yet.
        folder: of the model; None where it is in memory only, or there is none.
    """

    robot: Robot
    model: CalibratedModel | None = None
    folder: Path | None = None

    @staticmethod
    def of(
        subject: Robot | CalibratedModel | HoldsModel | str | os.PathLike[str],
        base: str | None = None,
        tip: str | None = None,
    ) -> "Subject":
        """Load what is planned for.

        Args:
            subject: a robot, a name of the catalogue, a robot file (YAML or URDF), a model, what holds it,
                or its folder.
            base: of a URDF file the link that poses are given in.
            tip: of a URDF file the link that is the tool.

        Raises:
            RobotError: there is no such robot.
            ModelError: the folder cannot be used.
        """
        if isinstance(subject, Robot):
            return Subject(subject)
        if isinstance(subject, HoldsModel):
            subject = subject.model
        if not isinstance(subject, CalibratedModel):
            if not Path(subject).is_dir():
                return Subject(Robot.load(subject, base, tip))
            return replace(Subject.of(load_model(Path(subject))), folder=Path(subject))
        if subject.drawn is None:
            raise PlanningError(
                f"model '{subject.name}' does not say how the robot is drawn; plan for its robot instead."
            )
        return Subject(subject.drawn, subject)

    def arm(self, cell: Cell | None) -> ArmInCell:
        """The robot in its cell, with target and board where the cell says, or else where the model has them."""
        if self.model is None:
            return ArmInCell.of(self.robot, cell)
        if cell is not None and cell.view is not None and cell.view.frame is None and self._saw_board:
            x, y, z, *angles = xyzrpy_from_transform(invert(self._from_cell())).tolist()
            lengths = {f"{name}_mm": value * 1e3 for name, value in zip("xyz", (x, y, z), strict=True)}
            names = ("roll_deg", "pitch_deg", "yaw_deg")
            frame = FrameSection(**lengths, **dict(zip(names, map(math.degrees, angles), strict=True)))
            cell = cell.model_copy(update={"view": cell.view.model_copy(update={"frame": frame})})
        has_tool = cell is not None and cell.tool is not None
        robot = self.robot if has_tool else self.robot.with_geometry(tool=self.model.identified.tool)
        return ArmInCell.of(robot, cell)

    def knowledge(self, arm: ArmInCell, settings: PlanSettings) -> Knowledge:
        """What is known before the first pose of the plan is measured.

        Raises:
            IdentificationError: the model does not say how uncertain it is.
            MeasurementError: the rows that were measured cannot be used.
            PlanningError: the settings do not go together.
        """
        views = views_of(settings, arm)
        if views is not None:
            knowledge = self._seen_by_camera(arm, settings, views)
        else:
            tracker = arm.cell.tracker
            anchor = None if tracker is None else tracker.position
            if self.model is not None:
                T = self._from_cell()
                anchor = None if anchor is None else T[:3, :3] @ anchor + T[:3, 3]
                knowledge = Knowledge.of_model(self.model, instrument_of(settings, anchor))
            else:
                knowledge = Knowledge.of_robot(arm.robot, instrument_of(settings, anchor))
        if settings.measured is None:
            return knowledge
        rows = read_planned_rows(settings, settings.measured, arm.robot).split_sets()[0]
        return knowledge.after(rows) if self.model is None else knowledge.informed(rows.q)

    def _seen_by_camera(self, arm: ArmInCell, settings: PlanSettings, views: BoardViews) -> Knowledge:
        """What is known in the frame of the board, or of a fixed camera.

        A model that was calibrated with other ones, or with another sensor, says nothing of where they are.
        """
        instrument, drawn = instrument_of(settings), torch.tensor(arm.drawn.base)
        base = xyzrpy_from_transform(invert(views.T_cell_frame) @ transform_from_xyzrpy(drawn)).numpy()
        tool = arm.robot.tool
        if self.model is None:
            robot = arm.robot.with_geometry(base=_regular(base), tool=_regular(tool))
            return Knowledge.of_robot(robot, instrument)
        knowledge, fitted = Knowledge.of_model(self.model, instrument), self.model.identified
        if _is_same(base, fitted.base) and _is_same(tool, fitted.tool):
            return knowledge
        return knowledge.seen_anew(_regular(base), _regular(tool))

    @property
    def _saw_board(self) -> bool:
        """Whether the model was calibrated with a camera."""
        uncertainty = None if self.model is None else self.model.uncertainty
        return uncertainty is not None and "corner" in uncertainty.noise

    def _from_cell(self) -> Float64[Tensor, "4 4"]:
        """The cell's frame, that of the drawn robot's base, in the frame that the model's poses are in [m]."""
        assert self.model is not None
        drawn, fitted = (
            transform_from_xyzrpy(torch.tensor(robot.base)) for robot in (self.robot, self.model.identified)
        )
        return fitted @ invert(drawn)


def _is_same(one: Float64[np.ndarray, " 6"], other: Float64[np.ndarray, " 6"]) -> bool:
    """Whether two frames, as x, y, z, roll, pitch, yaw, are the same."""
    T = transform_from_xyzrpy(torch.tensor(np.stack([one, other])))
    return float((T[0] - T[1]).abs().max()) < SAME


def _regular(xyzrpy: Float64[np.ndarray, " 6"]) -> Float64[np.ndarray, " 6"]:
    """A frame whose angles are three unknowns, which they are not at a pitch of 90 deg."""
    pitch = np.clip(xyzrpy[4], -STEEPEST, STEEPEST)
    return np.concatenate([xyzrpy[:4], [pitch], xyzrpy[5:]])
