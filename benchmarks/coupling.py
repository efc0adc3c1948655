"""True error of calibrated arms with coupled joints or a rail, relative to the same arm without them.

Run `OMP_NUM_THREADS=1 python benchmarks/coupling.py [SEEDS]`. Every arm is simulated with random errors of its
geometry, gears (harmonics 1, 2 and 7, before the coupling), gravity, 0.03 mm noise and 0.02 mm repeatability,
calibrated with 120 positions, and evaluated at 2,000 other poses without noise. Its coupling has errors too: 0.1 % in
factors, some 0.3 mm in the bars of a parallelogram; the rail bends by 0.3 mm sideways and vertically and yaws by 0.02
deg. The figures are medians over the seeds of the root mean square of the true error of the hybrid. Single seeds
scatter widely (ratios of 1.98 and 0.82 for the first two seeds of the first arm), so a few seeds are not conclusive.
"""

import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import yaml

from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.files.errors import RobotError
from pisigma.files.yaml_file import parse_yaml
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.robot import Robot, RobotDocument
from pisigma.simulation.measure import simulate
from pisigma.simulation.noise import MeasurementNoise
from pisigma.simulation.poses import JointsRandom
from pisigma.simulation.true_robot import TrueRobot, TrueRobotSection

ROWS, JUDGED = 120, 2_000
NOISE_MM = 0.036
"""Standard deviation of a measured coordinate due to tracker and robot together [m]."""

ARM = """
- {name: theta_1, type: revolute, limits_deg: [-170, 170], d_mm: 670, a_mm: 312, alpha_deg: -90}
- {name: theta_2, type: revolute, limits_deg: [-60, 76], theta_deg: -90, a_mm: 1075}
- {name: theta_3, type: revolute, direction: -1, limits_deg: [-70, 120], a_mm: 225, alpha_deg: -90}
- {name: theta_4, type: revolute, direction: -1, limits_deg: [-180, 180], d_mm: 1280, alpha_deg: 90}
- {name: theta_5, type: revolute, direction: -1, limits_deg: [-120, 120], alpha_deg: -90}
- {name: theta_6, type: revolute, direction: -1, limits_deg: [-180, 180], d_mm: 215}
"""
PALLETISER = """
- {name: theta_1, type: revolute, limits_deg: [-165, 165], d_mm: 742, a_mm: 260, alpha_deg: -90}
- {name: theta_2, type: revolute, limits_deg: [-40, 85], theta_deg: -90, a_mm: 945}
- {name: theta_3, type: revolute, limits_deg: [-20, 120], theta_deg: 90, a_mm: 1025}
- {name: tilt, type: revolute, a_mm: 220, alpha_deg: -90}
- {name: theta_4, type: revolute, limits_deg: [-180, 180], d_mm: 225, alpha_deg: 180}
"""
SERIAL_PALLETISER = PALLETISER.replace("[-20, 120]", "[-65, 65]").replace(
    "{name: tilt, type: revolute,", "{name: tilt, type: revolute, limits_deg: [-120, 20],"
)
RAIL = """
- {name: rail, type: prismatic, limits_mm: [-1500, 1500], alpha_deg: 90}
- {name: side, type: prismatic, theta_deg: 90, alpha_deg: 90}
- {name: height, type: prismatic}
- {name: yaw, type: revolute}
"""
HORIZONTAL = """
- {joint: theta_3, factors: {theta_2: 1, theta_3: 1}}
"""
PARALLELOGRAM = """
- joint: theta_3
  factors: {theta_2: -1, theta_3: 1}
  limits_deg: [-65, 65]
  four_bar: {ground_mm: 945, crank_mm: 400, coupler_mm: 945, rocker_mm: 400, zero_deg: 90}
- {joint: tilt, factors: {theta_3: -1}}
"""
FOLLOWERS = """
- {joint: side, factors: {rail: 0}}
- {joint: height, factors: {rail: 0}}
- {joint: yaw, factors: {rail: 0}}
"""


@dataclass(frozen=True)
class Case:
    """A nominal arm, the errors of its coupling, and its gear angles as functions of the joint angles."""

    rows: str
    coupling: str = "[]"
    errors: str = "[]"
    gears: str = "{}"

    def robot(self) -> Robot:
        """Return the nominal arm."""
        values = {"name": "arm", "maker": "made up", "source": "benchmark", "tool": {"x_mm": 60, "z_mm": 150}}
        values |= {"rows": yaml.safe_load(self.rows), "coupling": yaml.safe_load(self.coupling)}
        return Robot(*parse_yaml(yaml.safe_dump(values), RobotDocument, RobotError, "arm.yaml").to_fields())

    def true(self, seed: int) -> TrueRobot:
        """Return the arm with all errors."""
        robot, draw = self.robot(), torch.Generator().manual_seed(seed)
        gears: dict[str, dict[str, int]] = yaml.safe_load(self.gears)
        terms: list[dict[str, Any]] = []
        moved = [joint for joint in robot.axes if joint.type == "revolute"]
        for joint in moved:
            for harmonic in (1, 2, 7):
                multiple = {
                    name: harmonic * by for name, by in gears.get(joint.name, {joint.name: 1}).items()
                }
                amplitude, phase = (
                    0.015 * float(torch.randn(1, generator=draw)),
                    360 * float(torch.rand(1, generator=draw)),
                )
                terms.append(
                    {"joint": joint.name, "amplitude_deg": amplitude, "joints": multiple, "phase_deg": phase}
                )
        compliance = {joint.name: 6e-7 for joint in moved}
        up = [1.0, 0.0, 0.0] if moved[0] is not robot.rows[0] else [0.0, 0.0, 1.0]
        errors = [
            {
                "kind": "geometric_random",
                "distribution": "normal",
                "seed": seed,
                "length_mm": 0.3,
                "angle_deg": 0.03,
            },
            {"kind": "transmission", "terms": terms},
            {
                "kind": "joint_compliance",
                "compliance_rad_per_Nm": compliance,
                "payload": {"mass_kg": 60},
                "gravity_m_per_s2": [-9.81 * axis for axis in up],
            },
            *yaml.safe_load(self.errors),
        ]
        section = parse_yaml(
            yaml.safe_dump({"robot": "ur5", "errors": errors}), TrueRobotSection, RobotError, "errors.yaml"
        )
        return TrueRobot(robot, section.errors)


CASES: dict[str, tuple[Case, Case]] = {
    "J2/J3 coupled": (
        Case(
            ARM,
            HORIZONTAL,
            "[{kind: coupling, coupling: [{joint: theta_3, factors: {theta_2: 1.001, theta_3: 1}}]}]",
        ),
        Case(ARM),
    ),
    "palletiser": (
        Case(
            PALLETISER,
            PARALLELOGRAM,
            "[{kind: coupling, coupling: [{joint: theta_3, factors: {theta_2: -1, theta_3: 1}, limits_deg: [-65, 65],"
            " four_bar: {ground_mm: 945.3, crank_mm: 400.2, coupler_mm: 944.8, rocker_mm: 399.7, zero_deg: 90}}]}]",
            "{theta_3: {theta_3: 1, theta_2: 1}}",
        ),
        Case(SERIAL_PALLETISER),
    ),
    "3 m rail + 6R": (
        Case(
            RAIL + ARM,
            FOLLOWERS,
            "[{kind: guide, along: rail, waves: [{joint: side, amplitude_mm: 0.3, harmonic: 1, phase_deg: 20},"
            " {joint: height, amplitude_mm: 0.3, harmonic: 2}, {joint: yaw, amplitude_deg: 0.02, harmonic: 1}]}]",
        ),
        Case(ARM),
    ),
}
"""Pairs by name: an arm, and the same arm without coupling or rail."""


def true_error(case: Case, seed: int) -> float:
    """Return the RMS of the true position error [mm] of the calibrated arm at other poses."""
    true = case.true(seed)
    train, test = (
        JointsRandom(kind="joints_random", count=count, seed=1_000 * seed + index, range_fraction=0.9).joints(
            true.nominal
        )
        for index, count in enumerate((ROWS, JUDGED))
    )
    rows = simulate(true, train, "position", MeasurementNoise(position_mm=NOISE_MM, seed=seed))
    model = model_of_hybrid("arm", true.nominal, HybridCalibrator(true.nominal).fit(rows), rows)
    missed = (model.forward(test) - true.forward(test))[:, :3, 3]
    return float(missed.norm(dim=1).square().mean().sqrt()) * 1e3


def main(seeds: Sequence[int]) -> None:
    """Print one line per arm."""
    for name, (case, without) in CASES.items():
        errors = [[true_error(one, seed) for seed in seeds] for one in (case, without)]
        with_it, alone = map(statistics.median, errors)
        print(f"{name}: {with_it:.4f} mm, without {alone:.4f} mm, ratio {with_it / alone:.2f}", flush=True)


if __name__ == "__main__":
    main(range(int(sys.argv[1]) if len(sys.argv) > 1 else 40))
