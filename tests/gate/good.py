"""Good measurements that `calibrate` has to trust with status 0: `python tests/gate/run.py good`.

More than 300 subsets of measured robots and rows of simulated arms. Results are stored, so that a run can be resumed.
"""

import argparse
import concurrent.futures
import itertools
import json
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

DATA = Path(os.environ.get("PISIGMA_DATA", "../shared/data")).resolve()
SIMULATED = DATA.parent / "simulated"
MEASURED = (
    ("ur10", "ur10/series_c_train.csv", (), 30),
    ("ur10", "ur10/series_b.csv", (), 30),
    ("ur5", "ur5/grid.csv", (), 30),
    ("fanuc_r2000", "fanuc_r2000/positions.csv", (), 0),
    ("panda", "panda_sockets/panda_3.csv", ("--set", "socket_distance=*/0,*/1,50"), 0),
)
"""Robot, file, options, and number of random subsets of rows; 0 for the whole file."""
SUBSET_ROWS = (30, 40, 60, 100)
ARMS = {"kr10": 0, "irb120": 0, "arm7": 0, "scara": 0, "rail": 0}
KINDS = ("positions", "poses", "zeros 20 mrad off", "zeros 40 mrad off")
SEEDS, ROWS = 3, (40, 60, 100)


@dataclass(frozen=True)
class Case:
    """Correct rows.

    Attributes:
        name: name under which the result is stored.
        robot: catalogue name or file.
        source: a measured file, or the name of a simulated arm.
        options: options of `calibrate`.
        seed: random seed of the subset or the arm.
        rows: number of rows; 0 for all.
        kind: measurement and errors of a simulated arm; empty for a measured file.
    """

    name: str
    robot: str
    source: str
    options: tuple[str, ...]
    seed: int
    rows: int
    kind: str = ""


def cases() -> Iterator[Case]:
    """Yield all cases, each as geometric and as hybrid calibration, with mixed sources."""
    for model in ("geometric", "hybrid"):
        for robot, file, options, subsets in MEASURED:
            for seed in range(max(subsets // 2, 1)):
                rows = SUBSET_ROWS[seed % len(SUBSET_ROWS)] if subsets else 0
                name = f"{file} {seed} {rows} {model}"
                yield Case(name, robot, file, (*options, "--model", model), seed, rows)
        for arm, kind, seed, rows in itertools.product(ARMS, KINDS, range(SEEDS), ROWS):
            robot = str(SIMULATED / f"{arm}.urdf")
            name = f"{arm} {kind} {seed} {rows} {model}"
            yield Case(name, robot, arm, ("--model", model), seed, rows, kind)


def write_rows(case: Case, path: Path) -> None:
    """Write the rows of a case."""
    if case.kind:
        sys.path.insert(0, str(SIMULATED))
        import sim  # type: ignore[import-not-found]

        match = re.search(r"(\d+) mrad", case.kind)
        zeros = float(np.rad2deg(int(match[1]) * 1e-3)) if match else 0.05
        arm = sim.True_(case.source, seed=case.seed + 11, off=zeros)
        q = arm.sample(case.rows, case.seed + 101)
        x, rotation = arm.measure(q, rng=np.random.default_rng(case.seed))
        sim.write_csv(path, arm, q, x, rotation if case.kind == "poses" else None)
        return
    header, *lines = (DATA / case.source).read_text(encoding="utf-8").splitlines()
    if case.rows:
        chosen = np.random.default_rng(case.seed).permutation(len(lines))[: case.rows]
        lines = [lines[number] for number in sorted(chosen)]
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")


def judge(case: Case) -> dict[str, object]:
    """Calibrate with the rows of a case in a separate process, and return its status and diagnostics."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rows.csv"
        write_rows(case, path)
        out = str(Path(folder) / "model")
        words = [sys.executable, "-m", "pisigma", "calibrate", case.robot, str(path), "--out", out, "--json"]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            [*words, *case.options], capture_output=True, text=True, check=False, env=environment
        )
    said = [] if not done.stdout.startswith("{") else json.loads(done.stdout)["diagnostics"]
    return {
        "name": case.name,
        "status": done.returncode,
        "kinds": [f"{one['severity']} {one['kind']}" for one in said],
        "said": [one["sentence"] for one in said] or done.stderr[-500:],
    }


def main(arguments: Sequence[str] = ()) -> int:
    """Calibrate all cases without a stored result, and return the number of false alarms.

    Args:
        arguments: options of `python tests/gate/good.py`; GATE_JOBS in the environment sets the default of --jobs.
    """
    parser = argparse.ArgumentParser(prog="run.py good", description=__doc__)
    parser.add_argument("--jobs", type=int, default=int(os.environ.get("GATE_JOBS", "1")), help="Processes")
    parser.add_argument("--every", type=int, default=1, help="Take every n-th case only")
    parser.add_argument("--kept", type=Path, default=Path("runs/good.jsonl"), help="File of results")
    stated = parser.parse_args(arguments)
    stated.kept.parent.mkdir(parents=True, exist_ok=True)
    lines = stated.kept.read_text(encoding="utf-8").splitlines() if stated.kept.exists() else []
    judged = {one["name"]: one for one in map(json.loads, lines)}
    chosen = list(cases())[:: stated.every]
    left = [case for case in chosen if case.name not in judged]
    with concurrent.futures.ThreadPoolExecutor(stated.jobs) as pool, stated.kept.open("a") as file:
        for done in concurrent.futures.as_completed([pool.submit(judge, case) for case in left]):
            answer = done.result()
            judged[str(answer["name"])] = answer
            file.write(json.dumps(answer) + "\n")
            file.flush()
            print(f"status {answer['status']}  {answer['name']}  {', '.join(answer['kinds'])}", flush=True)
    answers = [judged[case.name] for case in chosen]
    alarms = [one for one in answers if one["status"] != 0]
    kinds = Counter(kind for one in answers for kind in one["kinds"])
    print(f"{len(alarms)} false alarms in {len(answers)} good cases; warnings: {dict(kinds)}")
    for one in alarms:
        print(f"- {one['name']}: status {one['status']}: {one['said']}")
    return len(alarms)


if __name__ == "__main__":
    sys.exit(1 if main(sys.argv[1:]) else 0)
