"""What measurements are planned for: a robot as drawn or a calibrated one, and what is known of it."""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import PlanningError
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model
from pisigma.model.model_source import HoldsModel
from pisigma.planning.cell.arm_in_cell import ArmInCell
from pisigma.planning.cell.cell import Cell
from pisigma.planning.knowledge import Knowledge
from pisigma.planning.plan_settings import PlanSettings
from pisigma.robot.description import Robot
from pisigma.se3 import invert, transform_from_xyzrpy


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
        """The robot in its cell, with the reflector where the cell says, or else where the model has its tool."""
        if self.model is None or (cell is not None and cell.tool is not None):
            return ArmInCell.of(self.robot, cell)
        return ArmInCell.of(self.robot.with_geometry(tool=self.model.identified.tool), cell)

    def knowledge(self, arm: ArmInCell, settings: PlanSettings) -> Knowledge:
        """What is known before the first pose of the plan is measured.

        Raises:
            IdentificationError: the model does not say how uncertain it is.
            MeasurementError: the rows that were measured cannot be used.
            PlanningError: the settings do not go together.
        """
        tracker = arm.cell.tracker
        anchor = None if tracker is None else tracker.position
        if self.model is not None:
            instrument = settings.instrument(None if anchor is None else self._in_frame(anchor))
            knowledge = Knowledge.of_model(self.model, instrument)
        else:
            knowledge = Knowledge.of_robot(arm.robot, settings.instrument(anchor))
        if settings.measured is None:
            return knowledge
        rows = Measurements.read_csv(settings.measured, arm.robot).split_sets()[0]
        return knowledge.after(rows) if self.model is None else knowledge.informed(rows.q)

    def _in_frame(self, point: Float64[Tensor, " 3"]) -> Float64[Tensor, " 3"]:
        """A point of the drawn robot's base frame in the frame that the model's positions are in [m]."""
        assert self.model is not None
        drawn, fitted = (
            transform_from_xyzrpy(torch.tensor(robot.base)) for robot in (self.robot, self.model.identified)
        )
        T = fitted @ invert(drawn)
        return T[:3, :3] @ point + T[:3, 3]
