"""The xacro file, a URDF with origins as properties, is read back as the written robot."""

import pytest
from testing.closeness import assert_close
from testing.identified import off_by
from testing.models import joints_around

from pisigma.deployment.export.controllers.xacro import urdf_to_xacro
from pisigma.deployment.export.urdf import CALIBRATED_FRAME, CALIBRATED_TOOL, update_urdf
from pisigma.files.errors import RobotError
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.writing import robot_to_urdf


@pytest.fixture
def urdf(tmp_path):
    """A URDF file."""
    path = tmp_path / "arm.urdf"
    path.write_text(
        robot_to_urdf(Robot.load("ur10")).replace("</robot>", '<gazebo reference="link_1"/></robot>')
    )
    return path


def test_the_robot_is_read_back(urdf, tmp_path):
    nominal = Robot.load(urdf)
    calibrated = off_by(nominal)
    urdf = update_urdf(calibrated, nominal, urdf, comments=("said",))
    overlay = tmp_path / "arm.urdf.xacro"
    overlay.write_text(urdf_to_xacro(urdf))
    text = overlay.read_text()
    assert '<xacro:property name="theta_2_xyz" value="' in text
    assert 'xyz="${theta_2_xyz}"' in text
    assert '<gazebo reference="link_1"/>' in text
    held = Robot.load(overlay, base=CALIBRATED_FRAME, tip=CALIBRATED_TOOL)
    q = joints_around("ur10", 100, spread=3.0)
    assert_close(forward_kinematics(held, q), forward_kinematics(calibrated, q), atol=1e-12)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("${theta_2_xyz}", "${theta_2_xyz * 2}"),
        ("${theta_2_xyz}", "$(arg x)"),
        ('name="theta_2_xyz"', 'name="other"'),
    ],
)
def test_anything_else_of_xacro_is_refused(before, after, urdf, tmp_path):
    nominal = Robot.load(urdf)
    overlay = tmp_path / "arm.xacro"
    overlay.write_text(urdf_to_xacro(update_urdf(nominal, nominal, urdf)).replace(before, after))
    with pytest.raises(RobotError, match="xacro"):
        Robot.load(overlay, tip=CALIBRATED_TOOL)
