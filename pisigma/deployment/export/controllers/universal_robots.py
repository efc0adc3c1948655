"""Universal Robots' `calibration.conf`: differences of DH parameters from the nominal ones."""

import math
import re

import numpy as np

from pisigma.deployment.export.controllers.controller_file import (
    ControllerFile,
    FileText,
    frame_sentences,
    untried,
    with_frames,
)
from pisigma.deployment.export.controllers.ur_models import JOINTS, check_robot, convention, own_geometry
from pisigma.deployment.export.dh_table import head
from pisigma.files.errors import RobotError
from pisigma.files.input_file import read_text
from pisigma.robot.chains import in_few_rows, robot_of_origins
from pisigma.robot.description import Robot
from pisigma.robot.urdf_frames import Frame

KEYS = {"delta_theta": 0, "delta_a": 2, "delta_d": 1, "delta_alpha": 3}
"""By the file's key the column of `DH_COLUMNS`; radians and metres."""

TILTED = 1e-6
"""Sine of the angle between two axes below which they are taken for parallel: their common normal would be 1,000 km
away, and the rounding of a number as large moves the tool."""

_LINE = r"(?m)^[ \t]*{key}[ \t]*=[ \t]*\[([^\]\n]*)\]"


def without_beta(origins: list[Frame], own: Robot) -> Robot:
    """A robot in the maker's rows: beta is 0 in all of them, and neither a nor alpha is in the last one.

    Two lines have one common normal: where they are nearly parallel it is far away, so d of that row and the next are
    large and nearly cancel each other, as in the files of the maker. Of the two directions of a normal the one is taken
    that changes theta by less than 90 deg.

    Args:
        origins: frames of the joints, see `OwnGeometry.origins`.
        own: the nominal robot with the base and the tool that belong to them.
    """
    plain = robot_of_origins(own, origins, np.eye(4), TILTED)
    dh = plain.dh.copy()
    dh[:, 4] = 0.0  # of axes that are parallel but for `TILTED`
    turned = 0.0
    for joint, (row, theta) in enumerate(zip(dh, own.dh[:, 0].tolist(), strict=True), 1):
        row[0] = theta + math.remainder(row[0] + turned - theta, 2 * math.pi)
        turned = 0.0
        if abs(row[0] - theta) > math.pi / 2 and joint < len(dh):
            # RotZ(t + pi) Trans(-a, 0, d) RotX(-alpha) = RotZ(t) Trans(a, 0, d) RotX(alpha) RotZ(pi)
            turned = math.pi
            row[0] -= math.copysign(turned, row[0] - theta)
            row[2:4] *= -1
    return plain.with_geometry(dh=dh)


def write_calibration(content: FileText) -> str:
    """The text of `calibration.conf`; with a file of the controller its other lines stay."""
    own = own_geometry(content.nominal)
    robot = without_beta(*own.origins(content.robot))
    difference = robot.dh - own.robot.dh
    lines = {
        key: f"{key} = [{', '.join(repr(value) for value in difference[:, column].tolist())}]"
        for key, column in KEYS.items()
    }
    comments = head((*content.said, *frame_sentences(robot)))
    if content.request.like is None:
        return comments + "\n".join(["[mounting]", *lines.values()]) + "\n"
    text = read_text(content.request.like, RobotError, "calibration.conf")
    for key, line in lines.items():
        pattern = _LINE.format(key=key)
        if not re.search(pattern, text):
            raise RobotError(
                f"{content.request.like}: holds no line '{key} = [...]'; give the controller's calibration.conf."
            )
        text = re.sub(pattern, line, text, count=1)
    return comments + re.sub(r"(?m)^# (base|tool): .*\n", "", text)


def read_calibration(text: str, source: str, nominal: Robot) -> Robot:
    """The robot that a `calibration.conf` makes of the maker's nominal one, in rows without large lengths.

    Poses are those of the flange in the controller's frame `base`, or of the tool and in the base of the comments that
    pisigma writes.

    Raises:
        RobotError: a line is missing or does not hold one number a joint, or the robot cannot have such a file.
    """
    own = own_geometry(nominal).robot
    dh = own.dh.copy()
    for key, column in KEYS.items():
        dh[:, column] += _numbers(text, key, source)
    return in_few_rows(with_frames(own.with_geometry(dh=dh), text))


def _numbers(text: str, key: str, source: str) -> list[float]:
    lines = re.findall(_LINE.format(key=key), text)
    try:
        values = [float(word) for word in lines[0].split(",")] if len(lines) == 1 else []
    except ValueError:
        values = []
    if len(values) != JOINTS or not np.isfinite(values).all():
        raise RobotError(f"{source}: one line '{key} = [...]' with {JOINTS} finite numbers was wanted.")
    return values


FILE = ControllerFile(
    name="ur-calibration",
    contents="the calibration.conf of a Universal Robots controller",
    suffixes=(".conf",),
    source=untried("forum.universal-robots.com/t/18921 and /t/1638"),
    relies=(
        "The controller adds these differences to its own nominal DH parameters, which are in urcontrol.conf.",
        "The file holds neither base nor tool. The line 'base' below is where the controller's frame 'base' is in the "
        "frame of the model's poses (set its inverse as a feature), the line 'tool' where the tool is on the flange "
        "(set it as TCP).",
        "With --like the other lines of the controller's own file stay; joint checksums and raw offsets are not known.",
    ),
    text=write_calibration,
    read=read_calibration,
    check=check_robot,
    convention=convention,
    options=frozenset(("like",)),
)
FORMAT = FILE.export_format()
