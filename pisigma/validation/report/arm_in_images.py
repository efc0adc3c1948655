"""The nominal and the calibrated arm in the images of a board: predicted corners, links, errors and joint zeros."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.parameters import direction_by_zero_parameter
from pisigma.files.errors import MeasurementError, Phrase, Place
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.corner import as_poses
from pisigma.measurement.sensors.intrinsics import CAMERA_COLUMN, boards, texts_of
from pisigma.model.calibrated_model import CalibratedModel, corrected_joints, poses_of_rows
from pisigma.model.training_rows import training_row_mask
from pisigma.robot.kinematics.components import as_transform
from pisigma.robot.kinematics.forward import Geometry, iterate_rows
from pisigma.robot.se3 import invert, transform, transform_from_xyz_zyx
from pisigma.validation.held_out.calibration_summary import CalibrationSummary
from pisigma.validation.held_out.reference_models import nominal_model


@dataclass(frozen=True, eq=False)
class PredictedArm:
    """Prediction of a model in an image.

    Attributes:
        corner_pixels: pixels of the corners of the board [px].
        frame_pixels: pixels of the origins of the frames of the arm, from the base to the tool [px]; NaN behind the
            camera; empty for a camera on the arm, which does not see it.
    """

    corner_pixels: Float64[np.ndarray, "corners 2"]
    frame_pixels: Float64[np.ndarray, "_frames 2"]


@dataclass(frozen=True, eq=False)
class ArmInImage:
    """The nominal and the calibrated arm in an image.

    Attributes:
        file: file of the image.
        name: name of the image.
        size: width and height of the image [px].
        measured_corners: pixels of the corners at the measured pose of the board [px].
        nominal: prediction of the nominal arm.
        calibrated: prediction of the calibrated arm.
        nominal_error: distance between the predicted and the measured board under the nominal arm [m].
        calibrated_error: the same under the calibrated arm [m].
    """

    file: Path
    name: str
    size: tuple[int, int]
    measured_corners: Float64[np.ndarray, "corners 2"]
    nominal: PredictedArm
    calibrated: PredictedArm
    nominal_error: float
    calibrated_error: float


@dataclass(frozen=True)
class JointZero:
    """Error of the zero of a joint.

    Attributes:
        joint: name of the joint.
        zero_shift_deg: calibrated minus nominal zero, in the direction of the joint [deg].
        standard_error_deg: its standard error [deg]; None if the rows do not determine it.
    """

    joint: str
    zero_shift_deg: float
    standard_error_deg: float | None


@dataclass(frozen=True, eq=False)
class ArmInImages:
    """The nominal and the calibrated arm in all images.

    Attributes:
        images: the images, in the order of the rows.
        zeros: zeros of the revolute joints.
        training_images: number of the images to which the calibrated arm was fitted.
    """

    images: tuple[ArmInImage, ...]
    zeros: tuple[JointZero, ...]
    training_images: int

    @property
    def nominal_rms(self) -> float:
        """RMS error of the nominal arm, with base and tool fitted to the calibrated one [m]."""
        return float(np.sqrt(np.mean([one.nominal_error**2 for one in self.images])))

    @property
    def calibrated_rms(self) -> float:
        """RMS error of the calibrated arm, including the scatter of the joints [m]."""
        return float(np.sqrt(np.mean([one.calibrated_error**2 for one in self.images])))

    @property
    def error_halvings(self) -> float:
        """Number of times that the error is halved, `log2(nominal / calibrated)`."""
        return math.log2(self.nominal_rms / self.calibrated_rms)

    def to_json(self) -> dict[str, object]:
        """Return all figures as plain values [mm and deg]."""
        return {
            "nominal_rms_mm": self.nominal_rms * 1e3,
            "calibrated_rms_mm": self.calibrated_rms * 1e3,
            "halvings": self.error_halvings,
            "training_images": self.training_images,
            "images": [
                {
                    "name": one.name,
                    "nominal_mm": one.nominal_error * 1e3,
                    "calibrated_mm": one.calibrated_error * 1e3,
                }
                for one in self.images
            ],
            "zeros": [
                {
                    "joint": one.joint,
                    "error_deg": one.zero_shift_deg,
                    "standard_error_deg": one.standard_error_deg,
                }
                for one in self.zeros
            ],
        }


def arm_in_images(
    model: CalibratedModel, rows: Measurements, cameras: CameraFiles, files: tuple[Path, ...]
) -> ArmInImages:
    """Predict where the nominal and the calibrated arm are in images.

    Args:
        model: the model.
        rows: rows of the images, with their names.
        cameras: cameras and boards of the images.
        files: files of the images.

    Raises:
        MeasurementError: no row belongs to one of the images.
        ModelError: the model does not store enough joint values to fit base and tool of the nominal robot.
    """
    by_name = {file.stem: file for file in files}
    chosen = [row for row, name in enumerate(rows.image or ()) if name in by_name]
    if not chosen:
        raise MeasurementError(
            expected="the names of the images in the file of corners",
            value=Phrase(", ".join(sorted(by_name)[:3])),
            at=Place(rows.source, column="image"),
            remedy="give the images from which `pisigma detect` made the file of corners",
        )
    training_images = int(training_row_mask(model, rows)[chosen].sum())
    rows = rows.select(torch.tensor(chosen))
    unknowns = {} if model.uncertainty is None else model.uncertainty.geometry.unknowns
    measured = as_poses(rows, unknowns)
    assert measured.position is not None
    assert measured.rotation is not None
    T_measured = transform(measured.rotation, measured.position)
    nominal = nominal_model(model, with_orientation=True)
    T_nominal, T_calibrated = poses_of_rows(nominal, rows), poses_of_rows(model, rows)
    links = [_links(one, rows, T) for one, T in ((nominal, T_nominal), (model, T_calibrated))]
    known = {one.name: one for one in map(Camera.load, cameras.cameras)}
    of_board = {one.name: one for one in map(Board.load, cameras.boards)}
    names, board_names = texts_of(rows, CAMERA_COLUMN), boards(rows) or ()
    images = []
    for row in range(rows.rows):
        camera = known[names[row]]
        found = unknowns.get("camera", {}).get(camera.name)
        camera = camera if found is None else camera.with_intrinsics(np.asarray(found))
        corners, is_fixed = of_board[board_names[row]].corners, rows.frame[row] == camera.name

        def seen(T: Tensor, camera: Camera = camera, corners: np.ndarray = corners) -> np.ndarray:
            return _pixels(camera, corners, T)

        each = [T[row] if is_fixed else invert(T[row]) for T in (T_measured, T_nominal, T_calibrated)]
        points = [_pixels(camera, one[row].numpy(), torch.eye(4).double()) for one in links]
        before, after = (
            PredictedArm(seen(T), at if is_fixed else at[:0]) for T, at in zip(each[1:], points, strict=True)
        )
        errors = [float((T[:3, 3] - each[0][:3, 3]).norm()) for T in each[1:]]
        image = (rows.image or ())[row]
        size = (camera.width, camera.height)
        images.append(ArmInImage(by_name[image], image, size, seen(each[0]), before, after, *errors))
    return ArmInImages(tuple(images), _zeros(model), training_images)


def _pixels(camera: Camera, points: Float64[np.ndarray, "points 3"], T: Tensor) -> np.ndarray:
    """Return the pixels of points in a frame whose pose in the frame of the camera is T; NaN behind the camera."""
    there = points @ T[:3, :3].numpy().T + T[:3, 3].numpy()
    there[there[:, 2] <= 0] = np.nan
    return camera.project(there)[0]


def _links(
    model: CalibratedModel, rows: Measurements, T: Float64[Tensor, "rows 4 4"]
) -> Float64[Tensor, "rows frames 3"]:
    """Return the origins of the frames of the arm, from the base to the tool, in the frame of every row [m].

    Args:
        model: the model.
        rows: the rows.
        T: poses of their targets in their frames, as the model predicts them.
    """
    hybrid = model.hybrid
    robot = model.identified if hybrid is None else hybrid.robot
    tools = model.tools if hybrid is None else model.hybrid_tools
    q = rows.q if hybrid is None else corrected_joints(hybrid, rows)
    frames = list(iterate_rows(robot, Geometry.from_robot(robot), q.unbind(-1)))
    chain = [as_transform(frame, q[:, 0]) for frame in (frames[0].before, *(one.after for one in frames))]
    tool = torch.from_numpy(np.stack([np.asarray(tools.get(name, robot.tool)) for name in rows.target]))
    T_frame_base = T @ invert(transform_from_xyz_zyx(tool)) @ invert(chain[-1])
    origins = [(T_frame_base @ one)[:, :3, 3] for one in chain]
    return torch.stack([*origins, T[:, :3, 3]], 1)


def _zeros(model: CalibratedModel) -> tuple[JointZero, ...]:
    """Return the zeros of the revolute joints from the figures of the calibration; empty for other models."""
    summary = CalibrationSummary.read(model)
    if summary is None:
        return ()
    figures, robot = {one.name: one for one in summary.parameters}, model.robot
    zeros = []
    for joint, (name, direction) in zip(
        robot.joints, direction_by_zero_parameter(robot).items(), strict=True
    ):
        one = figures.get(name)
        if joint.type == "revolute" and one is not None and one.change is not None:
            known = None if "prior" in one.short_remark else one.standard_error
            zeros.append(JointZero(joint.name, direction * one.change, known))
    return tuple(zeros)
