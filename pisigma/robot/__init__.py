"""What a robot is: its description, its file and the catalogue."""

from pisigma.robot.description import DH_COLUMNS, FRAME_COLUMNS, JointType, Robot, Row
from pisigma.robot.loading import catalogue, load_robot
from pisigma.robot.robot_file import RobotDocument, robot_to_yaml

__all__ = [
    "DH_COLUMNS",
    "FRAME_COLUMNS",
    "JointType",
    "Robot",
    "RobotDocument",
    "Row",
    "catalogue",
    "load_robot",
    "robot_to_yaml",
]
