"""Errors after few poses, with and without the prior of a fleet, also for robots that differ from the fleet.

Run `OMP_NUM_THREADS=1 python benchmarks/fleet_prior.py [--fleets 7] [--robots 50] [--odd 5] [--judged 10]`. Robots have
common errors of 1 mm and 1 mrad, and individual errors; the prior is estimated from 60 poses of each robot. All figures
are root mean squares of position errors at 400 other poses without noise [mm].
"""

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from testing.fleet_robots import GEARS, NOISE, NOMINAL, common_errors, common_gears, rows_of

from pisigma.calibration.hybrid.noise import CalibrationNoise
from pisigma.estimation.population import Population
from pisigma.lifetime.fleet.prior import FleetPrior, fleet_prior, mean_robot
from pisigma.lifetime.recalibration.adaptation import Adaptation, adapt
from pisigma.lifetime.recalibration.recalibration_problem import frame_keys, recalibration_problem
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.model_posterior import ModelPosterior
from pisigma.planning.robot_posterior import RobotPosterior
from pisigma.workflow.calibrate import calibrate
from pisigma.workflow.recalibrate import recalibrate
from pisigma.workflow.settings.calibration import CalibrationSettings

FLEETS = ((2e-4, 1.0), (1e-4, 1.0), (5e-5, 1.0), (2e-5, 1.0), (2e-5, 0.1), (2e-5, 0.01), (1e-5, 0.0))
"""Individual errors [m or rad], and the individual share of the variance of harmonics; the first is the typical one."""
NOTHING = 1e-8
"""Error [m or rad] used instead of 0, so that covariances have Cholesky factors."""


def rms(predicts: Any, test: Measurements) -> float:
    """Return the RMS error of a result with `errors_of` [mm]."""
    return float(predicts.errors_of(test)["position"].square().sum(1).mean().sqrt()) * 1e3


def true_prior(individual: float, gears: float) -> CalibratedModel:
    """Return the distribution from which the robots are drawn, as a prior."""
    posterior = RobotPosterior.from_robot(NOMINAL)
    size = posterior.uncertainty.space.arm_parameter_count
    means, deviations = [common_errors().flatten()], [torch.full((size,), individual, dtype=torch.float64)]
    for feature in posterior.uncertainty.features:
        mean, deviation = torch.zeros(2, *feature.used.shape, dtype=torch.float64)
        if feature.name == "series":
            count, half = len(GEARS), feature.used.shape[1] // 2  # first sines, then cosines
            columns = [*range(count), *range(half, half + count)]
            mean[:, columns] = (1 - gears) ** 0.5 * common_gears()
            deviation[:, columns] = gears**0.5 * torch.tensor(GEARS * 2, dtype=torch.float64)
        means.append(mean[feature.used])
        deviations.append(deviation[feature.used])
    variance = torch.cat(deviations).square() + NOTHING**2
    population = Population(torch.cat(means), variance.diag(), size)
    return mean_robot(
        "true", posterior, population, [rows_of(0, 60, 0)], CalibrationNoise({"position": NOISE})
    )


def begun_with(prior: CalibratedModel, rows: Measurements) -> Adaptation:
    """Return the posterior of a robot."""
    posterior = ModelPosterior.from_model(prior)
    rows = posterior.with_model_names(rows)
    problem = recalibration_problem(prior, posterior, rows, frame_keys(rows, ("base", "tool")))
    return adapt(problem)


def alone(rows: Measurements) -> Any:
    """Return the calibration of a robot without a prior."""
    return calibrate(NOMINAL, rows, CalibrationSettings(folds=0)).result


def fleet_table(fleets: int, robots: int, odd: int, judged: int) -> FleetPrior:
    """Print one line per fleet, with estimated priors and the true distribution; return the typical fleet's prior."""
    print("errors  gears | 10 poses: true  estimated  without | 30 poses: true  estimated  without")
    priors = []
    for individual, gears in FLEETS[:fleets]:
        drawn = partial(rows_of, individual=individual, individual_gears=gears)
        prior = fleet_prior("fleet", NOMINAL, [drawn(k, 60, k, odd=k >= robots - odd) for k in range(robots)])
        exact, figures = true_prior(individual, gears), []
        for number in range(500, 500 + judged):
            test = drawn(number, 400, 9000 + number, noise=0.0)
            both = [drawn(number, count, 7000 + number) for count in (10, 30)]
            models = [[begun_with(exact, rows), begun_with(prior.model, rows), alone(rows)] for rows in both]
            figures.append([rms(model, test) for of_count in models for model in of_count])
        few, more = np.array(figures).mean(0).reshape(2, 3)
        lines = (f"{one[0]:15.3f}{one[1]:11.3f}{one[2]:9.3f}" for one in (few, more))
        print(f"{individual * 1e3:6.2f} {gears:6.2f} |" + " |".join(lines), flush=True)
        priors.append(prior)
    return priors[0]


def gated(prior: FleetPrior, number: int, odd: bool) -> list[float]:
    """Return the model kept by `calibrate --prior`, and the calibration without a prior, for 10 and 30 poses."""
    test, figures = rows_of(number, 400, 9000 + number, odd, noise=0.0), []
    for count in (10, 30):
        rows = rows_of(number, count, 7000 + number, odd)
        without, begun = alone(rows), recalibrate(prior.model, rows)
        kept = {
            "scratch": lambda result=without: result,
            "recalibrated": lambda result=begun: result.adaptation,
            "old": lambda result=begun: adapt(
                result.adaptation.problem.with_fixed_arm(), result.adaptation.noise
            ),
        }
        figures += [rms(kept[begun.candidate_choice.kept](), test), rms(without, test)]
    return figures


def main() -> None:
    """Print the table of fleets, and the models kept for robots of the typical fleet and for different robots."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fleets", type=int, default=len(FLEETS), help="Number of lines of the table.")
    parser.add_argument("--robots", type=int, default=50)
    parser.add_argument("--odd", type=int, default=5)
    parser.add_argument("--judged", type=int, default=10)
    wanted = parser.parse_args()
    torch.set_num_threads(1)
    prior = fleet_table(wanted.fleets, wanted.robots, wanted.odd, wanted.judged)
    print(
        f"usual fleet, odd robots {[*range(wanted.robots - wanted.odd, wanted.robots)]}: "
        f"named {[*prior.inconsistent_robots]}"
    )
    for odd, count in ((False, wanted.judged), (True, wanted.odd)):
        figures = np.array([gated(prior, 500 + k, odd) for k in range(count)])
        means, (few, more) = figures.mean(0), (figures[:, 0::2] / figures[:, 1::2]).max(0)
        print(
            f"{count} {'odd ' if odd else ''}robots: 10 poses {means[0]:.3f} (without the prior {means[1]:.3f}), "
            f"30 poses {means[2]:.3f} ({means[3]:.3f}); with over without at most {few:.2f} and {more:.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
