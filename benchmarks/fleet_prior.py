"""Calibrations of few poses that begin with what a fleet has in common, beside those without, and odd robots.

Run `OMP_NUM_THREADS=1 python benchmarks/fleet_prior.py [--robots 50] [--odd 5] [--judged 10]`. Robots share errors of
1 mm and 1 mrad, have 0.2 of their own, and gears whose harmonics have the same sizes; 60 poses of each make the prior.
All figures are root mean squares of position errors of 400 other poses without noise [mm].
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from testing.fleet_robots import DRAWN, rows_of

from pisigma.fleet.prior import fleet_prior
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.workflow.calibrate import CalibrationSettings, calibrate
from pisigma.workflow.recalibrate import recalibrate


def rms(predicts: object, test: Measurements) -> float:
    """Root mean square of the errors of anything with `errors_of` [mm]."""
    errors = predicts.errors_of(test)["position"]  # type: ignore[attr-defined]
    return float(errors.square().sum(1).mean().sqrt()) * 1e3


def judged(model: CalibratedModel, number: int, odd: bool) -> list[float]:
    """With and without the prior, 10 and 30 poses."""
    test, figures = rows_of(number, 400, 9000 + number, odd, noise=0.0), []
    for count in (10, 30):
        rows = rows_of(number, count, 7000 + number, odd)
        own = calibrate(DRAWN, rows, CalibrationSettings(folds=0)).result
        begun = recalibrate(model, rows)
        figures += [rms(own if begun.gate.kept == "scratch" else begun.adaptation, test), rms(own, test)]
    return figures


def main() -> None:
    """Print a line for robots like the fleet, and one for odd ones."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=50)
    parser.add_argument("--odd", type=int, default=5)
    parser.add_argument("--judged", type=int, default=10)
    wanted = parser.parse_args()
    torch.set_num_threads(1)
    alike = wanted.robots - wanted.odd
    fleet = [rows_of(k, 60, k, odd=k >= alike) for k in range(wanted.robots)]
    prior = fleet_prior("fleet", DRAWN, fleet)
    print(
        f"{wanted.robots} robots, odd {list(range(alike, wanted.robots))}: found {list(prior.odd)}",
        flush=True,
    )
    for odd, count in ((False, wanted.judged), (True, wanted.odd)):
        figures = np.array([judged(prior.model, 500 + k, odd) for k in range(count)])
        means, (few, more) = figures.mean(0), (figures[:, 0::2] / figures[:, 1::2]).max(0)
        print(
            f"{count} {'odd ' if odd else ''}robots: 10 poses {means[0]:.3f} (without the prior {means[1]:.3f}), "
            f"30 poses {means[2]:.3f} ({means[3]:.3f}); with over without at most {few:.2f} and {more:.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
