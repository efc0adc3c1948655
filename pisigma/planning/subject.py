"""Subject of a plan: a nominal or calibrated robot, and the distribution of its unknowns."""

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
from pisigma.model.folder.model_folder import HasModel, load_model
from pisigma.planning.board_views import ViewConditions
from pisigma.planning.plan_inputs import instrument_of, read_planned_rows, views_of
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.robot_posterior import RobotPosterior
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.planning.surroundings.surroundings import Surroundings
from pisigma.robot.description import Robot
from pisigma.robot.robot_file import FrameSection
from pisigma.robot.se3 import invert, transform_from_xyz_zyx, xyz_zyx_from_transform

_SAME_FRAME = 1e-6
"""Difference [m or rad] below which the frames of a plan equal the frames with which the model was calibrated."""
_MAX_PITCH = 1.52
"""Largest pitch of base and tool at which derivatives are computed [rad]; roll and yaw are degenerate at 90 deg."""


@dataclass(frozen=True, eq=False)
class RobotOrModel:
    """The robot or model for which a measurement is planned.

    Attributes:
        robot: nominal robot.
        model: calibrated model; None for a robot that has not been calibrated.
        folder: folder of the model; None if the model is only in memory or there is none.
    """

    robot: Robot
    model: CalibratedModel | None = None
    folder: Path | None = None

    @staticmethod
    def load(
        subject: Robot | CalibratedModel | HasModel | str | os.PathLike[str],
        base: str | None = None,
        tip: str | None = None,
    ) -> "RobotOrModel":
        """Load a robot or a model.

        Args:
            subject: a robot, a name of the catalogue, a robot file (YAML or URDF), a model, an object that has a model,
                or a model folder.
            base: base link of a URDF file; poses are in its frame.
            tip: tool link of a URDF file.

        Raises:
            RobotError: the robot is unknown.
            ModelError: the folder cannot be used.
        """
        if isinstance(subject, Robot):
            return RobotOrModel(subject)
        if isinstance(subject, HasModel):
            subject = subject.model
        if not isinstance(subject, CalibratedModel):
            if not Path(subject).is_dir():
                return RobotOrModel(Robot.load(subject, base, tip))
            return replace(RobotOrModel.load(load_model(Path(subject))), folder=Path(subject))
        if subject.nominal is None:
            raise PlanningError(
                f"model '{subject.name}' does not store the nominal robot",
                value=subject.name,
                remedy="plan for its robot instead",
            )
        return RobotOrModel(subject.nominal, subject)

    def arm(self, surroundings: Surroundings | None) -> ArmInSurroundings:
        """Return the robot in its surroundings; target and board come from the surroundings or from the model."""
        if self.model is None:
            return ArmInSurroundings.from_robot(self.robot, surroundings)
        if (
            surroundings is not None
            and surroundings.view is not None
            and surroundings.view.frame is None
            and self._saw_board
        ):
            x, y, z, *angles = xyz_zyx_from_transform(invert(self._from_cell())).tolist()
            lengths = {f"{name}_mm": value * 1e3 for name, value in zip("xyz", (x, y, z), strict=True)}
            names = ("roll_deg", "pitch_deg", "yaw_deg")
            frame = FrameSection(**lengths, **dict(zip(names, map(math.degrees, angles), strict=True)))
            surroundings = surroundings.model_copy(
                update={"view": surroundings.view.model_copy(update={"frame": frame})}
            )
        has_tool = surroundings is not None and surroundings.tool is not None
        robot = self.robot if has_tool else self.robot.with_geometry(tool=self.model.identified.tool)
        return ArmInSurroundings.from_robot(robot, surroundings)

    def posterior(self, arm: ArmInSurroundings, settings: PlanSettings) -> RobotPosterior:
        """Return the distribution of the unknowns before the first pose of the plan is measured.

        Raises:
            IdentificationError: the model stores no posterior.
            MeasurementError: the measured rows cannot be used.
            PlanningError: the settings do not fit together.
        """
        views = views_of(settings, arm)
        if views is not None:
            posterior = self._seen_by_camera(arm, settings, views)
        else:
            tracker = arm.surroundings.tracker
            anchor = None if tracker is None else tracker.position
            if self.model is not None:
                T = self._from_cell()
                anchor = None if anchor is None else T[:3, :3] @ anchor + T[:3, 3]
                posterior = RobotPosterior.from_model(self.model, instrument_of(settings, anchor))
            else:
                posterior = RobotPosterior.from_robot(arm.robot, instrument_of(settings, anchor))
        if settings.measured is None:
            return posterior
        rows = read_planned_rows(settings, settings.measured, arm.robot).split_sets()[0]
        return posterior.calibrated_with(rows) if self.model is None else posterior.after_measuring(rows.q)

    def _seen_by_camera(
        self, arm: ArmInSurroundings, settings: PlanSettings, views: ViewConditions
    ) -> RobotPosterior:
        """Return the distribution of the unknowns in the frame of the board, or of a fixed camera.

        A model that was calibrated with another board, camera or sensor does not determine the poses of board and
        camera.
        """
        instrument, nominal_base = instrument_of(settings), torch.tensor(arm.nominal.base)
        base = xyz_zyx_from_transform(
            invert(views.T_cell_frame) @ transform_from_xyz_zyx(nominal_base)
        ).numpy()
        tool = arm.robot.tool
        if self.model is None:
            robot = arm.robot.with_geometry(base=_regular(base), tool=_regular(tool))
            return RobotPosterior.from_robot(robot, instrument)
        posterior, fitted = RobotPosterior.from_model(self.model, instrument), self.model.identified
        if _is_same(base, fitted.base) and _is_same(tool, fitted.tool):
            return posterior
        return posterior.with_unknown_base_and_tool(_regular(base), _regular(tool))

    @property
    def _saw_board(self) -> bool:
        """Whether the model was calibrated with a camera."""
        uncertainty = None if self.model is None else self.model.uncertainty
        return uncertainty is not None and "corner" in uncertainty.noise.value

    def _from_cell(self) -> Float64[Tensor, "4 4"]:
        """Return the frame of the nominal base in the frame of the model's poses [m]."""
        assert self.model is not None
        nominal_base, fitted = (
            transform_from_xyz_zyx(torch.tensor(robot.base)) for robot in (self.robot, self.model.identified)
        )
        return fitted @ invert(nominal_base)


def _is_same(one: Float64[np.ndarray, " 6"], other: Float64[np.ndarray, " 6"]) -> bool:
    """Return whether two frames, as x, y, z, roll, pitch, yaw [m, rad], are the same."""
    T = transform_from_xyz_zyx(torch.tensor(np.stack([one, other])))
    return float((T[0] - T[1]).abs().max()) < _SAME_FRAME


def _regular(xyz_zyx: Float64[np.ndarray, " 6"]) -> Float64[np.ndarray, " 6"]:
    """Return a frame with limited pitch, so that its three angles are independent."""
    pitch = np.clip(xyz_zyx[4], -_MAX_PITCH, _MAX_PITCH)
    return np.concatenate([xyz_zyx[:4], [pitch], xyz_zyx[5:]])
