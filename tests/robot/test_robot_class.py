"""Robot classes and their prior error sizes."""

import pytest

from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.robot import Robot
from pisigma.robot.robot_class import COBOT, HOBBY, INDUSTRIAL, SERVO, UNIVERSAL_ROBOTS, RobotClass


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("ur10", UNIVERSAL_ROBOTS),
        ("fanuc_r2000", INDUSTRIAL),
        ("rb5", COBOT),
        ("openarm_left", HOBBY),
        ("so101", SERVO),
    ],
)
def test_the_maker_determines_the_class(name: str, expected: RobotClass) -> None:
    assert RobotClass.from_robot(Robot.load(name)) is expected


@pytest.mark.parametrize("usual", [INDUSTRIAL, UNIVERSAL_ROBOTS])
def test_every_band_of_the_series_has_a_prior(usual: RobotClass) -> None:
    assert len(usual.series_sigmas) == len(FourierSeries(Robot.load("ur5"), usual.harmonics).group_names)
