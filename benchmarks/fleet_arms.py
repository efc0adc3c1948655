"""Ten poses of a simulated arm with the prior of its fleet, compared with ten and thirty poses without it.

Run `OMP_NUM_THREADS=1 python benchmarks/fleet_arms.py [--fleets 11] [--robots 30] [--judged 10]` with the simulator of
arms (`sim.py`) in `PISIGMA_SIMULATED`. Every arm is a kr10 with common and individual errors; the prior is estimated
from 60 positions of each arm. All figures are root mean squares of position errors at 300 other poses without noise
[mm]. "exact" is the expected error after ten positions if the distribution of the arms is known, averaged over the same
number of draws of poses; no estimate that is linear in the measured values has a smaller error.
"""

import argparse
import contextlib
import math
import os
import sys
from dataclasses import dataclass
from functools import cached_property
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from fleet_prior import begun_with, rms
from torch import Tensor

from pisigma.lifetime.fleet.prior import fleet_prior
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.planning.pose_selection import select_poses
from pisigma.planning.robot_posterior import Instrument, RobotPosterior
from pisigma.robot import Robot
from pisigma.robot.se3 import rotation_from_vector
from pisigma.workflow.calibrate import calibrate
from pisigma.workflow.settings.calibration import CalibrationSettings

sys.path.insert(0, os.environ.get("PISIGMA_SIMULATED", "../shared/simulated"))
import sim  # type: ignore[import-not-found]

USUAL_NOISE = 3.6e-5
"""Standard deviation of a coordinate [m], of the tracker and the repeatability of the simulated arms."""
SHARED_SEED = 777
STEP = 1e-5
"""Step of finite differences [m or rad]."""


@dataclass(frozen=True)
class Fleet:
    """Arms of one type.

    Attributes:
        errors: size of the individual errors of the geometry and of joint offsets, as a share of the common ones.
        gears: individual share of the amplitudes of harmonics; the remaining share has the same amplitude and phase in
            all arms.
        noise: noise of a coordinate [m].
        kind: measured quantity, "position" or "pose".
    """

    errors: float
    gears: float
    noise: float = USUAL_NOISE
    kind: Any = "position"

    @cached_property
    def nominal(self) -> Robot:
        """Return the nominal robot."""
        with TemporaryDirectory() as folder:
            with contextlib.chdir(folder):
                sim.write_urdf("kr10")
            return Robot.load(f"{folder}/kr10.urdf")

    @property
    def instrument(self) -> Instrument:
        """Return the sensor."""
        usual = Instrument()
        return Instrument(self.kind, self.noise, usual.sigma_rotation * self.noise / usual.sigma)

    def arm(self, number: int) -> Any:
        """Return one of the true arms."""
        arm, individual = sim.True_("kr10", SHARED_SEED), sim.True_("kr10", number)
        for name in ("do", "dr", "off"):
            setattr(arm, name, getattr(arm, name) + self.errors * getattr(individual, name))
        common, other = (one.amp * np.exp(1j * one.ph) for one in (arm, individual))
        weights = np.sqrt(1 - self.gears**2) * common + self.gears * other
        arm.amp, arm.ph = np.abs(weights), np.angle(weights)
        return arm

    def rows(self, arm: Any, q: np.ndarray, seed: int, exact: bool = False) -> Measurements:
        """Return the measurements at joint values [rad]."""
        rng = np.random.default_rng(seed)
        position, rotation = arm.measure(q, noise=0.0 if exact else self.noise, rng=rng, rep=0.0)
        turned = None
        if self.kind == "pose":
            noise = torch.from_numpy(rng.normal(0, self.instrument.sigma_rotation, position.shape))
            turned = rotation_from_vector(noise) @ torch.from_numpy(rotation)
        return Measurements(torch.from_numpy(q), torch.from_numpy(position), turned)

    def alone(self, rows: Measurements) -> Any:
        """Return the calibration of an arm without a prior."""
        return calibrate(self.nominal, rows, CalibrationSettings(folds=0)).result

    def planned(self, prior: CalibratedModel, count: int) -> np.ndarray:
        """Return poses [rad] chosen for the remaining uncertainty of the prior."""
        arm = self.arm(0)
        q, task = (torch.from_numpy(arm.sample(many, 4242 + many)) for many in (1000, 200))
        base = np.array([*arm.base[1], *np.deg2rad([130.0, 2.0, 1.0])])
        tool = np.array([*arm.tool, 0.0, 0.0, 0.0])
        posterior = RobotPosterior.from_model(prior, self.instrument).with_unknown_base_and_tool(base, tool)
        chosen: Tensor = q[select_poses(posterior.sensitivities(q), posterior.tool_derivatives(task), count)]
        return chosen.numpy()

    def exact(self, judged: int) -> float:
        """Return the expected error after 10 poses if the distribution of the individual errors is known [mm]."""
        test = self._derivative(sim.True_("kr10", SHARED_SEED).sample(300, 9000))
        draws = []
        for number in range(500, 500 + judged):
            seen = self._derivative(self.arm(number).sample(10, 7000 + number)).reshape(30, -1) / self.noise
            covariance = np.linalg.inv(seen.T @ seen + np.eye(seen.shape[1]))
            draws.append(np.sqrt(np.einsum("tci,ij,tcj->t", test, covariance, test).mean()) * 1e3)
        return float(np.mean(draws))

    def _derivative(self, q: np.ndarray) -> np.ndarray:
        """Return the derivative of positions [m] by all individual errors, in units of their standard deviations."""
        arm = sim.True_("kr10", SHARED_SEED)
        harmonic = self.gears * np.deg2rad(0.015) / np.sqrt(2)  # amplitudes of cosine and sine
        sizes = np.concatenate(
            [
                np.full(arm.do.size, self.errors * 0.3e-3),
                np.full(arm.dr.size, self.errors * 0.4e-3),
                np.full(arm.off.size, self.errors * np.deg2rad(0.05)),
                np.full(2 * arm.amp.size, harmonic),
                np.full(9, 0.1),  # base and tool are unknown
            ]
        )
        steps = np.diag(np.minimum(sizes, STEP))
        ends = (np.stack([self._positions(q, sign * step) for step in steps], -1) for sign in (1, -1))
        return np.subtract(*ends) / (2 * np.diag(steps)) * sizes

    @staticmethod
    def _positions(q: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Return positions [m] of the common arm with changes of frames, joint offsets, harmonics, base and tool."""
        arm = sim.True_("kr10", SHARED_SEED)
        stretches = np.cumsum([arm.do.size, arm.dr.size, arm.off.size, arm.amp.size, arm.amp.size, 3, 3])
        shift, turn, offset, cosine, sine, base_turn, base_shift, tool = np.split(change, stretches)
        arm.do, arm.dr = arm.do + shift.reshape(arm.do.shape), arm.dr + turn.reshape(arm.dr.shape)
        weights = arm.amp * np.exp(1j * arm.ph) + (cosine + 1j * sine).reshape(arm.amp.shape)
        arm.off, arm.amp, arm.ph = arm.off + offset, np.abs(weights), np.angle(weights)
        turned = rotation_from_vector(torch.from_numpy(base_turn)).numpy() @ arm.base[0]
        arm.base, arm.tool = (turned, arm.base[1] + base_shift), arm.tool + tool
        return arm.measure(q, noise=0.0, rep=0.0)[0]

    def figures(self, robots: int, judged: int) -> np.ndarray:
        """Return errors [mm] after 10 random, 10 planned and 30 poses with the prior, and 10 and 30 without it."""
        arms = [self.arm(number) for number in range(robots)]
        rows = [self.rows(arm, arm.sample(60, number), number) for number, arm in enumerate(arms)]
        prior = fleet_prior("fleet", self.nominal, rows).model
        chosen, figures = self.planned(prior, 10), []
        for number in range(500, 500 + judged):
            arm = self.arm(number)
            test = self.rows(arm, arm.sample(300, 9000 + number), 0, exact=True)
            few, more = (self.rows(arm, arm.sample(count, 7000 + number), number) for count in (10, 30))
            models = (
                begun_with(prior, few),
                begun_with(prior, self.rows(arm, chosen, number)),
                self.alone(few),
                self.alone(more),
                begun_with(prior, more),
            )
            figures.append([rms(model, test) for model in models])
        return np.array(figures).mean(0)


FLEETS = (
    *(Fleet(share, share, noise) for noise in (USUAL_NOISE, 1e-4) for share in (0.1, 0.2, 0.3, 0.5)),
    *(Fleet(share, 1.0) for share in (0.1, 0.3)),
    Fleet(0.2, 0.2, kind="pose"),
)


def main() -> None:
    """Print one line per fleet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fleets", type=int, default=len(FLEETS), help="Number of lines of the table.")
    parser.add_argument("--robots", type=int, default=30)
    parser.add_argument("--judged", type=int, default=10)
    wanted = parser.parse_args()
    torch.set_num_threads(1)
    print("noise  errors gears kind     | 10 with, exact, planned, without | 30 without, with")
    for fleet in FLEETS[: wanted.fleets]:
        exact = fleet.exact(wanted.judged) if fleet.kind == "position" else math.nan
        few, planned, alone, more, both = fleet.figures(wanted.robots, wanted.judged)
        print(
            f"{fleet.noise * 1e3:5.3f} {fleet.errors:7.2f} {fleet.gears:5.2f} {fleet.kind:8s} | {few:7.3f} "
            f"{exact:6.3f} {planned:8.3f} {alone:8.3f} | {more:10.3f} {both:5.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
