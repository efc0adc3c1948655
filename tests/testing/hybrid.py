"""Hybrid calibrations of simulated arms, for tests."""

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from testing.models import no_type_checker
from testing.stored import stored

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.hybrid import calibrator
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.gravity import USUAL
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.measurement import splits
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.se3 import invert, transform_from_xyz_zyx
from pisigma.simulation import TrueRobot
from pisigma.simulation.errors.geometric import RandomGeometricDeviation
from pisigma.simulation.errors.joint_compliance import JointCompliance, LinkMass
from pisigma.simulation.errors.transmission import Harmonic, TransmissionHarmonics
from pisigma.validation.checks import other_robot
from pisigma.validation.setup_faults import populations

NOISE = 3e-5
"""Standard deviation of a measured coordinate [m]."""


@contextmanager
def few_choices() -> Iterator[None]:
    """Try few features and cross-validate once where neither harmonics nor repeats are stated, for other tests.

    Gravity acts down, as on all their robots, and the search for two populations of rows has few starts.
    """
    whole, default = HybridCalibrator.__init__, HybridCalibrator.features
    few = {"features": ("gravity", "series"), "harmonics": (4, 8), "products": False}

    def with_few(self, robot, **options):
        if "harmonics" not in options:
            options = few | {name: value for name, value in options.items() if value != default}
        whole(self, robot, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(HybridCalibrator, "__init__", with_few)
        patch.setattr(splits, "_MAX_REPEATS", 1)
        patch.setattr(calibrator, "gravity_by_evidence", lambda *arguments: USUAL)
        patch.setattr(populations, "_STARTS", 3)
        yield


@contextmanager
def few_robots() -> Iterator[None]:
    """Compare rows with large errors with six robots of the catalogue, as each takes a tenth of a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            other_robot, "catalogue", lambda: ("fanuc_r2000", "kiro4", "rb5", "ur10", "ur5", "ur5e")
        )
        yield


@dataclass(frozen=True, eq=False)
class HybridArmUnderTest:
    """A simulated robot, its measurements, and its hybrid calibration."""

    true: TrueRobot
    measurements: Measurements
    result: HybridResult


def true_robot(robot: Robot, payload: float = 3.0) -> TrueRobot:
    """Return a robot with errors of geometry and gears, and with compliance of its second and third joint.

    Args:
        robot: the nominal robot.
        payload: mass at the tool [kg].
    """
    names = [joint.name for joint in robot.joints]
    turning = [joint.name for joint in robot.joints if joint.type == "revolute"]
    sines = [
        Harmonic(joint=name, amplitude_deg=0.03, harmonic=1 + i % 4, phase_deg=40.0 * i)
        for i, name in enumerate(turning)
    ]
    sums = [
        Harmonic(joint=name, amplitude_deg=0.03, joints={turning[1]: 1, name: 1}, phase_deg=25.0)
        for name in turning
        if name != turning[1]
    ]
    compliance = JointCompliance(
        kind="joint_compliance",
        compliance_rad_per_Nm={name: 2e-6 for name in names[1:3] if name in turning},
        links={names[2]: LinkMass(mass_kg=8, centre_mm=(-100, 0, 50))},
        payload=LinkMass(mass_kg=payload),
    )
    geometry = RandomGeometricDeviation(
        kind="geometric_random", distribution="normal", seed=3, length_mm=0.3, angle_deg=0.03
    )
    return TrueRobot(
        robot, (geometry, TransmissionHarmonics(kind="transmission", terms=(*sines, *sums)), compliance)
    )


def joints_in(robot: Robot, rows: int, seed: int, share: float = 1.0) -> torch.Tensor:
    """Draw joint values [rad or m], uniform over a central fraction of the limits, at most one turn."""
    limits = np.clip(robot.limits, -np.pi, np.pi)
    middle, half = limits.mean(1), np.diff(limits)[:, 0] / 2 * share
    return torch.from_numpy(
        np.random.default_rng(seed).uniform(middle - half, middle + half, (rows, robot.dof))
    )


def hybrid_of(
    name: str,
    rows: int = 200,
    share: float = 1.0,
    products: bool = False,
    frames: bool = False,
    features: tuple[str, ...] = ("gravity", "series"),
    payloads: tuple[float, ...] = (),
) -> HybridArmUnderTest:
    """Calibrate a simulated robot from measured positions.

    Args:
        name: catalogue name.
        rows: number of measured positions.
        share: fraction of the joint ranges that is measured.
        products: whether to try product units.
        frames: measure in two frames and with two targets, else in one.
        features: features to try.
        payloads: masses [kg] that the rows carry in turn, as they state; the usual one and not stated where none.
    """
    true, measurements = _measured(name, rows, share, frames, payloads)
    return HybridArmUnderTest(
        true, measurements, _calibrated(name, rows, share, products, frames, features, payloads)
    )


@stored
def _calibrated(
    name: str,
    rows: int,
    share: float,
    products: bool,
    frames: bool,
    features: tuple[str, ...],
    payloads: tuple[float, ...],
) -> HybridResult:
    true, measurements = _measured(name, rows, share, frames, payloads)
    with no_type_checker():
        chosen = HybridCalibrator(
            GeometricCalibrator(true.nominal), features=features, harmonics=(4, 8), products=products
        )
        return chosen.fit(measurements)


@functools.cache
def _measured(
    name: str, rows: int, share: float, frames: bool, payloads: tuple[float, ...]
) -> tuple[TrueRobot, Measurements]:
    true = true_robot(Robot.load(name))
    q = joints_in(true.nominal, rows, seed=0, share=share)
    T, names = true.forward(q), {}
    if payloads:
        every = torch.stack([true_robot(true.nominal, payload).forward(q) for payload in payloads])
        number = torch.arange(rows) % len(payloads)
        T, names = every[number, torch.arange(rows)], {"payload": torch.tensor(payloads).double()[number]}
    if frames:
        T_frame = transform_from_xyz_zyx(torch.tensor([[0.0] * 6, [0.5, -0.3, 0.2, 0.4, -0.2, 1.0]]).double())
        T_target = transform_from_xyz_zyx(
            torch.tensor([[0.0] * 6, [0.05, 0.1, -0.04, 0.0, 0.0, 0.0]]).double()
        )
        number = torch.arange(rows)
        T = invert(T_frame)[number % 2] @ T @ T_target[number // 2 % 2]
        names |= {
            "frame": tuple(("wall", "floor")[k] for k in (number % 2).tolist()),
            "target": tuple(("A", "B")[k] for k in (number // 2 % 2).tolist()),
        }
    rng = np.random.default_rng(1)
    position = T[:, :3, 3] + NOISE * torch.from_numpy(rng.normal(size=(rows, 3)))
    return true, Measurements(q=q, position=position, **names)
