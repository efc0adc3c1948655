"""Motors of a LeRobot arm: its calibration file, and the units of the joint values that it records."""

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float

from pisigma.files.errors import MeasurementError, Phrase, Place, check_choice
from pisigma.files.input_file import read_text

LeRobotUnits = Literal["degrees", "normalized"]
"""Units of LeRobot: degrees (`use_degrees=true`), or values of -100 to 100 over the range of a motor."""
TICKS = 4096
"""Positions per turn of the 12-bit encoders of Feetech STS3215, Dynamixel XL330 and XL430 servos."""
DAMIAO = re.compile(r"joint_\d+")
"""Names of OpenArm's motors, which themselves send degrees; their zero is set in the motor, not by a range."""
_BEYOND_RANGE = 10.0
"""Largest angle by which a motor may leave the range that was recorded for it by hand [deg]."""
_NORMALIZED = 200.0
"""Length of the interval from -100 to 100."""


@dataclass(frozen=True)
class Motor:
    """A motor in LeRobot's calibration file; positions are those of its register, with the homing offset applied.

    Attributes:
        id: number of the motor on the bus.
        drive_mode: 1 if the motor counts in the opposite direction, otherwise 0. LeRobot ignores this for degrees.
        homing_offset: offset in the motor's memory [ticks].
        range_min: lowest position [ticks].
        range_max: highest position [ticks]; 0 deg is midway between the lowest and the highest position.
    """

    id: int
    drive_mode: int
    homing_offset: int
    range_min: int
    range_max: int


def read_motors(path: str | os.PathLike[str]) -> dict[str, Motor]:
    """Read LeRobot's calibration file (JSON, LeRobot 0.2 and later): motors by name, in the order of the file.

    Raises:
        MeasurementError: the file cannot be read or is not a calibration file; the exception states the file and the
            motor.
    """
    text = read_text(path, MeasurementError, "JSON")
    keys = [field.name for field in fields(Motor)]
    expected = f"a LeRobot calibration: an object of motors, each with {', '.join(keys)}"
    try:
        document = json.loads(text)
    except ValueError as problem:
        raise MeasurementError(
            f"the file is not valid JSON: {getattr(problem, 'msg', problem)}",
            expected=expected,
            at=Place(path, getattr(problem, "lineno", None)),
        ) from None
    if not isinstance(document, dict) or not document:
        raise MeasurementError(expected=expected, value=type(document).__name__, at=Place(path))
    motors = {name: _motor(entry, Place(path, column=name), keys) for name, entry in document.items()}
    if len({motor.id for motor in motors.values()}) < len(motors):
        raise MeasurementError(
            "two motors have the same id", at=Place(path), remedy="calibrate the motors again"
        )
    return motors


def _motor(entry: Any, at: Place, keys: list[str]) -> Motor:
    """Check an entry of the file, and return its motor."""
    if not isinstance(entry, dict) or sorted(entry) != sorted(keys):
        raise MeasurementError(
            expected=f"a motor with {', '.join(keys)}",
            value=Phrase(", ".join(entry) if isinstance(entry, dict) else type(entry).__name__),
            at=at,
            remedy="calibrate again with LeRobot 0.2 or later",
        )
    for key, value in entry.items():
        if type(value) is not int:
            raise MeasurementError(expected=f"an integer as {key}", value=repr(value), at=at)
    motor = Motor(**entry)
    if motor.drive_mode not in (0, 1) or motor.range_min >= motor.range_max:
        raise MeasurementError(
            expected="a drive_mode of 0 or 1, and range_min < range_max",
            value=Phrase(f"{motor.drive_mode}, {motor.range_min} and {motor.range_max}"),
            at=at,
        )
    return motor


def motors_text(motors: Mapping[str, Motor]) -> str:
    """Write motors as LeRobot's calibration file."""
    return json.dumps({name: asdict(motor) for name, motor in motors.items()}, indent=4)


def check_values(
    values: Float[np.ndarray, "frames joints"],
    units: LeRobotUnits,
    names: Sequence[str],
    motors: Mapping[str, Motor] | None,
    source: str | os.PathLike[str],
) -> None:
    """Check that recorded values are possible in their units and with this calibration file.

    LeRobot limits normalized values to -100 to 100, and a motor leaves its recorded range only slightly.

    Args:
        values: values as recorded.
        units: units of the values.
        names: names of the motors.
        motors: motors in the arm's calibration file; None if it is not known.
        source: file of the values, for messages.

    Raises:
        MeasurementError: a value is impossible.
    """
    for name, column in zip(names, values.T, strict=True):
        limit, remedy = _NORMALIZED / 2, "state units=degrees if they are degrees"
        if units == "degrees":
            if motors is None or name not in motors or DAMIAO.fullmatch(name):
                continue
            limit = (motors[name].range_max - motors[name].range_min) / 2 * 360 / (TICKS - 1) + _BEYOND_RANGE
            remedy = "give the calibration file with which the values were recorded"
        largest = float(np.abs(column).max(initial=0.0))
        if largest > limit:
            raise MeasurementError(
                expected=f"{units} values of '{name}' between -{limit:.4g} and {limit:.4g}",
                value=float(f"{largest:.6g}"),
                at=Place(source, column=name),
                remedy=remedy,
            )


def radians_per_unit(units: LeRobotUnits, name: str, motors: Mapping[str, Motor] | None) -> float:
    """Return the rotation [rad] of a joint per unit of its recorded value.

    LeRobot converts ticks to degrees with 360 / 4095 although a turn has 4096 ticks, so its degrees are 0.02 % too
    large, except those of OpenArm (`DAMIAO`); values of -100 to 100 span the range of the motor (`_normalize` in its
    `motors_bus.py`, 0.3 to 0.6).

    Args:
        units: units of the values.
        name: name of the motor.
        motors: motors in the arm's calibration file; needed for normalized values.

    Raises:
        MeasurementError: the scale or the direction of normalized values is not known.
    """
    check_choice(MeasurementError, "units", units, get_args(LeRobotUnits))
    if units == "degrees":
        return math.radians(1) * (1.0 if DAMIAO.fullmatch(name) else (TICKS - 1) / TICKS)
    if motors is None or name not in motors:
        raise MeasurementError(
            f"the scale of the normalized values of '{name}' is its range in ticks, which is not known",
            value=name,
            option="calibration",
            remedy="give the calibration file with which the values were recorded",
        )
    motor = motors[name]
    if motor.drive_mode:
        raise MeasurementError(
            f"the direction of the normalized values of '{name}' depends on the bus: LeRobot reverses "
            "joints with drive_mode 1 on Feetech motors, but not on Dynamixel motors",
            value=name,
            option="calibration",
            remedy="record degrees, or set drive_mode to 0 and reverse the joint of the robot",
        )
    return (motor.range_max - motor.range_min) / _NORMALIZED * 2 * math.pi / TICKS
