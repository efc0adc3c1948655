"""Recalibration with few rows: accuracy between series, choice of the model, a collision, repeated use, and time.

Run `OMP_NUM_THREADS=1 python benchmarks/recalibration.py [PART ...]` with the measured files in `PISIGMA_DATA` and the
simulator in `PISIGMA_SIMULATED`. A part is one of the names in `PARTS`. Errors are RMS position errors [mm] of all rows
that were not used for the recalibration; a draw is a random choice of rows.
"""

import argparse
import contextlib
import importlib.util
import math
import os
import sys
import tempfile
import time
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch

from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.files.errors import IdentificationError
from pisigma.lifetime.recalibration.adaptation import adapt
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.planning.plan_settings import PlanSettings
from pisigma.robot import Robot
from pisigma.validation.held_out.trained_calibrations import fit
from pisigma.workflow.plan import plan
from pisigma.workflow.recalibrate import Recalibration, recalibrate
from pisigma.workflow.settings.recalibration import RecalibrationSettings

DATA = Path(os.environ.get("PISIGMA_DATA", "../shared/data"))
SIMULATED = Path(os.environ.get("PISIGMA_SIMULATED", "../shared/simulated"))
SERIES = {"B": "ur10/series_b.csv", "C": "ur10/series_c_train.csv"}
DRAWS = 10
ASKED = {10: 0.42, 20: 0.28, 30: 0.225, 50: 0.165}
ASKED_OF_PLAN = {10: 0.38, 20: 0.24, 30: 0.19}
GATE_ROWS = (5, 7, 10, 15, 20, 30, 50, 70, 100)
COLLISION_SEEDS = range(10)


@cache
def series(name: str) -> Measurements:
    """Return all rows of a series of the UR10."""
    return Measurements.read_csv(DATA / SERIES[name], Robot.load("ur10"))


@cache
def model_of(name: str) -> CalibratedModel:
    """Return the hybrid calibration of a series."""
    robot, rows = Robot.load("ur10"), series(name)
    return model_of_hybrid(name, robot, HybridCalibrator(robot).fit(rows), rows)


def drawn(rows: Measurements, count: int, draw: int) -> tuple[Measurements, Measurements]:
    """Return a number of random rows, and all other rows."""
    order = torch.randperm(rows.rows, generator=torch.Generator().manual_seed(draw))
    return rows.select(order[:count].sort().values), rows.select(order[count:].sort().values)


def rms_mm(errors: torch.Tensor) -> float:
    """Return the root mean square of the lengths of errors [m], in mm."""
    return float(errors.square().sum(1).mean().sqrt()) * 1e3


def error_of(model: CalibratedModel, rows: Measurements) -> float:
    """Return the RMS position error of a model [mm]."""
    assert rows.position is not None
    return rms_mm(rows.position - poses_of_rows(model, rows)[:, :3, 3])


def accuracy() -> None:
    """Recalibrate a model of series B with few rows of series C."""
    for moved in (None, ("base", "tool")):
        for count, asked in ASKED.items():
            errors = []
            for draw in range(DRAWS):
                few, others = drawn(series("C"), count, draw)
                result = recalibrate(model_of("B"), few, RecalibrationSettings(moved))
                errors.append(error_of(result.model, others))
            mean, shown = np.mean(errors), " ".join(f"{error:.3f}" for error in errors)
            print(
                f"B to C, moved {moved or 'not stated'}, {count} rows: {mean:.3f} (limit {asked}): {shown}",
                flush=True,
            )


def planned() -> None:
    """Recalibrate a model of series B with rows that `pisigma plan` chooses with this model from all of series C."""
    rows, every = series("C"), np.arange(series("C").rows)
    with tempfile.TemporaryDirectory() as folder:
        candidates = Path(folder) / "candidates.csv"
        rows.write_csv(candidates, Robot.load("ur10"))
        for count, asked in ASKED_OF_PLAN.items():
            settings = PlanSettings(count, check=0, candidates_from=str(candidates))
            chosen = plan(model_of("B"), settings).stored_plan.candidate_number.numpy() - 1
            few, others = (
                rows.select(torch.from_numpy(one)) for one in (chosen, np.setdiff1d(every, chosen))
            )
            for moved in (None, ("base", "tool")):
                result = recalibrate(model_of("B"), few, RecalibrationSettings(moved))
                error, shown = error_of(result.model, others), moved or "not stated"
                print(f"B to C, moved {shown}, {count} planned rows: {error:.3f} (limit {asked})", flush=True)


def candidates_of(result: Recalibration, few: Measurements, others: Measurements) -> dict[str, float]:
    """Return RMS position errors of every candidate [mm]; infinite if the rows do not determine it."""
    adaptation, errors = result.adaptation, {}
    errors["recalibrated"] = rms_mm(adaptation.errors_of(others)["position"])
    old = adapt(adaptation.problem.with_fixed_arm(), adaptation.drift.noise)
    errors["old"] = rms_mm(old.errors_of(others)["position"])
    try:
        scratch = fit(HybridCalibrator(Robot.load("ur10")), few, lambda what: None)
        errors["scratch"] = rms_mm(scratch.errors_of(others)["position"])
    except IdentificationError:
        errors["scratch"] = math.inf
    return errors


def gate() -> None:
    """Print the ratio of the kept candidate's error to that of the best one, as mean and maximum over the draws."""
    for before, after in (("B", "C"), ("C", "B")):
        for count in GATE_ROWS:
            kept, best, ratios, chosen = 0.0, 0.0, [], []
            for draw in range(DRAWS):
                few, others = drawn(series(after), count, draw)
                result = recalibrate(model_of(before), few)
                errors = candidates_of(result, few, others)
                kept, best = kept + errors[result.summary.kept_candidate], best + min(errors.values())
                ratios.append(errors[result.summary.kept_candidate] / min(errors.values()))
                chosen.append(result.summary.kept_candidate)
            counts = {name: chosen.count(name) for name in dict.fromkeys(chosen)}
            print(
                f"{before} to {after}, {count} rows: {np.mean(ratios):.3f} of the best (means {kept / best:.3f}), "
                f"at most {max(ratios):.3f}; {counts}",
                flush=True,
            )


@cache
def simulator() -> tuple[ModuleType, Robot]:
    """Return the independent simulator, and the nominal robot that it simulates."""
    spec = importlib.util.spec_from_file_location("sim", SIMULATED / "sim.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        module.write_urdf("kr10")
        return module, Robot.load("kr10.urdf")


def simulated_rows(arm: Any, q: np.ndarray, seed: int | None = None) -> Measurements:
    """Return measured positions of a simulated arm, with noise and repeatability if there is a seed."""
    sigma, repeatability = (0.0, 0.0) if seed is None else (3e-5, 2e-5)
    position, _ = arm.measure(q, sigma, rng=np.random.default_rng(seed), rep=repeatability)
    return Measurements(torch.from_numpy(q), torch.from_numpy(position))


def simulated_arm(rows: int, seed: int) -> tuple[Any, CalibratedModel]:
    """Return a simulated arm, and its calibration with a number of rows."""
    sim, robot = simulator()
    arm = sim.True_("kr10", seed)
    before = simulated_rows(arm, arm.sample(rows, 1000 + seed), seed)
    return arm, model_of_hybrid("kr10", robot, HybridCalibrator(robot).fit(before), before)


def collision() -> None:
    """Print the ratio of the error after ten poses to that before a collision of joint 3 of the simulated kr10."""
    for rows in (60, 120, 300):
        ratios, joints = [], []
        for seed in COLLISION_SEEDS:
            arm, model = simulated_arm(rows, seed)
            check = arm.sample(500, 7)
            error = error_of(model, simulated_rows(arm, check))
            arm.perturb[2] = math.radians(0.25)
            result = recalibrate(model, simulated_rows(arm, arm.sample(10, 500 + seed), 77 + seed))
            ratios.append(error_of(result.model, simulated_rows(arm, check)) / error)
            joints.append("; ".join(one.sentence for one in result.movements))
        shown = " ".join(f"{ratio:.2f}" for ratio in ratios)
        print(
            f"collision after a calibration with {rows} rows: {np.mean(ratios):.3f} of the error before: {shown}"
        )
        print("  " + " | ".join(joints), flush=True)


def chain() -> None:
    """Compare ten recalibrations with twenty rows each with one with all rows, and with a calibration of all rows."""
    robot, rows = Robot.load("ur10"), series("C")
    order = torch.randperm(rows.rows, generator=torch.Generator().manual_seed(0))
    first, test = rows.select(order[:300]), rows.select(order[500:])
    model = model_of_hybrid("first", robot, HybridCalibrator(robot).fit(first), first)
    link = model
    for k in range(10):
        link = recalibrate(link, rows.select(order[300 + 20 * k : 320 + 20 * k])).model
    at_once = recalibrate(model, rows.select(order[300:500])).model
    every = rows.select(order[:500])
    whole = model_of_hybrid("whole", robot, HybridCalibrator(robot).fit(every), every)
    models = {"before": model, "chain": link, "at once": at_once, "all rows": whole}
    print("; ".join(f"{name} {error_of(one, test):.4f}" for name, one in models.items()), flush=True)


def seconds() -> None:
    """Time a recalibration of the UR10 with ten rows, without the start of the program and without files."""
    few, _ = drawn(series("C"), 10, 0)
    model = model_of("B")
    for moved in (None, ("base", "tool")):
        started = time.perf_counter()
        recalibrate(model, few, RecalibrationSettings(moved))
        print(f"10 rows, moved {moved or 'not stated'}: {time.perf_counter() - started:.2f} s", flush=True)


PARTS = {
    "accuracy": accuracy,
    "planned": planned,
    "gate": gate,
    "collision": collision,
    "chain": chain,
    "seconds": seconds,
}


def main() -> None:
    """Run the named parts, or all parts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], metavar="PART")
    torch.set_num_threads(1)
    for name in parser.parse_args().parts or PARTS:
        print(f"{name}:", file=sys.stderr)
        PARTS[name]()


if __name__ == "__main__":
    main()
