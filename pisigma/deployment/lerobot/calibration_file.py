"""Corrected joint zeros in LeRobot's calibration file."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.deployment.export.geometry import offset_remarks
from pisigma.deployment.export.joint_offsets import fit_joint_offsets, offset_sentences
from pisigma.files.errors import MeasurementError, OutputError, Phrase, Place
from pisigma.measurement.foreign.lerobot_motors import (
    DAMIAO,
    TICKS,
    Motor,
    check_values,
    motors_text,
    radians_per_unit,
    read_motors,
)
from pisigma.model.calibrated_model import CalibratedModel

README = "README.md"
_NOT_EXPRESSED = (
    "LeRobot's file has one zero per motor, in the middle of range_min and range_max: lengths of links, angles between "
    "axes, backlash and gravity cannot be expressed in it.",
    "Zeros are rounded to half a tick (0.04 deg). One end of a range is moved inwards by twice the offset, so that the "
    "motor stays within the range that was recorded; homing_offset is unchanged.",
    "The directions of the joints (drive_mode) are unchanged: LeRobot ignores drive_mode for degrees.",
    "The file is valid only for use_degrees=true. The scale of values from -100 to 100 depends on the range: correct "
    "the frames of such policies and data sets with pisigma.LeRobotCorrection instead.",
    "The file replaces only the calibration file with which the rows of the model were recorded: LeRobot's calibration "
    "sets other zeros, so calibrate again after it.",
    "Use either this file or corrected frames, not both: the correction would be applied twice.",
)


def with_offset(motor: Motor, ticks: float, at: Place) -> Motor:
    """Return a motor whose position of 0 deg is moved so that its values increase by an offset.

    Args:
        motor: the motor.
        ticks: increase of its values [ticks].
        at: place of the motor, for messages.

    Raises:
        OutputError: the range would become empty.
    """
    cut = round(2 * ticks)
    moved = replace(motor, range_min=motor.range_min + max(-cut, 0), range_max=motor.range_max - max(cut, 0))
    if moved.range_min >= moved.range_max:
        raise OutputError(
            expected=f"an offset below half of the range of {motor.range_max - motor.range_min} ticks",
            value=ticks,
            at=at,
            remedy="calibrate the motors with LeRobot again, with the arm in the middle of its ranges",
        )
    return moved


def with_offsets(motors: Mapping[str, Motor], offsets: Mapping[str, float], file: Path) -> dict[str, Motor]:
    """Return all motors, with changed zeros for those of joints.

    Args:
        motors: motors of the arm.
        offsets: offset of every joint [rad], by the name of its motor.
        file: file of the motors, for messages.

    Raises:
        OutputError: a joint has no motor or no zero in the file, or a range would become empty.
    """
    if any(DAMIAO.fullmatch(name) for name in offsets):
        raise OutputError(
            "the zeros of OpenArm's motors are not in the calibration file",
            at=Place(file),
            option="--like",
            remedy="correct the frames of policies and data sets with pisigma.LeRobotCorrection instead",
        )
    if missing := sorted(set(offsets) - set(motors)):
        raise OutputError(
            expected=f"motors named {', '.join(offsets)}, as the joints of the robot",
            value=Phrase(", ".join(motors)),
            at=Place(file),
            option="--like",
            remedy=f"give the calibration file of this arm, or rename joint {missing[0]} of the robot",
        )
    return {
        name: with_offset(motor, offsets[name] / (2 * np.pi) * TICKS, Place(file, column=name))
        if name in offsets
        else motor
        for name, motor in motors.items()
    }


def _check_rows(model: CalibratedModel, motors: Mapping[str, Motor], file: Path) -> None:
    """Check that the joint values of the calibration are possible with this calibration file.

    Raises:
        OutputError: the joint values are impossible, so the zeros of the model are those of another file.
    """
    names = [axis.name for axis in model.robot.axes]
    recorded = model.starts.numpy() / np.array([radians_per_unit("degrees", name, None) for name in names])
    try:
        check_values(recorded, "degrees", names, motors, file)
    except MeasurementError as problem:
        raise OutputError(
            "the model was calibrated with joint values that are not possible with this file",
            expected=problem.expected,
            value=problem.value,
            at=Place(file, column=problem.column),
            option="--like",
            remedy="give the file with which the rows of the calibration were recorded",
        ) from None


def _write(request: ExportRequest) -> Exported:
    assert request.like is not None  # see `_check`
    motors = read_motors(request.like)
    model = request.load()
    _check_rows(model, motors, request.like)
    fitted = fit_joint_offsets(model)
    offsets = dict(zip([axis.name for axis in fitted.robot.axes], fitted.values.tolist(), strict=True))
    text = motors_text(with_offsets(motors, offsets, request.like))
    sentences = (*offset_remarks(model), *offset_sentences(fitted), *_NOT_EXPRESSED)
    title = f"# LeRobot calibration of model {model.name} (robot {model.robot.name})"
    facts = model_facts(model) | fitted.departures()
    facts["offsets_deg"] = {name: float(np.rad2deg(value)) for name, value in offsets.items()}
    readme = "\n\n".join((title, *sentences)) + "\n"
    content = {request.like.name: text.encode(), README: readme.encode()}
    return Exported(content, facts, sentences)


def _check(request: ExportRequest) -> None:
    if request.like is None or request.like.suffix.lower() != ".json":
        raise OutputError(
            expected="LeRobot's present calibration file (.json)",
            value=None if request.like is None else str(request.like),
            option="--like",
            remedy="give the file in ~/.cache/huggingface/lerobot/calibration",
        )


FORMAT = ExportFormat(
    "lerobot",
    "LeRobot's calibration file with corrected zeros",
    (),
    _write,
    frozenset(("like", "payload_kg", "temperature_c")),
    _check,
    contains="joint_zeros",
)
