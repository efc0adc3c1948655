"""Time and memory that a fleet of simulated robots takes with processes and with Ray, and recovery from killed runs.

Run `OMP_NUM_THREADS=1 python benchmarks/fleet.py [PART ...]` with the simulator of arms (`sim.py`) in
`PISIGMA_SIMULATED`. Every robot is a kr10 with individual errors, measured at `--poses` poses. The part `before`
compares cells with the manifest of a checkout of an earlier version (`--before FOLDER`), alternately.
"""

import argparse
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pyarrow import parquet

SIMULATED = Path(os.environ.get("PISIGMA_SIMULATED", "../shared/simulated"))


def write_fleet(folder: Path, robots: int, poses: int, model: str) -> None:
    """Simulate measurements of the robots, with the manifest `fleet.csv`."""
    sys.path.insert(0, str(SIMULATED))
    import sim  # type: ignore[import-not-found]

    os.chdir(folder)
    sim.write_urdf("kr10")
    lines = ["id,robot,data,date,options"]
    for number in range(robots):
        true, rng = sim.True_("kr10", seed=number), np.random.default_rng(number)
        q = true.sample(poses, 1000 + number)
        position, _ = true.measure(q, noise=3e-5, rng=rng, rep=2e-5)
        header = ",".join([*(f"q{k + 1}_rad" for k in range(q.shape[1])), "x_mm", "y_mm", "z_mm"])
        rows = np.column_stack([q, position * 1e3])
        np.savetxt(f"r{number:04d}.csv", rows, "%.9f", ",", header=header, comments="")
        lines.append(f"r{number:04d},kr10.urdf,r{number:04d}.csv,2026-10-01,model={model}")
    Path("fleet.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    new = [sys.executable, "-m", "pisigma", "new", "--from", "fleet.csv", "--out", "cells"]
    subprocess.run(new, check=True, stdout=subprocess.DEVNULL)


def command(out: str, *options: str) -> list[str]:
    """Return the command line of a run on a copy of the cells, which is created if it does not exist."""
    if not Path(out).exists():
        shutil.copytree("cells", out)
    return [sys.executable, "-m", "pisigma", "fleet", "run", out, "--json", *options]


def timed(out: str, *options: str) -> tuple[float, float]:
    """Return the duration of a run [s], and the peak memory of its child processes [GB]."""
    words = command(out, *options)
    started = time.monotonic()
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    most = 0.0
    while process.poll() is None:
        most = max(most, memory_below(process.pid))
        time.sleep(0.2)
    assert process.stdout is not None
    report = json.loads(process.stdout.read())
    assert report["done"] == report["cells"], report["refused"]
    return time.monotonic() - started, most


def memory_below(pid: int) -> float:
    """Return the resident memory of a process and its children, with shared pages counted once [GB]."""
    total, waiting = 0.0, [pid]
    while waiting:
        one = waiting.pop()
        try:
            sums = Path(f"/proc/{one}/smaps_rollup").read_text(encoding="utf-8")
            children = Path(f"/proc/{one}/task/{one}/children").read_text(encoding="utf-8")
        except OSError:  # the process has ended
            continue
        total += sum(int(line.split()[1]) for line in sums.splitlines() if line.startswith("Pss:")) / 1e6
        waiting += map(int, children.split())
    return total


def results(out: str) -> list[dict[str, object]]:
    """Return the results of a run without the names and hashes of models, which depend on when a process is killed."""
    table = parquet.read_table(f"{out}/results.parquet")
    rows: list[dict[str, object]] = table.drop_columns(["model", "model_sha256"]).to_pylist()
    return rows


def seconds_of(words: list[str], checkout: Path) -> tuple[float, float]:
    """Return duration and processor time [s] of a command of a checkout; the latter hardly depends on other load."""
    environment = os.environ | {"PYTHONPATH": os.fspath(checkout)}
    started, used = time.monotonic(), sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])
    done = subprocess.run(
        [sys.executable, "-m", "pisigma", *words], env=environment, capture_output=True, check=False
    )
    assert done.returncode in (0, 3), done.stderr.decode()
    return time.monotonic() - started, sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2]) - used


def before(robots: int, earlier: Path, repeats: int) -> None:
    """Compare the times of runs and status of cells with those of a manifest in an earlier version."""
    here, ratios = Path(__file__).resolve().parents[1], dict[str, list[float]]()
    for number in range(repeats):
        old, new = f"manifest{number}", f"cells{number}"
        shutil.copytree("cells", new)
        for name, of_manifest, of_cells in (
            ("run", ["fleet", "run", "fleet.csv", "--out", old], ["fleet", "run", new]),
            ("run again", ["fleet", "run", "fleet.csv", "--out", old], ["fleet", "run", new]),
            ("status", ["fleet", "status", old], ["fleet", "status", new]),
            ("status --json", ["fleet", "status", old, "--json"], ["fleet", "status", new, "--json"]),
        ):
            jobs = ["--jobs", "2"] if "run" in name else []
            of_old, of_new = seconds_of([*of_manifest, *jobs], earlier), seconds_of([*of_cells, *jobs], here)
            for clock, old_seconds, new_seconds in zip(("", " (CPU)"), of_old, of_new, strict=True):
                ratios.setdefault(f"{name}{clock}", []).append(new_seconds / old_seconds)
                print(f"{name}{clock}: manifest {old_seconds:.1f} s, cells {new_seconds:.1f} s", flush=True)
    for name, found in ratios.items():
        print(f"{robots} robots, {name}: cells take {np.median(found):.2f} times as long, of {sorted(found)}")


def engines(robots: int) -> None:
    """Compare two processes with two workers of Ray."""
    seconds, most = timed("processes", "--jobs", "2")
    print(f"{robots} robots, 2 processes: {seconds:.1f} s, {most:.2f} GB", flush=True)
    on_ray, most = timed("ray", "--jobs", "2", "--engine", "ray")
    print(
        f"{robots} robots, Ray with 2 workers: {on_ray:.1f} s ({on_ray / seconds:.2f} times), {most:.2f} GB"
    )
    same = results("processes") == results("ray")
    print(f"results are {'identical to the bit' if same else 'different'}", flush=True)


def kills(robots: int, count: int) -> None:
    """Kill runs at random moments, and compare the final result with that of a single run."""
    seconds, _ = timed("whole", "--jobs", "2")
    rng, killed = np.random.default_rng(0), 0
    for _ in range(count):
        process = subprocess.Popen(command("killed", "--jobs", "2"), stdout=subprocess.DEVNULL)
        time.sleep(float(rng.uniform(0.1, 0.6)) * min(seconds, 20.0))
        process.kill()
        killed += process.wait() == -signal.SIGKILL
    timed("killed", "--jobs", "2")
    same = results("whole") == results("killed")
    left = [path.name for path in Path("killed").rglob(".*") if path.is_file()]
    print(
        f"{robots} robots, killed {killed} times: {'identical to the bit' if same else 'different'}, {left} left"
    )


def main() -> None:
    """Run the requested parts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", help="Parts to run: engines, kills (default: both), before.")
    parser.add_argument("--before", type=Path, help="Checkout of an earlier version with manifests.")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--robots", type=int, default=200)
    parser.add_argument("--poses", type=int, default=100, help="Number of poses per robot.")
    parser.add_argument("--model", default="hybrid", choices=("hybrid", "geometric"))
    parser.add_argument("--kills", type=int, default=20)
    wanted = parser.parse_args()
    parts = wanted.parts or ["engines", "kills"]
    earlier = wanted.before and wanted.before.resolve()
    with TemporaryDirectory() as folder:
        write_fleet(Path(folder), wanted.robots, wanted.poses, wanted.model)
        if "engines" in parts:
            engines(wanted.robots)
        if "kills" in parts:
            kills(wanted.robots, wanted.kills)
        if "before" in parts:
            before(wanted.robots, earlier, wanted.repeats)
        os.chdir("/")


if __name__ == "__main__":
    main()
