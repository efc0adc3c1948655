"""How often `pisigma monitor` names the joint that moved, and how often it raises a false alarm, on measured robots.

Run `OMP_NUM_THREADS=1 python benchmarks/monitoring.py [--draws N]` with the measured files in `PISIGMA_DATA`. A model
is made of 600 random rows of a series; sessions are drawn from its other rows, with 0.05 deg added to the zero of one
joint or none. In some cases the tracker is moved as well. The last line times twelve sessions of ten rows.
"""

import argparse
import math
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch

import pisigma
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.monitoring.session import Session, is_frame, judge_session
from pisigma.recalibration.model_posterior import ModelPosterior
from pisigma.se3 import transform_from_xyzrpy

DATA = Path(os.environ.get("PISIGMA_DATA", "../shared/data"))
FILES = {"ur10": "ur10/series_b.csv", "ur5": "ur5/grid.csv"}
ROWS = 600
MOVED = math.radians(0.05)
ELSEWHERE = (0.3, -0.2, 0.1, 0.5, 0.2, -0.3)
CASES = (
    ("ur10", 5, (0, 1, 2, 3, 4, 5, 6), False),
    ("ur10", 12, (0, 2, 3, 4, 5, 6), True),
    ("ur5", 5, (0, 1, 2, 3), False),
    ("ur5", 20, (0, 4, 5), False),
)
"""Robot, rows of a session, joints (0 for none), whether the tracker was moved."""


def model_and_rest(name: str) -> tuple[CalibratedModel, Measurements]:
    """A model of some rows of a series, and its other rows."""
    robot = pisigma.Robot.load(name)
    data = pisigma.Measurements.read_csv(DATA / FILES[name], robot)
    order = torch.randperm(data.rows, generator=torch.Generator().manual_seed(1))
    settings = pisigma.CalibrationSettings(folds=0)
    model = pisigma.calibrate(robot, data.select(order[:ROWS].sort().values), settings).model
    return model, data.select(order[ROWS:].sort().values)


def moved(rows: Measurements, joint: int, tracker: bool) -> Measurements:
    """Rows as measured after a joint's zero and the tracker have moved."""
    q = rows.q.clone()
    if joint:
        q[:, joint - 1] -= MOVED
    if not tracker:
        return replace(rows, q=q)
    assert rows.position is not None
    T = transform_from_xyzrpy(torch.tensor(ELSEWHERE).double())
    rotation = None if rows.rotation is None else T[:3, :3] @ rows.rotation
    return replace(rows, q=q, position=rows.position @ T[:3, :3].T + T[:3, 3], rotation=rotation)


def is_right(session: Session, joint: int) -> bool:
    """Whether the joint that moved, and nothing else of the arm, is named; of no joint whether there is no alarm."""
    named = [one.moved.what for one in session.moved if not is_frame(one.moved.what)]
    return named == ([f"joint {joint}"] if joint else []) and session.verdict != "unclear"


def main() -> None:
    """Print one line a robot, number of rows and joint."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=100, help="Sessions of every line.")
    draws = parser.parse_args().draws
    made = {name: model_and_rest(name) for name in FILES}
    print("robot rows tracker  joint  right  seconds  unobservable")
    for name, count, joints, tracker in CASES:
        model, rest = made[name]
        posterior, generator = ModelPosterior.of(model), torch.Generator().manual_seed(3)
        for joint in joints:
            begun, right = time.perf_counter(), 0
            for _ in range(draws):
                chosen = torch.randperm(rest.rows, generator=generator)[:count]
                session, _ = judge_session(model, posterior, moved(rest.select(chosen), joint, tracker))
                right += is_right(session, joint)
            seconds = (time.perf_counter() - begun) / draws
            hidden = ", ".join(str(k) for k, seen in enumerate(session.observable, 1) if not seen) or "none"
            place = "moved" if tracker else "fixed"
            print(
                f"{name:5} {count:4} {place:7} {joint or 'none':>6} {right / draws:6.1%} {seconds:8.2f}  {hidden}",
                flush=True,
            )
    model, rest = made["ur10"]
    with tempfile.TemporaryDirectory() as folder:
        files = []
        for month in range(12):
            files.append(Path(folder) / f"2026-{month + 1:02d}-01.csv")
            rest.select(torch.arange(10 * month, 10 * month + 10)).write_csv(files[-1], model.robot)
        print(f"12 sessions of 10 rows: {pisigma.monitor(model, files).seconds:.2f} s")


if __name__ == "__main__":
    main()
