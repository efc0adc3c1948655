"""Test with simulated arms whether `pisigma status` names the right next step, from a URDF file to a verified model.

Run `OMP_NUM_THREADS=1 python benchmarks/cell.py FOLDER_OF_SIM [--arms kr10 scara] [--seeds 10] [--subprocess]`.

FOLDER_OF_SIM contains the independent simulator `sim.py` and its URDF files. Every arm takes eight commands: new, plan,
import, calibrate, plan, import, verify and serve. `new` states the robot, the folder, the sensor and the limit; every
other command is `next.command` of `pisigma status CELL --json`, word by word, with the name of the file of rows in
place of `ROWS.csv`. The simulator measures the poses of the plans. It also evaluates the model in use at 300 other
poses, compared with the nominal robot and the model of `pisigma calibrate URDF ROWS.csv` without a cell.
"""

import argparse
import csv
import io
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import typer
from simulated_arm import import_simulator, position_error, rms_after_fit
from typer.main import get_command

from pisigma.cli.main import app
from pisigma.model.folder.model_folder import load_model

ARMS = ("kr10", "irb120", "arm7", "scara", "rail")
LIMIT_MM = 0.5
STEPS = ("plan", "import", "calibrate", "plan", "import", "verify", "")
"""The right next step after every command from `new` to `verify`; at the end, no step is due."""
PROGRAM = "from pisigma.cli.main import run; run()"


class Arm:
    """One arm with its cell, and the figures of the table.

    Attributes:
        commands: number of commands that had exit status 0.
        right: number of correct next steps.
    """

    def __init__(self, sim: Any, name: str, seed: int, folder: Path, alone: bool) -> None:
        self.sim, self.name, self.folder, self.alone = sim, name, folder, alone
        self.true = sim.True_(name, seed=seed)
        self.rng = np.random.default_rng([seed, 5])
        self.cell, self.rows = folder / name, list[Path]()
        self.commands = self.right = 0

    def run(self, *words: str) -> str:
        """Run a command of pisigma, and return what it prints to stdout.

        Raises:
            RuntimeError: the exit status is not 0.
        """
        printed, problems, status = io.StringIO(), io.StringIO(), 0
        if self.alone:
            done = subprocess.run([sys.executable, "-c", PROGRAM, *words], capture_output=True, text=True)
            status, out, err = done.returncode, done.stdout, done.stderr
        else:
            with redirect_stdout(printed), redirect_stderr(problems):
                try:
                    get_command(app).main(list(words), standalone_mode=False)
                except (SystemExit, typer.Exit) as end:
                    status = int(getattr(end, "code", getattr(end, "exit_code", 1)) or 0)
            out, err = printed.getvalue(), problems.getvalue()
        if status:
            raise RuntimeError(f"{shlex.join(words)} ended with {status}: {out[-500:]} {err[-500:]}")
        return out

    def measure(self) -> Path:
        """Add the measured columns to the rows of the newest plan."""
        plan = max((self.cell / "plans").glob("*.csv"), key=lambda one: one.stat().st_mtime)
        with plan.open() as file:
            header, *rows = list(csv.reader(file))
        q = np.array([row[: self.true.nq] for row in rows], dtype=float) / self.sim.scale(self.true)
        x, _ = self.true.measure(q, rng=self.rng)
        path = self.folder / f"rows-{len(self.rows)}.csv"
        with path.open("w", newline="") as file:
            lines = (
                [*row, *(f"{1e3 * value:.6f}" for value in one)] for row, one in zip(rows, x, strict=True)
            )
            csv.writer(file).writerows([[*header, "x_mm", "y_mm", "z_mm"], *lines])
        self.rows.append(path)
        return path

    def go(self) -> None:
        """Run all commands that `status` names as next steps, one after the other."""
        urdf = Path(self.sim.__file__).parent / f"{self.name}.urdf"
        self.run(
            "new", str(urdf), "--out", str(self.cell), "--sensor", "tracker", "--limit-mm", str(LIMIT_MM)
        )
        self.commands += 1
        for step in STEPS:
            words = shlex.split(
                json.loads(self.run("status", str(self.cell), "--json"))["next"]["command"] or ""
            )
            self.right += words[1:2] == ([step] if step else [])
            if not words:
                return
            rows = str(self.measure()) if "ROWS.csv" in words else ""
            self.run(*(rows if word == "ROWS.csv" else word for word in words[1:]))
            self.commands += 1

    def serve(self) -> None:
        """Serve the cell until the server is ready."""
        words = [sys.executable, "-c", PROGRAM, "serve", str(self.cell)]
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            self.commands += "json_port" in json.loads(server.stdout.readline())
            server.terminate()

    def judge(self) -> tuple[float, float, float, bool]:
        """Return the true RMS [mm] of the nominal robot and of both models, and whether the models are equal."""
        urdf, out = Path(self.sim.__file__).parent / f"{self.name}.urdf", self.folder / "alone"
        self.run("calibrate", str(urdf), str(self.rows[0]), "--out", str(out), "--folds", "0")
        (inside,) = (self.cell / "models").iterdir()
        q = self.true.sample(300, 99)
        x, _ = self.true.tip(q)
        rotation, position, _, _ = self.true.chain(q, err=False)
        nominal = rms_after_fit(position + rotation @ self.true.tool, x)
        errors = [position_error(load_model(one), q, x) for one in (inside, out)]
        first, second = ((one / "model.safetensors").read_bytes() for one in (inside, out))
        return nominal, errors[0], errors[1], first == second and errors[0] == errors[1]


def main() -> None:
    """Run the arms and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--arms", nargs="+", default=ARMS)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--subprocess", action="store_true", help="Run every command in its own process.")
    stated = parser.parse_args()
    sim = import_simulator(stated.folder)
    print("arm     seed  commands  right steps  nominal [mm]  cell [mm]  alone [mm]  equal  seconds")
    for seed in range(stated.first, stated.first + stated.seeds):
        for name in stated.arms:
            with tempfile.TemporaryDirectory() as folder:
                begun, arm = time.monotonic(), Arm(sim, name, seed, Path(folder), stated.subprocess)
                try:
                    arm.go()
                    arm.serve()
                    figures = "{:12.3f}  {:9.4f}  {:10.4f}  {}".format(*arm.judge())
                except RuntimeError as problem:
                    figures = str(problem).replace("\n", " ")
                print(
                    f"{name:7} {seed:4}  {arm.commands} of 8  {arm.right:4} of 7    {figures}  "
                    f"{time.monotonic() - begun:.0f}",
                    flush=True,
                )


if __name__ == "__main__":
    os.environ.setdefault("COLUMNS", "100")
    main()
