"""The kinematics YAML of Universal Robots' ROS driver: one transform a link, and the hash of the calibration."""

import numpy as np
from pydantic import Field

from pisigma.errors import RobotError
from pisigma.export.controllers.controller_file import (
    ControllerFile,
    FileText,
    frame_sentences,
    untried,
    with_frames,
)
from pisigma.export.controllers.universal_robots import JOINTS, check_robot, without_beta
from pisigma.export.dh_table import head
from pisigma.robot.chains import joint_origins, robot_of_origins
from pisigma.robot.description import Robot
from pisigma.robot.row import Bounded
from pisigma.robot.urdf_frames import Frame, frame_of, xyzrpy_of
from pisigma.yaml_file import Section, parse_yaml, yaml_text

COLUMNS = ("x", "y", "z", "yaw", "pitch", "roll")
"""In the order of `frame_of`: the driver's roll is about x, pisigma's about z."""


class LinkSection(Section):
    """A joint's frame in that of the joint before: x, y, z [m], then `RotZ(yaw) · RotY(pitch) · RotX(roll)` [rad]."""

    x: Bounded = 0.0
    y: Bounded = 0.0
    z: Bounded = 0.0
    roll: Bounded = 0.0
    pitch: Bounded = 0.0
    yaw: Bounded = 0.0

    def frame(self) -> Frame:
        """The frame."""
        return frame_of([getattr(self, column) for column in COLUMNS])


class KinematicsSection(Section):
    """The links of the arm in order, and the hash."""

    shoulder: LinkSection
    upper_arm: LinkSection
    forearm: LinkSection
    wrist_1: LinkSection
    wrist_2: LinkSection
    wrist_3: LinkSection
    hash: str = Field(min_length=1)


class KinematicsDocument(Section):
    """The whole file."""

    kinematics: KinematicsSection


LINKS = tuple(KinematicsSection.model_fields)[:JOINTS]


def write_kinematics(content: FileText) -> str:
    """The text of the file; what is behind the last joint goes into the tool of the comments."""
    origins, end = joint_origins(content.robot)
    tool = content.robot.with_geometry(tool=xyzrpy_of(end @ frame_of(content.robot.tool)))
    links: dict[str, object] = {
        link: {column: float(value) + 0.0 for column, value in zip(COLUMNS, xyzrpy_of(origin), strict=True)}
        for link, origin in zip(LINKS, origins, strict=True)
    }
    links["hash"] = calibration_hash(without_beta(content.robot, content.nominal))
    return head((*content.said, *frame_sentences(tool))) + yaml_text({"kinematics": links})


def read_kinematics(text: str, source: str, nominal: Robot) -> Robot:
    """The robot that the file describes, with the names and limits of the nominal one.

    Base and tool are those of the comments that pisigma writes, else the nominal robot's.

    Raises:
        RobotError: the file is no such YAML, or the robot has other joints.
    """
    check_robot(nominal)
    links = parse_yaml(text, KinematicsDocument, RobotError, source).kinematics
    origins = [getattr(links, link).frame() for link in LINKS]
    return robot_of_origins(with_frames(nominal, text), origins, np.eye(4))


def calibration_hash(robot: Robot) -> str:
    """The driver's hash of DH parameters, which it compares with those of the robot that it connects to.

    `calib_` and the GNU C++ library's `std::hash` of theta, d, a and alpha of joint after joint as C++ streams print
    them, to 6 digits and with nothing between.
    """
    text = "".join(
        f"{value:g}" for theta, d, a, alpha, _ in robot.dh.tolist() for value in (theta, d, a, alpha)
    )
    return f"calib_{_murmur_hash(text.encode())}"


_WORD = 2**64 - 1


def _murmur_hash(data: bytes) -> int:
    """MurmurHash64A (A. Appleby) with the GNU library's seed and its rounds, which differ in the shifts."""
    factor = 0xC6A4A7935BD1E995

    def mixed(value: int) -> int:
        return value ^ value >> 47

    value = 0xC70F6907 ^ len(data) * factor & _WORD
    whole = len(data) // 8 * 8
    for start in range(0, whole, 8):
        word = int.from_bytes(data[start : start + 8], "little") * factor & _WORD
        value = (value ^ mixed(word) * factor & _WORD) * factor & _WORD
    if whole < len(data):
        value = (value ^ int.from_bytes(data[whole:], "little")) * factor & _WORD
    return mixed(mixed(value) * factor & _WORD)


FILE = ControllerFile(
    name="ur-ros",
    contents="the kinematics YAML of Universal Robots' ROS driver",
    suffixes=(".yaml", ".yml"),
    source=untried(
        "github.com/UniversalRobots/Universal_Robots_ROS2_Driver, ur_calibration/doc/algorithm.rst"
    ),
    relies=(
        "The driver warns where the hash is not that of the robot it connects to: it is that of the calibration.conf "
        "which --format ur-calibration writes of the same model.",
        "The file holds neither base nor tool: it leads from the link base to the link tool0.",
    ),
    text=write_kinematics,
    read=read_kinematics,
    check=check_robot,
)
FORMAT = FILE.export_format()
