"""A simulated RB5 with all error sources, and its measurements by a tracker."""

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.se3 import transform_from_xyz_zyx
from pisigma.simulation import TrueRobot
from pisigma.simulation.errors.encoder import EncoderQuantisation
from pisigma.simulation.errors.geometric import RandomGeometricDeviation
from pisigma.simulation.errors.joint_compliance import JointCompliance, LinkMass
from pisigma.simulation.errors.transmission import Harmonic, TransmissionHarmonics
from pisigma.simulation.true_robot import ErrorSource

NOISE = 3e-5
"""Standard deviation of a measured coordinate [m]."""
TARGET = torch.tensor([0.04, -0.03, 0.12, 0.0, 0.0, 0.0], dtype=torch.float64)


def error_sources(seed: int, geometry_only: bool = False) -> tuple[ErrorSource, ...]:
    """Return errors of geometry, gears (three harmonics per joint), compliance of all joints, and encoders."""
    geometry = RandomGeometricDeviation(
        kind="geometric_random", distribution="normal", seed=seed, length_mm=0.5, angle_deg=math.degrees(5e-4)
    )
    if geometry_only:
        return (geometry,)
    rng = np.random.default_rng(1000 + seed)
    names = [f"theta_{j}" for j in range(1, 7)]
    terms = []
    for name in names:
        for k in (1, 2, int(rng.integers(3, 9))):
            amplitude = float(np.degrees(rng.uniform(0.5e-4, 2e-4))) / min(k, 2)
            phase = float(rng.uniform(0, 360))
            terms.append(Harmonic(joint=name, amplitude_deg=amplitude, harmonic=k, phase_deg=phase))
    softness = (4e-6, 6e-6, 8e-6, 2e-5, 2e-5, 3e-5)
    compliance = JointCompliance(
        kind="joint_compliance",
        compliance_rad_per_Nm={
            n: float(c * rng.uniform(0.7, 1.3)) for n, c in zip(names, softness, strict=True)
        },
        links={
            "theta_2": LinkMass(mass_kg=8, centre_mm=(-200, 0, 100)),
            "theta_3": LinkMass(mass_kg=4, centre_mm=(-190, 0, 50)),
            "theta_4": LinkMass(mass_kg=1.5),
            "theta_5": LinkMass(mass_kg=1.5),
            "theta_6": LinkMass(mass_kg=0.5),
        },
        payload=LinkMass(mass_kg=4, centre_mm=(0, 0, 80)),
    )
    encoders = EncoderQuantisation(kind="encoder", pulses_per_revolution=dict.fromkeys(names, 2**19))
    return geometry, TransmissionHarmonics(kind="transmission", terms=tuple(terms)), compliance, encoders


@dataclass(frozen=True, eq=False)
class SimulatedTracker:
    """A true robot, its noisy measurements, and new poses without noise."""

    robot: Robot
    true: TrueRobot
    train: Measurements
    test: Measurements

    def pose(self, q: Tensor) -> Tensor:
        """Return the true pose of the target."""
        return self.true.forward(q) @ transform_from_xyz_zyx(TARGET)


@functools.cache
def simulated_tracker(
    seed: int = 0, rows: int = 150, geometry_only: bool = False, noise: float = NOISE
) -> SimulatedTracker:
    """Measure positions over the joints' full ranges."""
    robot = Robot.load("rb5")
    true = TrueRobot(robot, error_sources(seed, geometry_only))
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.from_numpy(robot.limits).t()
    q = low + (high - low) * torch.rand(rows + 2000, 6, generator=generator, dtype=torch.float64)
    p = (true.forward(q) @ transform_from_xyz_zyx(TARGET))[:, :3, 3]
    off = noise * torch.randn(rows, 3, generator=generator, dtype=torch.float64)
    train = Measurements(q=q[:rows], position=p[:rows] + off)
    return SimulatedTracker(robot, true, train, Measurements(q=q[rows:], position=p[rows:].contiguous()))
