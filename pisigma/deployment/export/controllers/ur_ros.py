"""Kinematics YAML of Universal Robots' ROS driver: one transform per link, and the hash of the calibration."""

import numpy as np
from pydantic import Field

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
from pisigma.files.errors import RobotError
from pisigma.files.yaml_file import Section, parse_yaml
from pisigma.files.yaml_writing import yaml_text
from pisigma.robot.chains import robot_of_origins
from pisigma.robot.description import Robot
from pisigma.robot.row import BoundedFloat
from pisigma.robot.urdf_frames import Frame, frame_of, rotation, translation, xyz_zyx_of

COLUMNS = ("x", "y", "z", "yaw", "pitch", "roll")
"""Keys in the order of `frame_of`; the driver's roll is about x, that of pisigma about z."""


class LinkSection(Section):
    """A joint's frame in that of the previous joint: x, y, z [m], roll about x, pitch about y, yaw about z [rad]."""

    x: BoundedFloat = 0.0
    y: BoundedFloat = 0.0
    z: BoundedFloat = 0.0
    roll: BoundedFloat = 0.0
    pitch: BoundedFloat = 0.0
    yaw: BoundedFloat = 0.0

    def frame(self, as_urdf: bool) -> Frame:
        """Return the frame.

        Args:
            as_urdf: whether the rotation is `RotZ(yaw) · RotY(pitch) · RotX(roll)`, as in URDF, or
                `RotX(roll) · RotY(pitch) · RotZ(yaw)`, as the driver writes it.
        """
        if as_urdf:
            return frame_of([getattr(self, column) for column in COLUMNS])
        T: Frame = (
            translation(self.x, self.y, self.z)
            @ rotation(0, self.roll)
            @ rotation(1, self.pitch)
            @ rotation(2, self.yaw)
        )
        return T


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
    """The complete file."""

    kinematics: KinematicsSection


_LINKS = tuple(KinematicsSection.model_fields)[:JOINTS]


ORDER = "Rotations are RotZ(yaw) RotY(pitch) RotX(roll), as URDF reads them."
"""Sentence in the comments that identifies files written by pisigma."""


def write_kinematics(content: FileContent) -> str:
    """Return the kinematics YAML; the frame after the last joint is part of the tool in the comments."""
    origins, own = controller_geometry(content.nominal).origins(content.robot)
    links: dict[str, object] = {
        link: {column: float(value) + 0.0 for column, value in zip(COLUMNS, xyz_zyx_of(origin), strict=True)}
        for link, origin in zip(_LINKS, origins, strict=True)
    }
    links["hash"] = calibration_hash(without_beta(origins, own))
    return header_comment((*content.comments, *frame_sentences(own))) + yaml_text({"kinematics": links})


def read_kinematics(text: str, source: str, nominal: Robot) -> Robot:
    """Return the robot of a kinematics YAML, with names and limits of the nominal robot.

    The driver extracts angles in one order, and URDF reads them in the other order (ur_calibration/src/calibration.cpp,
    `eulerAngles(0, 1, 2)`), which moves the tool by about 0.1 mm. The order that yields the hash of the file is used.
    If neither does, the convention is that of URDF if pisigma wrote the file, otherwise that of the driver.

    Poses are those of the link `tool0` in the controller's frame `base` (the driver's `base_link_inertia`), or use the
    base and tool from the comments that pisigma writes.

    Raises:
        RobotError: the file is not a kinematics file of the driver, or the robot has different joints.
    """
    own = controller_geometry(nominal).robot
    links = parse_yaml(text, KinematicsDocument, RobotError, source).kinematics
    first = ORDER in " ".join(text.replace("#", " ").split())
    candidates = [[getattr(links, link).frame(order) for link in _LINKS] for order in (first, not first)]
    found = (c for c in candidates if calibration_hash(without_beta(c, own)) == links.hash)
    origins = next(found, candidates[0])
    return robot_of_origins(with_frames_from_comments(own, text), origins, np.eye(4))


def calibration_hash(robot: Robot) -> str:
    """Return the hash of DH parameters that the driver compares with the hash of the connected robot.

    It is `calib_` followed by the GNU C++ library's `std::hash` of theta, d, a and alpha of all joints as printed by
    C++ streams, with 6 digits and no separators.
    """
    text = "".join(
        f"{value + 0.0:g}" for theta, d, a, alpha, _ in robot.dh.tolist() for value in (theta, d, a, alpha)
    )
    return f"calib_{_murmur_hash(text.encode())}"


_WORD = 2**64 - 1


def _murmur_hash(data: bytes) -> int:
    """Compute MurmurHash64A (A. Appleby) with the GNU library's seed and shifts."""
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
    source=untested_sentence(
        "github.com/UniversalRobots/Universal_Robots_ROS2_Driver, ur_calibration/doc/algorithm.rst"
    ),
    requirements=(
        "The driver warns if the hash is not that of the connected robot; it is the hash of the calibration.conf that "
        "--format ur-calibration writes for the same model.",
        ORDER,
        "The file includes neither base nor tool: it leads from the controller's frame 'base' (the driver's link "
        "base_link_inertia) to the link tool0. The lines 'base' and 'tool' below state where these two are.",
    ),
    text=write_kinematics,
    read=read_kinematics,
    check=check_robot,
    controller_robot=controller_robot,
    contains="description",
    marker="kinematics:",
)
FORMAT = FILE.export_format()
