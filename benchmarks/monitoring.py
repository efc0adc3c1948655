"""Share of sessions of measured robots in which `pisigma monitor` names the joint that moved, and false alarms.

Run `OMP_NUM_THREADS=1 python benchmarks/monitoring.py [--draws N]` with the measured files in `PISIGMA_DATA`. A model
is fitted to 600 random rows of a series; sessions are drawn from its other rows, with 0.05 deg added to the zero of one
joint or of no joint. In some cases the tracker is moved as well. Then ten simulated arms (`PISIGMA_SIMULATED`) are
monitored for two years with ten rows a month, with and without a drift of joint 2. The last lines state the time for
twelve sessions of ten rows.
"""

import argparse
import math
import os
import tempfile
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import torch
from recalibration import simulated_arm, simulated_rows

import pisigma
from pisigma.lifetime.monitoring.session import SessionResult, is_frame, judge_session
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.model_posterior import ModelPosterior
from pisigma.robot.se3 import transform_from_xyz_zyx

DATA = Path(os.environ.get("PISIGMA_DATA", "../shared/data"))
FILES = {"ur10": "ur10/series_b.csv", "ur5": "ur5/grid.csv"}
ROWS = 600
MOVED = math.radians(0.05)
ARMS, ARM_ROWS, MONTHS = 10, 120, 24
"""Numbers of simulated arms, of rows of their calibrations, and of monitored months."""
ELSEWHERE = (0.3, -0.2, 0.1, 0.5, 0.2, -0.3)
CASES = (
    ("ur10", 5, (0, 1, 2, 3, 4, 5, 6), False),
    ("ur10", 12, (0, 2, 3, 4, 5, 6), True),
    ("ur5", 5, (0, 1, 2, 3), False),
    ("ur5", 20, (0, 4, 5), False),
)
"""Robot, rows of a session, joints (0 for none), whether the tracker was moved."""


def model_and_rest(name: str) -> tuple[CalibratedModel, Measurements]:
    """Return a model of some rows of a series, and its other rows."""
    robot = pisigma.Robot.load(name)
    data = pisigma.Measurements.read_csv(DATA / FILES[name], robot)
    order = torch.randperm(data.rows, generator=torch.Generator().manual_seed(1))
    settings = pisigma.CalibrationSettings(folds=0)
    model = pisigma.calibrate(robot, data.select(order[:ROWS].sort().values), settings).model
    return model, data.select(order[ROWS:].sort().values)


def moved(rows: Measurements, joint: int, tracker: bool) -> Measurements:
    """Return rows as measured after a joint's zero and the tracker have moved."""
    q = rows.q.clone()
    if joint:
        q[:, joint - 1] -= MOVED
    if not tracker:
        return replace(rows, q=q)
    assert rows.position is not None
    T = transform_from_xyz_zyx(torch.tensor(ELSEWHERE).double())
    rotation = None if rows.rotation is None else T[:3, :3] @ rows.rotation
    return replace(rows, q=q, position=rows.position @ T[:3, :3].T + T[:3, 3], rotation=rotation)


def is_right(session: SessionResult, joint: int) -> bool:
    """Return whether exactly the moved joint is named, or no alarm is raised if no joint moved."""
    named = [one.what for one in session.movements if not is_frame(one.what)]
    return named == ([f"joint {joint}"] if joint else []) and session.verdict != "unclear"


def months() -> None:
    """Print when a drift of 0.01 deg a month causes the first alarm, and the number of alarms without a drift."""
    firsts, alarms = [], 0
    settings = pisigma.MonitorSettings(
        dates=tuple(f"{2026 + month // 12}-{month % 12 + 1:02d}-01" for month in range(MONTHS))
    )
    for seed in range(ARMS):
        arm, model = simulated_arm(ARM_ROWS, seed)
        for drift in (0.0, math.radians(0.01)):
            sessions = []
            for month in range(MONTHS):
                arm.perturb[1] = drift * (month + 1)
                q = arm.sample(10, 5000 + 100 * seed + month)
                sessions.append(simulated_rows(arm, q, 9000 + 100 * seed + month))
            alarmed = _alarmed(pisigma.monitor(model, sessions, settings))
            if drift:
                firsts.append(alarmed.index(True) + 1 if True in alarmed else MONTHS + 1)
            else:
                alarms += sum(now and not before for before, now in pairwise([False, *alarmed]))
        print(f"arm {seed}: first alarm after {firsts[-1]} months; {alarms} false alarms so far", flush=True)
    years = ARMS * MONTHS / 12
    print(
        f"drift of 0.01 deg a month: first alarm after {max(firsts)} months at most; without drift {alarms} alarms in "
        f"{years:g} years, {alarms / years:.3f} a year"
    )


def _alarmed(monitoring: pisigma.MonitoringResult) -> list[bool]:
    """Return for every session whether a chart is outside its limits or a motion is reported."""
    outside = torch.stack(
        [one for chart in monitoring.charts for one in chart.sessions_outside.values()]
    ).any(0)
    moved = [one.session.verdict != "unchanged" for one in monitoring.sessions_of_call]
    return [one or other for one, other in zip(outside.tolist(), moved, strict=True)]


def main() -> None:
    """Print one line per robot, number of rows and joint."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=100, help="Number of sessions per line.")
    parser.add_argument(
        "--months", action="store_true", help="Only monitor the simulated arms over the months."
    )
    wanted = parser.parse_args()
    draws = wanted.draws
    if wanted.months:
        months()
        return
    made = {name: model_and_rest(name) for name in FILES}
    print("robot rows tracker  joint  right  seconds  unobservable")
    for name, count, joints, tracker in CASES:
        model, rest = made[name]
        posterior, generator = ModelPosterior.from_model(model), torch.Generator().manual_seed(3)
        for joint in joints:
            begun, right = time.perf_counter(), 0
            for _ in range(draws):
                chosen = torch.randperm(rest.rows, generator=generator)[:count]
                session, _ = judge_session(model, posterior, moved(rest.select(chosen), joint, tracker))
                right += is_right(session, joint)
            seconds = (time.perf_counter() - begun) / draws
            hidden = (
                ", ".join(str(k) for k, seen in enumerate(session.zero_is_observable, 1) if not seen)
                or "none"
            )
            place = "moved" if tracker else "fixed"
            print(
                f"{name:5} {count:4} {place:7} {joint or 'none':>6} {right / draws:6.1%} {seconds:8.2f}  {hidden}",
                flush=True,
            )
    months()
    model, rest = made["ur10"]
    for tracker in (False, True):
        with tempfile.TemporaryDirectory() as folder:
            files = []
            for month in range(12):
                files.append(Path(folder) / f"2026-{month + 1:02d}-01.csv")
                rows = rest.select(torch.arange(10 * month, 10 * month + 10))
                moved(rows, 0, tracker).write_csv(files[-1], model.robot)
            seconds, state = pisigma.monitor(model, files).seconds, "moved" if tracker else "fixed"
            print(f"12 sessions of 10 rows, tracker {state}: {seconds:.2f} s")


if __name__ == "__main__":
    main()
