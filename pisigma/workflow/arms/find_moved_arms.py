"""Find the base of calibrated arms, or the shared frame, that was moved, from a few new rows."""

import math
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Float64
from pydantic import Field
from torch import Tensor

from pisigma.calibration.frames.shared_objects import ArmPosterior
from pisigma.files.errors import ModelError, Place, choice_remedy
from pisigma.files.model_files import model_hash
from pisigma.files.yaml_file import StoredFigures, read_yaml
from pisigma.lifetime.comparison.moved_bases import MovedBases, MovedBody, RemeasuredArm, find_moved_bases
from pisigma.lifetime.recalibration.movement import sigma_along
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.camera.corner_file import MeasurementFiles, read_rows
from pisigma.measurement.dataset import Measurements
from pisigma.model.folder.model_folder import load_model
from pisigma.model.frame_model import frames_of_model
from pisigma.robot.se3 import transform_from_xyz_zyx
from pisigma.validation.held_out.arms_summary import ArmsSummary, Six
from pisigma.workflow.arms.calibrate_arms import FRAMES_FILE

Three = tuple[float, float, float]


class MovedFigures(StoredFigures):
    """An arm, a frame, or the zero of the first joint of a torso that may have moved.

    Attributes:
        kind: "arm" (its base, or the one base of the arms of a torso), "frame" or "joint" (its zero).
        name: name of the arm (the first one of a torso), frame or joint.
        is_best_explanation: whether its motion explains the rows best; if this is true of several, the rows cannot
            distinguish them.
        shift_mm: shift of its origin along x, y, z of the first arm's base [mm], if only it moved.
        rotation_deg: rotation about these axes [deg], as a rotation vector.
        standard_errors: standard errors of shift and rotation [mm and deg].
        shift_standard_error_mm: standard error of the length of the shift [mm].
        log_likelihood: log likelihood if only it moved, relative to no motion [nats].
    """

    kind: str
    name: str
    is_best_explanation: Annotated[bool, Field(alias="is_named")]
    shift_mm: Three
    rotation_deg: Three
    standard_errors: Six
    shift_standard_error_mm: Annotated[float, Field(alias="distance_error_mm")]
    log_likelihood: float

    @property
    def sentence(self) -> str:
        """Sentence that states the motion."""
        if self.kind == "joint":
            turned, error = math.hypot(*self.rotation_deg), math.hypot(*self.standard_errors[3:])
            return (
                f"the zero of joint '{self.name}' moved by {turned:.3g} deg (standard error {error:.2g} deg)"
            )
        what = "base of arm" if self.kind == "arm" else "frame"
        turned = math.hypot(*self.rotation_deg)
        return (
            f"the {what} '{self.name}' moved by {math.hypot(*self.shift_mm):.3g} mm (standard error "
            f"{self.shift_standard_error_mm:.2g} mm) and {turned:.2g} deg"
        )


@dataclass(frozen=True, eq=False)
class ArmsMovement:
    """Result of `find_moved_arms`.

    Attributes:
        moved_bases: what moved, in SI units.
        bodies: figures of all arms and frames, best explanation first.
        seconds: computing time [s].
    """

    moved_bases: MovedBases
    bodies: tuple[MovedFigures, ...]
    seconds: float

    @property
    def sentence(self) -> str:
        """Sentence that states what moved."""
        named = [one.sentence for one in self.bodies if one.is_best_explanation]
        if not named:
            return "Nothing moved."
        doubt = (
            ", which the rows cannot distinguish; measure in a second shared frame" if len(named) > 1 else ""
        )
        text = " or ".join(named)
        if not self.moved_bases.is_one_body:
            return f"More than one base or frame moved; no single motion explains the rows (best: {text})."
        return f"{text[0].upper()}{text[1:]}{doubt}."

    def to_json(self) -> dict[str, Any]:
        """Return all figures as JSON values, in mm and deg."""
        return {
            "seconds": round(self.seconds, 3),
            "summary": self.sentence,
            "probability": self.moved_bases.p_value,
            "is_one_body": self.moved_bases.is_one_body,
            "bodies": [one.model_dump(mode="json", by_alias=True) for one in self.bodies],
        }


def find_moved_arms(
    folder: str | os.PathLike[str],
    data: Mapping[str, Measurements | MeasurementFiles],
    cameras: Mapping[str, CameraFiles] | None = None,
) -> ArmsMovement:
    """Find the base or shared frame that has been moved since the arms were calibrated, see `find_moved_bases`.

    Args:
        folder: folder with `frames.yaml` and the models of the arms, as `calibrate_arms` wrote it.
        data: six or more new rows of every compared arm, by name of the arm, in frames of its calibration.
        cameras: cameras and boards of arms whose rows are detected corners.

    Returns:
        What moved, with its shift and uncertainty.

    Raises:
        ModelError: an arm is unknown, its model was changed, or its model has no posterior of its parameters, as a
            stored geometric calibration.
        MeasurementError: rows cannot be read.
        IdentificationError: there are too few rows, or none in a frame of the calibration.
    """
    started = time.perf_counter()
    summary = read_yaml(Path(folder) / FRAMES_FILE, ArmsSummary, ModelError)
    poses = _poses_in_first(summary)
    arms = []
    for name, rows in data.items():
        if name not in poses:
            raise ModelError(f"there is no arm '{name}'", value=name, remedy=choice_remedy(name, poses))
        arms.append(_arm(Path(folder), summary, name, poses[name], rows, (cameras or {}).get(name)))
    found = find_moved_bases(arms)
    named = {(one.kind, one.name) for one in found.likely_bodies}
    bodies = tuple(_figures(one, (one.kind, one.name) in named) for one in found.bodies)
    return ArmsMovement(found, bodies, time.perf_counter() - started)


def _poses_in_first(summary: ArmsSummary) -> dict[str, Float64[Tensor, "4 4"]]:
    """Return the base of every arm relative to that of the first arm."""
    first = summary.arms[0].name
    poses = {first: torch.eye(4, dtype=torch.float64)}
    for one in summary.bases:
        if one.other_arm == first:
            angles = np.deg2rad([one.roll_deg, one.pitch_deg, one.yaw_deg])
            xyz_zyx = np.concatenate([np.array([one.x_mm, one.y_mm, one.z_mm]) / 1e3, angles])
            poses[one.arm] = transform_from_xyz_zyx(torch.from_numpy(xyz_zyx))
    return poses


def _arm(
    folder: Path,
    summary: ArmsSummary,
    name: str,
    T_first_base: Float64[Tensor, "4 4"],
    data: Measurements | MeasurementFiles,
    cameras: CameraFiles | None,
) -> RemeasuredArm:
    stated = next(one for one in summary.arms if one.name == name)
    if model_hash(folder / name) != stated.sha256:
        raise ModelError(
            "the model was changed after the bases were found",
            at=Place(folder / name),
            remedy="calibrate the arms again",
        )
    model = load_model(folder / name)
    if model.uncertainty is None:
        raise ModelError(
            f"model '{name}' ({model.kind}) has no posterior of its parameters",
            value=model.kind,
            at=Place(folder / name),
            remedy="calibrate the arms without `model: geometric`",
        )
    rows = read_rows(data, model.robot, cameras)
    return RemeasuredArm(
        ArmPosterior(name, model.uncertainty, torso_joints=stated.torso),
        T_first_base,
        frames_of_model(model, rows, "base"),
    )


def _figures(one: MovedBody, is_best: bool) -> MovedFigures:
    sizes = one.covariance.diagonal().sqrt() * torch.tensor([1e3] * 3 + [math.degrees(1)] * 3).double()
    return MovedFigures(
        kind=one.kind,
        name=one.name,
        is_best_explanation=is_best,
        shift_mm=tuple((one.shift * 1e3).tolist()),
        rotation_deg=tuple(one.rotation.rad2deg().tolist()),
        standard_errors=tuple(sizes.tolist()),
        shift_standard_error_mm=sigma_along(one.shift, one.covariance[:3, :3]) * 1e3,
        log_likelihood=one.log_likelihood,
    )
