"""Measuring sessions of simulated arms: share of wrong rows that is detected, and poses until the limit is reached.

Run `OMP_NUM_THREADS=1 python benchmarks/measuring.py [PART ...] [--seeds N]` with the simulator of arms (`sim.py`) in
`PISIGMA_SIMULATED`. In the part "alarms", one of 40 random rows has an error of 5 mm, or the points of two rows are
exchanged. It prints the share of these errors that is detected at once, from the seventh row on and at the end, and the
share of correct rows that are called wrong at once. The part "sessions" prints the number of planned and random poses
until 95 % of the errors are expected to be below the limit, and the true 95 % quantile of the errors.
"""

import argparse
import time
from dataclasses import replace

import numpy as np
import torch
from planning import ARMS, NOISE, Arm

from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.measurement.dataset import Measurements
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.session.row_judgement import judge_rows
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.validation.held_out.few_rows import fit_if_better
from pisigma.workflow.measure import MeasuringSession
from pisigma.workflow.plan import plan
from pisigma.workflow.settings.measuring import MeasureSettings

ROWS, JUDGED = 40, 6
LIMIT_MM, ACCEPTED_MM = 0.15, 0.17
POSES = {"planned": 80, "random": 150}


def alarms(names: list[str], seeds: range) -> None:
    """Print the shares of wrong rows and of correct rows that are called wrong."""
    wrong: list[tuple[int, bool, bool]] = []
    false = total = 0
    slowest = 0.0
    for name in names:
        for seed in seeds:
            arm = Arm(name, seed)
            rows = arm.rows(torch.from_numpy(arm.true.sample(ROWS, 100 + seed)))
            for kind in ("off", "swapped"):
                changed, at = with_error(rows, kind, np.random.default_rng(seed))
                trusted, at_once = torch.zeros(0, dtype=torch.bool), []
                for row in range(ROWS):
                    began = time.perf_counter()
                    some = changed.select(torch.arange(row + 1))
                    known = torch.cat([trusted, torch.tensor([False])])
                    trusted = judge_rows(arm.nominal, some, NOISE, known).used_rows
                    at_once.append(not bool(trusted[row]))
                    slowest = max(slowest, time.perf_counter() - began)
                wrong += [(row, at_once[row], not bool(trusted[row])) for row in at]
                false += sum(at_once) - sum(at_once[row] for row in at)
                total += ROWS - len(at)
    late = [one for one in wrong if one[0] >= JUDGED]
    print(
        f"{len(wrong)} wrong rows: {share([one[1] for one in wrong])} at once, {share([one[1] for one in late])} of "
        f"{len(late)} from row {JUDGED + 1} on, {share([one[2] for one in wrong])} in the end; {false} of {total} "
        f"right rows at once; slowest row {slowest:.2f} s",
        flush=True,
    )


def with_error(rows: Measurements, kind: str, rng: np.random.Generator) -> tuple[Measurements, list[int]]:
    """Return rows with one error of 5 mm or two exchanged rows, and their indices."""
    assert rows.position is not None
    position = rows.position.clone()
    one, other = rng.choice(ROWS, 2, replace=False).tolist()
    if kind == "swapped":
        position[[one, other]] = position[[other, one]]
        return replace(rows, position=position), [one, other]
    direction = rng.normal(size=3)
    position[one] += torch.from_numpy(5e-3 * direction / np.linalg.norm(direction))
    return replace(rows, position=position), [one]


def share(flags: list[bool]) -> str:
    """Format a share in per cent."""
    return f"{100 * np.mean(flags):.0f} %" if flags else "none"


def sessions(names: list[str], seeds: range) -> None:
    """Print poses and true errors of sessions that stop at the limit, for every arm and seed."""
    poses: dict[str, list[int]] = {how: [] for how in POSES}
    errors: dict[str, list[float]] = {how: [] for how in POSES}
    for seed in seeds:
        arm = Arm(names[seed % len(names)], seed)
        for how in POSES:
            began = time.perf_counter()
            count, p95 = session(arm, how)
            poses[how].append(count)
            errors[how].append(p95)
            seconds = time.perf_counter() - began
            print(
                f"{arm.nominal.name} {seed} {how:8s} {count:3d} poses, 95 % {p95:.3f} mm, {seconds:.0f} s",
                flush=True,
            )
    for how in POSES:
        good = sum(error <= ACCEPTED_MM for error in errors[how])
        print(
            f"{how}: {np.mean(poses[how]):.1f} poses, 95 % up to {ACCEPTED_MM} mm in {good} of {len(seeds)}"
        )
    print(f"planned over random: {sum(poses['planned']) / sum(poses['random']):.2f}", flush=True)


def session(arm: Arm, how: str) -> tuple[int, float]:
    """Measure until the session recommends stopping; return the poses and the 95 % quantile of the errors [mm]."""
    count = POSES[how]
    settings = PlanSettings(count=count, check=0, candidates=1000, sigma_mm=NOISE * 1e3)
    if how == "planned":
        stored = plan(arm.planned, settings).stored_plan
    else:
        q = torch.from_numpy(arm.true.sample(count, 100 + arm.seed))
        few = plan(arm.planned, replace(settings, count=1)).stored_plan
        stored = replace(
            few,
            arm=ArmInSurroundings.from_robot(arm.planned),
            q=q,
            is_test_pose=torch.zeros(count, dtype=torch.bool),
            candidate_number=torch.arange(count),
            waypoints=(q[:0],) * count,
        )
    rule = MeasureSettings(limit_mm=LIMIT_MM, least_gain_mm=0.0, replan=how == "planned")
    measuring, rows = MeasuringSession(stored, rule), None
    while not (state := measuring.state).is_finished:
        assert state.next_pose is not None
        line = len(state.rows.line) + 2
        x, _ = arm.true.measure(state.next_pose.q[None], rng=np.random.default_rng(1000 * arm.seed + line))
        row = Measurements(
            q=torch.from_numpy(state.next_pose.q[None]), position=torch.from_numpy(x), line=(line,)
        )
        measuring.add(row)
        if measuring.is_update_due:
            measuring.update()
    rows = measuring.rows
    assert rows is not None
    errors = fit_if_better(HybridCalibrator(arm.nominal), rows, lambda what: None).errors_of(arm.test)
    return rows.rows, float(errors["position"].norm(dim=1).quantile(0.95)) * 1e3


PARTS = {"alarms": alarms, "sessions": sessions}


def main() -> None:
    """Run the requested parts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", default=list(PARTS), metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--arms", default=",".join(ARMS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=30)
    stated = parser.parse_args()
    for part in stated.parts:
        PARTS[part](stated.arms.split(","), range(stated.first_seed, stated.first_seed + stated.seeds))


if __name__ == "__main__":
    main()
