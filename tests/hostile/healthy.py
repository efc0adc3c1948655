"""Correct inputs: refusing one of them is a false alarm."""

import shutil
from pathlib import Path

from hostile.case import Case, Rng, calibrate, one_of
from hostile.clean import Clean, CleanRows, outside_rows, simulated_rows
from testing.outside_arm import SIMULATOR

_CATALOGUE = ("ur5", "ur10", "rb5", "fanuc_r2000", "panda", "kiro3", "kiro4")
_OUTSIDE = ("kr10", "irb120", "arm7", "scara", "rail")


def healthy_robot(rng: Rng, clean: Clean, folder: Path) -> Case:
    """Write good measurements of a simulated robot with the usual errors."""
    seed, rows = int(rng.integers(1000)), int(rng.integers(30, 150))
    if rng.random() < 0.5 and SIMULATOR.is_file():
        name = one_of(rng, _OUTSIDE)
        truth = outside_rows(folder, name, seed, rows)
    else:
        name, turn = one_of(rng, _CATALOGUE), one_of(rng, (None, 1e-4, 1e-3))
        truth = simulated_rows(folder, name, seed, rows, turn, one_of(rng, (1e-5, 5e-5, 2e-4)))
    return Case(
        f"{name}, seed {seed}, {rows} rows", calibrate(truth.robot, truth.path.name), truth, healthy=True
    )


def measured_robot(rng: Rng, clean: Clean, folder: Path) -> Case:
    """Write a random part of the clean rows of a measured robot, in their order."""
    name = one_of(rng, list(clean.rows))
    truth: CleanRows = clean.rows[name]
    header, *lines = truth.path.read_text(encoding="utf-8").splitlines()
    if "socket" in header or "pair" in header:  # whose rows belong together
        shutil.copy(truth.path, folder / "rows.csv")
    else:
        kept = [line for line in lines if rng.random() < 0.8]
        (folder / "rows.csv").write_text("\n".join([header, *kept]) + "\n", encoding="utf-8")
    return Case(name, calibrate(truth.robot, "rows.csv"), truth, healthy=True)
