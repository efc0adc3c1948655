"""Inputs of a plan from its settings: instrument, candidate poses, measured rows, and views of a camera."""

import os
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import MeasurementError, Place, PlanningError
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.corner_file import read_rows
from pisigma.measurement.csv.reading import contains_measurements, read_joints
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.exceeded_limits import row_warnings
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.training_rows import training_row_mask, training_row_warnings
from pisigma.planning.board_sight import BoardSight
from pisigma.planning.board_views import ViewConditions
from pisigma.planning.candidates import (
    Candidates,
    Workspace,
    draw_candidates,
    read_candidates,
    with_workspace,
)
from pisigma.planning.plan_settings import CameraSettings, PlanSettings
from pisigma.planning.robot_posterior import Instrument
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.robot.description import Robot
from pisigma.validation.checks.check import MOVES
from pisigma.validation.gate import check_rows

_WORKSPACE_POSES = 1000
"""Number of poses that represent the workspace if a camera measures."""


def instrument_of(settings: PlanSettings, anchor: Float64[Tensor, " 3"] | None = None) -> Instrument:
    """Return the measuring instrument.

    Args:
        settings: settings of the plan.
        anchor: origin of distances in the measuring frame [m].

    Raises:
        PlanningError: distances are measured, but their origin is not stated.
    """
    if settings.camera is not None:
        return Instrument(settings.sensor, sight=sight_of(settings.camera))
    if settings.sensor == "distance" and anchor is None:
        raise PlanningError(
            "the origin of the measured distances is not stated",
            expected="the origin of the measured distances",
            option="--surroundings",
            remedy="state it as tracker in the surroundings",
        )
    stated: dict[str, Any] = {} if settings.sigma_mm is None else {"sigma": settings.sigma_mm / 1e3}
    stated |= {} if anchor is None else {"anchor": tuple(anchor.tolist())}
    return Instrument(settings.sensor, **stated)


def find_candidates(settings: PlanSettings, arm: ArmInSurroundings) -> Candidates:
    """Draw or read the poses from which a plan is selected.

    Raises:
        MeasurementError: the file of candidates cannot be used.
        PlanningError: a prismatic joint has no limits.
    """
    views, workspace = views_of(settings, arm), workspace_of(settings)
    if settings.candidates_from is not None:
        candidates = read_candidates(arm, settings.candidates_from, workspace, views)
    else:
        candidates = draw_candidates(arm, settings.candidates, settings.seed, workspace, views)
    if views is None:
        return candidates
    return with_workspace(arm, candidates, draw_candidates(arm, _WORKSPACE_POSES, settings.seed, workspace))


def allow_measured_poses(settings: PlanSettings, arm: ArmInSurroundings) -> ArmInSurroundings:
    """Return the arm, modified so that measured candidates are free of self-collision.

    Raises:
        MeasurementError: the file of candidates cannot be used.
    """
    if settings.candidates_from is None or not contains_measurements(settings.candidates_from):
        return arm
    return arm.allow_measured_poses(read_joints(settings.candidates_from, arm.robot))


def workspace_of(settings: PlanSettings) -> Workspace | None:
    """Return the box in which the reflector, or the target of a camera, is measured; None for anywhere."""
    if settings.box_mm is None:
        return None
    return torch.tensor(settings.box_mm, dtype=torch.float64).reshape(2, 3) / 1e3


def read_planned_rows(settings: PlanSettings, path: str | os.PathLike[str], robot: Robot) -> Measurements:
    """Read measured rows, or corners detected in images.

    Raises:
        MeasurementError: the file cannot be used.
    """
    return read_rows(path, robot, None if settings.camera is None else settings.camera.files)


def views_of(settings: PlanSettings, arm: ArmInSurroundings) -> ViewConditions | None:
    """Return the conditions under which the camera sees its board; None without a camera.

    Raises:
        PlanningError: the surroundings do not state these conditions.
    """
    if settings.camera is None:
        return None
    view = arm.surroundings.view
    if view is None or view.T_cell_frame is None:
        frame, target = ("camera", "board") if settings.camera.is_fixed else ("board", "camera")
        raise PlanningError(
            f"the surroundings do not state where the {frame} is and at which depths images are sharp",
            expected=f"the pose of the {frame} and the depths at which images are sharp",
            option="--surroundings",
            remedy="state them as view: {frame: {x_mm: 400, z_mm: 50, yaw_deg: 180}, near_mm: 300, far_mm: 700}, and "
            f"the pose of the {target} on the flange as tool",
        )
    return ViewConditions.from_sight(sight_of(settings.camera), view.T_cell_frame, view)


def sight_of(camera: CameraSettings) -> BoardSight:
    """Load camera and board.

    Raises:
        MeasurementError: a file cannot be used.
    """
    seen_by, board = Camera.load(camera.camera), Board.load(camera.board)
    is_fixed = camera.is_fixed or seen_by.is_fixed
    return BoardSight(seen_by, board, is_fixed, camera.sigma_px, camera.repeatability)


def check_measured(model: CalibratedModel | None, settings: PlanSettings, robot: Robot) -> tuple[str, ...]:
    """Refuse measurements with a fault of the setup, and measurements to which the model was fitted.

    Returns:
        Warnings, such as that the model may have been fitted to some of the measurements.

    Raises:
        MeasurementError: the measurements cannot be used; the message names the fault.
    """
    if settings.measured is None:
        return ()
    rows = read_planned_rows(settings, settings.measured, robot).split_sets()[0]
    against = robot if model is None else model
    if implausible := check_rows(rows, against, allowed_moves=MOVES).implausible_findings:
        raise MeasurementError(f"{settings.measured}: {implausible[0].sentence}", value=implausible[0].kind)
    if model is not None and bool(training_row_mask(model, rows).all()):
        raise MeasurementError(
            f"expected rows to which model '{model.name}' was not fitted, got only rows of its calibration, which "
            "would count twice",
            value=model.name,
            at=Place(settings.measured),
            option="--measured",
            remedy="omit --measured",
        )
    twice = "the measurements count twice, and the expected errors are too small"
    known = () if model is None else training_row_warnings(model, rows, consequence=twice)
    return (*row_warnings(robot, rows), *known)
