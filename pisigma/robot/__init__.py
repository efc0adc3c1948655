"""What a robot is: its description, its file and the catalogue."""

from pisigma.robot.description import Robot
from pisigma.robot.robot_file import RobotDocument, catalogue
from pisigma.robot.row import DH_COLUMNS, FRAME_COLUMNS, JointType, Row

__all__ = ["DH_COLUMNS", "FRAME_COLUMNS", "JointType", "Robot", "RobotDocument", "Row", "catalogue"]
