"""Which closed form a robot has, decided from its rows."""

from pisigma.kinematics.closed_form.interface import AbstractClosedForm
from pisigma.kinematics.closed_form.scara import Scara
from pisigma.kinematics.closed_form.spherical_wrist import SphericalWristArm
from pisigma.kinematics.closed_form.three_parallel import ThreeParallelArm
from pisigma.robot.description import Robot


def closed_form_solver(robot: Robot) -> AbstractClosedForm | None:
    """The closed-form inverse of a robot, or None where this package has none for it.

    The rows decide, exactly: twists that are off by a calibrated error, or a beta that is not 0, mean None.
    Signs of twists, offsets, directions, base, tool, fixed rows before the first and behind the last joint do
    not matter, nor do twist and beta of the last row.
    """
    return Scara.of(robot) or SphericalWristArm.of(robot) or ThreeParallelArm.of(robot)
