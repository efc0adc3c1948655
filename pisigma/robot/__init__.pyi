from pisigma.robot.description import Robot as Robot
from pisigma.robot.robot_file import RobotDocument as RobotDocument
from pisigma.robot.robot_file import catalogue as catalogue
from pisigma.robot.row import DH_COLUMNS as DH_COLUMNS
from pisigma.robot.row import FRAME_COLUMNS as FRAME_COLUMNS
from pisigma.robot.row import JointType as JointType
from pisigma.robot.row import Row as Row
