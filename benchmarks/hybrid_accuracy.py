"""Held-out accuracy of the hybrid on measured robots, for random folds, few rows, and extrapolation.

Run `OMP_NUM_THREADS=1 python benchmarks/hybrid_accuracy.py [PART ...]` with the measured files in `PISIGMA_DATA`. A
part is one of the names in `PARTS`. Every line is one fit, with the root mean square of the position error of the
held-out rows for the geometric and the hybrid calibration, their ratio, and the share of held-out coordinates within
the predicted 95 % intervals. A box is trained on the rows with all joints within their 4 % and 96 % quantiles and
evaluated on all others; a half is trained on one side of a joint's median and evaluated on the other side.
"""

import argparse
import math
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.splits import k_folds, with_fewer_training_rows
from pisigma.robot import Robot
from pisigma.validation.held_out.pose_statistics import ErrorsWithPredictedSigma, errors_with_predicted_sigma

DATA = Path(os.environ.get("PISIGMA_DATA", "../shared/data"))
FILES = {"ur5": "ur5/grid.csv", "ur10": "ur10/series_c_train.csv"}
HALVED = {"ur5": (1, 2, 3, 4, 5), "ur10": (1, 3, 5)}
FEW = (300, 100, 50, 30)


@dataclass(frozen=True)
class Case:
    """One split into rows to fit and rows to evaluate."""

    name: str
    robot: Robot
    train: Measurements
    test: Measurements


@dataclass(frozen=True)
class Judged:
    """Squared position errors of the held-out rows [m²] and their predicted values."""

    geometric: Tensor
    hybrid: Tensor
    spread: ErrorsWithPredictedSigma


def folds(name: str, robot: Robot, data: Measurements) -> Iterator[Case]:
    """Return five random folds of rows."""
    for k, (train, test) in enumerate(k_folds(data, 5, 0)):
        yield Case(f"{name} fold {k + 1}", robot, data.select(train), data.select(test))


def few(name: str, robot: Robot, data: Measurements) -> Iterator[Case]:
    """Return decreasing numbers of the training rows of the five folds, for the UR10 only."""
    for rows in FEW if name == "ur10" else ():
        for train, test in with_fewer_training_rows(data, k_folds(data, 5, 0), rows, 0):
            yield Case(f"{name} {rows} rows", robot, data.select(train), data.select(test))


def boxes(name: str, robot: Robot, data: Measurements) -> Iterator[Case]:
    """Return rows with all joints within their 4 % and 96 % quantiles, and all other rows."""
    low, high = (torch.quantile(data.q, share, 0) for share in (0.04, 0.96))
    inside = ((data.q >= low) & (data.q <= high)).all(1)
    yield Case(
        f"{name} box", robot, data.select(inside.nonzero()[:, 0]), data.select((~inside).nonzero()[:, 0])
    )


def halves(name: str, robot: Robot, data: Measurements) -> Iterator[Case]:
    """Return the rows on each side of a joint's median."""
    for joint in HALVED[name]:
        below = data.q[:, joint - 1] < data.q[:, joint - 1].median()
        for side, mask in (("below", below), ("above", ~below)):
            train, test = (data.select(rows.nonzero()[:, 0]) for rows in (mask, ~mask))
            yield Case(f"{name} joint {joint} {side}", robot, train, test)


PARTS = {"folds": folds, "few": few, "boxes": boxes, "halves": halves}


def judged(case: Case) -> Judged:
    """Fit and evaluate one split."""
    began = time.perf_counter()
    result = HybridCalibrator(case.robot).fit(case.train)
    seconds = time.perf_counter() - began
    geometric, hybrid = (
        model.errors_of(case.test)["position"].square().sum(1) for model in (result.geometric, result)
    )
    one = Judged(geometric, hybrid, errors_with_predicted_sigma(result, case.test))
    print_line(
        case.name,
        one,
        f"{seconds:5.1f} s  {[trial.name for trial in result.trials if trial.is_best_so_far][-1]}",
    )
    return one


def print_line(name: str, one: Judged, more: str) -> None:
    """Print one line of the table."""
    before, after = (float(square.mean().sqrt()) * 1e3 for square in (one.geometric, one.hybrid))
    print(
        f"{name:20s} {before:7.4f} {after:7.4f} {after / before:6.3f} {one.spread.coverage:6.1%}  {more}",
        flush=True,
    )


def main() -> None:
    """Print one line per fit, and one per group of splits."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", default=list(PARTS), metavar="PART")
    parser.add_argument("--robot", choices=FILES, action="append")
    arguments = parser.parse_args()
    print(f"{'case':20s} {'geom.':>7s} {'hybrid':>7s} {'ratio':>6s} {'95 %':>6s}")
    for part in arguments.parts:
        ratios, spreads = [], []
        for name in arguments.robot or FILES:
            robot = Robot.load(name)
            data = Measurements.read_csv(DATA / FILES[name], robot)
            groups: dict[str, list[Judged]] = {}
            for case in PARTS[part](name, robot, data):
                groups.setdefault(case.name.rsplit(" fold")[0], []).append(judged(case))
            for group, cases in groups.items():
                together = Judged(
                    torch.cat([one.geometric for one in cases]),
                    torch.cat([one.hybrid for one in cases]),
                    ErrorsWithPredictedSigma.concatenate([one.spread for one in cases]),
                )
                if len(cases) > 1:
                    print_line(f"{group}, all", together, "")
                ratios.append(float((together.hybrid.mean() / together.geometric.mean()).sqrt()))
                spreads.append(together.spread)
        coverage = ErrorsWithPredictedSigma.concatenate(spreads).coverage
        mean = math.exp(sum(map(math.log, ratios)) / len(ratios))
        print(
            f"{part}: geometric mean of the ratios {mean:.3f}, worst {max(ratios):.3f}, 95 %: {coverage:.1%}\n"
        )


if __name__ == "__main__":
    main()
