"""Classes of robots: typical and largest sizes of geometric errors, and changes due to wear or a collision."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

from pisigma.robot.description import Robot

ClassName = Literal["industrial", "cobot", "hobby", "servo"]

_COBOT_MAKERS: Final = (
    "Franka",
    "Rainbow Robotics",
    "UFACTORY",
    "Kinova",
    "Doosan",
    "Techman",
    "Neuromeka",
)
_HOBBY_MAKERS: Final = ("Enactic", "Niryo", "AR4", "Dobot")
_SERVO_MAKERS: Final = ("TheRobotStudio", "Alexander Koch", "Trossen", "ROBOTIS", "Elephant Robotics")
_PLAUSIBLE_SHARE: Final = 0.01
"""Errors, as a share of the reach, that are plausible for a calibrated robot of any class."""


@dataclass(frozen=True)
class GeometricErrorSizes:
    """Sizes of errors by kind of geometric parameter.

    The order is that of `pisigma.calibration.geometric.problem.prior_scales.PriorGroup`.

    Attributes:
        joint_offset: size for theta [rad].
        length: size for d and a with a nonzero nominal value [m].
        zero_length: size for d and a with a nominal value of 0 [m].
        axis_angle: size for alpha and beta [rad].
    """

    joint_offset: float
    length: float
    zero_length: float
    axis_angle: float

    def size_of(self, group: int) -> float:
        """Return the size of the errors of a group of parameters [m or rad]."""
        return (self.joint_offset, self.length, self.zero_length, self.axis_angle)[group]


@dataclass(frozen=True)
class ChangeLimits:
    """Largest changes of parameters due to wear or a collision in an arm that still works.

    A belt that jumps a tooth or a brake that slips moves the zero of a joint by some degrees; a casting that is bent
    by more than these lengths and angles is visibly broken. The base, the tool or the zero of a single joint may change
    by any amount, because people move or reset them.

    Attributes:
        joint_zero: largest change of the zeros of several joints at once [rad].
        length: largest change of d, a and the zero of a prismatic joint [m].
        angle: largest change of alpha and beta [rad].
    """

    joint_zero: float
    length: float
    angle: float


@dataclass(frozen=True)
class RobotClass:
    """Prior standard deviations and limits of the errors of a class of robots.

    Attributes:
        name: name of the class, a value of the setting `robot_class`.
        prior_sizes: prior standard deviations of geometric errors.
        gravity_sigma: prior standard deviation of the weights of `GravityTorques` [rad].
        series_sigmas: prior standard deviations of the weights of `FourierSeries` [rad], by band of `BAND_STARTS`.
        harmonics: number of harmonics of the series.
        max_error_sigmas: standard deviations of geometric errors that no robot of the class exceeds.
        max_changes: largest changes due to wear or a collision.
        max_calibrated_error_per_reach: largest error after a calibration of a robot of the class, as a share of its
            reach.
        joint_repeatability: standard deviation of the values of a revolute joint from image to image [rad]; 0 if the
            pose repeatability stated for images includes it.
    """

    name: ClassName
    prior_sizes: GeometricErrorSizes
    gravity_sigma: float
    series_sigmas: tuple[float, ...]
    harmonics: int
    max_error_sigmas: GeometricErrorSizes
    max_changes: ChangeLimits
    max_calibrated_error_per_reach: float
    joint_repeatability: float = 0.0

    @staticmethod
    def from_robot(robot: Robot) -> "RobotClass":
        """Return the class of a robot by its manufacturer; `INDUSTRIAL` if the manufacturer is unknown."""
        if robot.maker.startswith("Universal Robots"):
            return UNIVERSAL_ROBOTS
        if robot.maker.startswith(_COBOT_MAKERS):
            return COBOT
        if robot.maker.startswith(_SERVO_MAKERS):
            return SERVO
        return HOBBY if robot.maker.startswith(_HOBBY_MAKERS) else INDUSTRIAL

    def allows(self, sizes: Sequence[tuple[int, float]]) -> bool:
        """Return whether errors of these sizes [m or rad], by group of parameters, are possible in this class."""
        return all(size <= self.max_error_sigmas.size_of(group) for group, size in sizes)


INDUSTRIAL: Final = RobotClass(
    name="industrial",
    prior_sizes=GeometricErrorSizes(
        joint_offset=1.5e-3, length=0.55e-3, zero_length=0.37e-3, axis_angle=0.7e-3
    ),
    gravity_sigma=2.7e-4,
    series_sigmas=(2.4e-4, 2.4e-4, 4e-6, 4e-6, 1.5e-4, 2e-6, 2e-6),
    harmonics=15,
    max_error_sigmas=GeometricErrorSizes(
        joint_offset=10e-3, length=10e-3, zero_length=10e-3, axis_angle=10e-3
    ),
    max_changes=ChangeLimits(joint_zero=0.1, length=0.005, angle=0.01),
    max_calibrated_error_per_reach=2.5e-3,
)
"""Arms whose joints have one eccentricity, one ovality and one gear ripple each.

The sizes are 1.5 times the medians of the sizes that maximise the evidence of hybrid calibrations of simulated kr10,
irb120, arm7 and scara arms (two each, 400 positions) and of the measured FANUC R-2000iC (720 positions). The factor
makes predicted errors correct for few poses, from which a calibration must also estimate the sizes: for 15 such arms,
the median ratio of predicted to true RMS is 1.05 after 15 planned poses, 1.1 after 30 and 1.1 after 60; without the
factor it is 0.74, 0.93 and 1.1. The largest sizes are twice those of the worst healthy arm that was measured."""

COBOT: Final = replace(
    INDUSTRIAL,
    name="cobot",
    max_error_sigmas=replace(INDUSTRIAL.max_error_sigmas, joint_offset=20e-3),
    max_changes=ChangeLimits(joint_zero=0.1, length=0.008, angle=0.02),
)
"""Light arms with harmonic drives, whose zeros are set by hand after a repair and slip in a collision. Gear errors are
those of industrial arms unless arms of the manufacturer were measured."""

UNIVERSAL_ROBOTS: Final = replace(
    COBOT,
    prior_sizes=GeometricErrorSizes(
        joint_offset=0.9e-3, length=0.45e-3, zero_length=0.1e-3, axis_angle=1.5e-3
    ),
    gravity_sigma=4e-4,
    series_sigmas=(2e-4, 2e-4, 6e-5, 3e-5, 5e-5, 5e-5, 5e-5, 4e-5, 3e-5),
    harmonics=31,
)
"""Arms of Universal Robots, with sizes between the two that maximise the evidence of hybrid calibrations of the
measured UR5 (1,000 positions) and UR10 (1,941 poses). The gear errors have many harmonics, which the pose sets of other
robots cannot distinguish."""

HOBBY: Final = replace(
    COBOT,
    name="hobby",
    prior_sizes=GeometricErrorSizes(joint_offset=30e-3, length=1e-3, zero_length=1e-3, axis_angle=5e-3),
    max_error_sigmas=GeometricErrorSizes(
        joint_offset=100e-3, length=20e-3, zero_length=20e-3, axis_angle=20e-3
    ),
    max_changes=ChangeLimits(joint_zero=0.3, length=0.02, angle=0.1),
    max_calibrated_error_per_reach=7.5e-3,
)
"""Arms without a reliable zero: arms built by hobbyists or in a laboratory, surgical arms with potentiometers, and old
arms that were reassembled. Their zeros are wrong by 20 to 50 mrad."""

SERVO: Final = replace(
    HOBBY,
    name="servo",
    prior_sizes=replace(HOBBY.prior_sizes, joint_offset=0.1),
    max_error_sigmas=replace(HOBBY.max_error_sigmas, joint_offset=0.3),
    max_calibrated_error_per_reach=0.04,
    joint_repeatability=math.radians(0.5),
)
"""Arms built from servos, whose zeros are set by eye in the middle of the range and are wrong by up to 17 deg
(huggingface/lerobot, issue 3758). Servos repeat to 0.3 to 2 deg, of which 2 deg move the tool of an SO-101 by 4 % of
its reach."""

CLASSES: Final[dict[str, RobotClass]] = {one.name: one for one in (INDUSTRIAL, COBOT, HOBBY, SERVO)}
"""Classes of robots by name, in the order of increasing errors."""


def plausible_error_per_reach(robot: Robot) -> float:
    """Return the largest errors of a calibrated robot, and after correction of a fault, as a share of the reach.

    They are larger for arms whose joints scatter by more, such as arms of servos.
    """
    return max(_PLAUSIBLE_SHARE, RobotClass.from_robot(robot).max_calibrated_error_per_reach)
