"""Universal Robots' `calibration.conf`: differences of calibrated from nominal DH parameters."""

import re

import numpy as np

from pisigma.deployment.export.controllers.controller_file import (
    ControllerFile,
    FileContent,
    frame_sentences,
    untested_sentence,
    with_frames_from_comments,
)
from pisigma.deployment.export.controllers.ur_models import (
    JOINTS,
    check_robot,
    controller_geometry,
    controller_robot,
    without_beta,
)
from pisigma.deployment.export.dh_table import header_comment
from pisigma.files.errors import Place, RobotError
from pisigma.files.input_file import read_text
from pisigma.robot.chains import with_one_row_per_joint
from pisigma.robot.description import Robot

KEYS = {"delta_theta": 0, "delta_a": 2, "delta_d": 1, "delta_alpha": 3}
"""Column of `DH_COLUMNS` for every key of the file; radians and metres."""

_LINE = r"(?m)^[ \t]*{key}[ \t]*=[ \t]*\[([^\]\n]*)\]"


def write_calibration(content: FileContent) -> str:
    """Return `calibration.conf`, with the other lines of the controller's file if one is given."""
    own = controller_geometry(content.nominal)
    robot = without_beta(*own.origins(content.robot))
    difference = robot.dh - own.robot.dh
    lines = {
        key: f"{key} = [{', '.join(repr(value) for value in difference[:, column].tolist())}]"
        for key, column in KEYS.items()
    }
    comments = header_comment((*content.comments, *frame_sentences(robot)))
    if content.request.like is None:
        return comments + "\n".join(["[mounting]", *lines.values()]) + "\n"
    text = read_text(content.request.like, RobotError, "calibration.conf")
    for key, line in lines.items():
        pattern = _LINE.format(key=key)
        if not re.search(pattern, text):
            raise RobotError(
                expected=f"a line '{key} = [...]'",
                at=Place(content.request.like),
                option="--like",
                remedy="give the controller's calibration.conf",
            )
        text = re.sub(pattern, line, text, count=1)
    return comments + re.sub(r"(?m)^# (base|tool): .*\n", "", text)


def read_calibration(text: str, source: str, nominal: Robot) -> Robot:
    """Apply a `calibration.conf` to the manufacturer's nominal robot, in rows without large lengths.

    Poses are those of the flange in the controller's frame `base`, or use the base and tool from the comments that
    pisigma writes.

    Raises:
        RobotError: a line is missing or does not have one number per joint, or the file does not suit the robot.
    """
    own = controller_geometry(nominal).robot
    dh = own.dh.copy()
    for key, column in KEYS.items():
        dh[:, column] += _numbers(text, key, source)
    return with_one_row_per_joint(with_frames_from_comments(own.with_geometry(dh=dh), text))


def _numbers(text: str, key: str, source: str) -> list[float]:
    lines = re.findall(_LINE.format(key=key), text)
    try:
        values = [float(word) for word in lines[0].split(",")] if len(lines) == 1 else []
    except ValueError:
        values = []
    if len(values) != JOINTS or not np.isfinite(values).all():
        raise RobotError(
            expected=f"one line '{key} = [...]' with {JOINTS} finite numbers",
            value=len(lines),
            at=Place(source),
        )
    return values


FILE = ControllerFile(
    name="ur-calibration",
    contents="the calibration.conf of a Universal Robots controller",
    suffixes=(".conf",),
    source=untested_sentence("forum.universal-robots.com/t/18921 and /t/1638"),
    requirements=(
        "The controller adds these differences to its own nominal DH parameters, which are in urcontrol.conf.",
        "The file includes neither base nor tool. The line 'base' below is the pose of the controller's frame 'base' "
        "in the frame of the model's poses (set its inverse as a feature), and the line 'tool' is that of the "
        "tool on the flange (set it as TCP).",
        "With --like the other lines of the controller's file are kept; joint checksums and raw offsets are not known.",
    ),
    text=write_calibration,
    read=read_calibration,
    check=check_robot,
    controller_robot=controller_robot,
    options=frozenset(("like",)),
)
FORMAT = FILE.export_format()
