"""How large errors usually are, before anything is measured, by class of robots."""

from dataclasses import dataclass
from typing import Final

from pisigma.identification.problem.prior_sizes import PriorGroup
from pisigma.robot.description import Robot


@dataclass(frozen=True)
class RobotClass:
    """Standard deviations of the errors of the robots of a class.

    Attributes:
        joint_offset: of theta [rad].
        length: of d and a that are drawn [m].
        no_length: of d and a that are drawn as 0 [m].
        between_axes: of alpha and beta [rad].
        gravity: of the weights of `GravityTorques` [rad].
        bands: of the weights of `FourierSeries` [rad], by band of `BAND_STARTS`.
        harmonics: of the series.
    """

    joint_offset: float
    length: float
    no_length: float
    between_axes: float
    gravity: float
    bands: tuple[float, ...]
    harmonics: int

    def geometric(self, group: PriorGroup) -> float:
        """Standard deviation of a geometric parameter's error [m or rad]."""
        return (self.joint_offset, self.length, self.no_length, self.between_axes)[group]

    @staticmethod
    def of(robot: Robot) -> "RobotClass":
        """The class of a robot's maker, or else `INDUSTRIAL`."""
        return UNIVERSAL_ROBOTS if robot.maker.startswith("Universal Robots") else INDUSTRIAL


INDUSTRIAL: Final = RobotClass(
    joint_offset=1.5e-3,
    length=0.55e-3,
    no_length=0.37e-3,
    between_axes=0.7e-3,
    gravity=2.7e-4,
    bands=(2.4e-4, 2.4e-4, 4e-6, 4e-6, 1.5e-4, 2e-6, 2e-6),
    harmonics=15,
)
"""Arms with one eccentricity, one ovality and one gear ripple a joint.

1.5 times the medians of the sizes that maximise the evidence of hybrid calibrations of simulated kr10, irb120, arm7 and
scara arms (two each, 400 positions) and of the measured FANUC R-2000iC (720). The factor makes predicted errors right
for few poses, from which a calibration has to estimate the sizes as well: with 15 such arms the median of predicted
over true RMS is 1.05 after 15 chosen poses, 1.1 after 30 and 1.1 after 60; without it 0.74, 0.93 and 1.1."""

UNIVERSAL_ROBOTS: Final = RobotClass(
    joint_offset=0.9e-3,
    length=0.45e-3,
    no_length=0.1e-3,
    between_axes=1.5e-3,
    gravity=4e-4,
    bands=(2e-4, 2e-4, 6e-5, 3e-5, 5e-5, 5e-5, 5e-5, 4e-5, 3e-5),
    harmonics=31,
)
"""Between the sizes that maximise the evidence of hybrid calibrations of the measured UR5 (1,000 positions) and UR10
(1,941 poses). Their gears err with many harmonics, which poses for other robots do not tell apart."""
