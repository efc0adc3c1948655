"""Kill runs of a fleet with bad files at random moments, kill workers and writes, and check that nothing is lost.

`python tests/hostile/fleet_kills.py --robots 200 --count 20 [--seed 0]`
"""

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from hostile.kills import contents
from pyarrow import parquet
from testing.fleet_robots import NOMINAL, rows_of
from testing.simulated_arm import simulate

from pisigma.workflow.cell.new_cell import NewCell
from pisigma.workflow.fleet.manifest import new_cells

MAX_FILE_SIZE = 40_000
"""Simulated space of a full disk [bytes]: histories and models do not fit."""


def _changed(change: Callable[[str], str]) -> Callable[[Path], None]:
    """Return a function that writes a changed file of good rows."""

    def write(path: Path) -> None:
        rows_of(0, 30, 0).write_csv(path, NOMINAL)
        path.write_text(change(path.read_text(encoding="utf-8")), encoding="utf-8")

    return write


def _with_nan(text: str) -> str:
    lines = text.splitlines()
    lines[5] = ",".join(["nan", *lines[5].split(",")[1:]])
    return "\n".join(lines)


def _repeated(text: str) -> str:
    header, first, *others = text.splitlines()
    return "\n".join([header, first, *[first for _ in others]])


def _other_robot(path: Path) -> None:
    replace(simulate("ur10", rows=30).measurements, rotation=None).write_csv(path, NOMINAL)


BAD: dict[str, tuple[Callable[[Path], None], str]] = {
    "nan": (_changed(_with_nan), "line 6"),
    "columns": (_changed(lambda text: text.replace("q3", "p3")), "p3"),
    "empty": (_changed(lambda text: ""), "empty"),
    "other": (_other_robot, "joint values"),
    "few": (_changed(lambda text: "\n".join(text.splitlines()[:4])), "poses"),
    "directory": (Path.mkdir, "directory"),
    "unreadable": (lambda path: path.symlink_to(path), "symbolic link"),
    "units": (_changed(lambda text: text.replace("_mm", "_m")), "unit"),
    "repeated": (_changed(_repeated), "poses"),
    "truncated": (_changed(lambda text: text[: len(text) // 2].rsplit(",", 1)[0]), "line"),
}
"""Robots with bad files: a function that writes the file, and a word of the reason. Not even root can read a link to
itself."""


def write_plant(folder: Path, out: Path, robots: int) -> dict[str, str]:
    """Write a manifest of robots, including the bad ones, and its cells; return the robots that have none."""
    lines = ["id,robot,data,date,options"]
    bad = dict(zip(np.linspace(0, robots - 1, len(BAD)).astype(int).tolist(), BAD, strict=True))
    for number in range(robots):
        name = f"{number:04d}-{bad.get(number, 'good')}"
        path = folder / f"{name}.csv"
        if number in bad:
            BAD[bad[number]][0](path)
        else:
            rows_of(number, 30, number).write_csv(path, NOMINAL)
        lines.append(f"{name},{NOMINAL.name},{path.name},2026-10-01,model=geometric")
    (folder / "fleet.csv").write_text("\n".join([*lines, ""]), encoding="utf-8")
    return dict(new_cells(folder / "fleet.csv", out, NewCell("")).refused)


def faults_of(refused: dict[str, str]) -> list[str]:
    """Return bad files that are not refused with their reason, and good ones that are refused."""
    faults = [f"{robot} is refused: {reason}" for robot, reason in refused.items() if "good" in robot]
    for name, (_, word) in BAD.items():
        reason = next((reason for robot, reason in refused.items() if robot.endswith(f"-{name}")), "")
        faults += [] if word in reason else [f"{name} is refused with: {reason or 'nothing'}"]
    return faults


def _start(folder: Path, out: str, *, full: bool = False) -> subprocess.Popen[str]:
    """Run the fleet, optionally on a full disk."""
    command = [sys.executable, "-m", "pisigma", "fleet", "run", out, "--jobs", "2", "--json"]

    def limit() -> None:
        if full:
            resource.setrlimit(resource.RLIMIT_FSIZE, (MAX_FILE_SIZE, MAX_FILE_SIZE))

    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    return subprocess.Popen(command, cwd=folder, text=True, preexec_fn=limit, **pipes)


def _refused(process: subprocess.Popen[str], faults: list[str]) -> dict[str, str]:
    """Return which robots a complete run refuses, and why; it ends with status 3."""
    report = json.loads(process.communicate()[0] or '{"refused": []}')
    if process.returncode != 3:
        faults.append(f"a run ended with status {process.returncode}")
    return {one["cell"]: one["reason"] for one in report["refused"]}


def _wait_for_models(process: subprocess.Popen[str], out: Path, more: int) -> None:
    """Wait until a number of further robots is calibrated, or all."""
    models = "*/models/*/model.yaml"
    wanted = len(list(out.glob(models))) + more
    while process.poll() is None and len(list(out.glob(models))) < wanted:
        time.sleep(0.01)


def _kill_a_worker(process: subprocess.Popen[str]) -> None:
    """Kill one of the processes that work on robots."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text(encoding="utf-8").split()
    for child in children:
        if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text(encoding="utf-8"):
            subprocess.run(["kill", "-KILL", child], check=True)
            return


def _same(folder: Path, out: str) -> list[str]:
    """Return how the results of a folder differ from those of the undisturbed run."""
    left = [path for path in contents(folder / out) if Path(path).name.startswith(".")]
    table, whole = (_results(folder / name) for name in (out, "whole"))
    return [f"{out}: {path} was left" for path in left] + (
        [] if table == whole else [f"{out}: other results"]
    )


def _results(out: Path) -> list[dict[str, object]]:
    """Return the table of results, without names and hashes of models, which a kill after writing one changes."""
    table = parquet.read_table(out / "results.parquet").drop_columns(["model", "model_sha256", "summary"])
    return [row for row in table.to_pylist() if row["verdict"] != "refused"]


def main() -> None:
    """Run the fleet undisturbed; then kill runs, a worker and writes, and compare the results of later runs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=200)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    wanted = parser.parse_args()
    rng, faults, killed = np.random.default_rng(wanted.seed), list[str](), 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        (folder / "rows").mkdir()
        refused = write_plant(folder / "rows", folder / "whole", wanted.robots)
        for out in ("killed", "worker", "full"):
            shutil.copytree(folder / "whole", folder / out)
        started = time.monotonic()
        refused |= _refused(_start(folder, "whole"), faults)
        seconds = time.monotonic() - started
        faults += faults_of(refused)
        for _ in range(wanted.count):
            process = _start(folder, "killed")
            more = int(
                rng.integers(wanted.robots // wanted.count + 1)
            )  # all are not done before the last kill
            _wait_for_models(process, folder / "killed", more)
            time.sleep(float(rng.uniform(0.0, 0.5)))
            process.kill()
            process.communicate()
            killed += process.returncode < 0
        process = _start(folder, "worker")
        _wait_for_models(process, folder / "worker", 1)
        _kill_a_worker(process)
        _refused(process, faults)
        without_space = _refused(_start(folder, "full", full=True), faults)
        for out in ("killed", "full"):
            _refused(_start(folder, out), faults)
        for out in ("killed", "worker", "full"):
            faults += _same(folder, out)
        print(f"{wanted.robots} robots in {seconds:.0f} s, {len(without_space)} refused on a full disk.")
        print("\n".join(f"{robot}: {reason}" for robot, reason in refused.items()))
    print("\n".join(faults))
    print(f"{killed} of {wanted.count} killed, {len(faults)} faults.")
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
