"""Time of a cross-validated hybrid of the UR10 with `--jobs 1` and `--jobs 2`, which give the same figures.

Run `OMP_NUM_THREADS=1 python benchmarks/cross_validation_jobs.py` with the public data sets in `PISIGMA_DATA`.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

ROWS = Path(os.environ.get("PISIGMA_DATA", "../shared/data")) / "ur10" / "series_c_train.csv"


def timed(out: Path, jobs: int) -> tuple[float, float]:
    """Return the durations of calibration and cross-validation, and of the whole command [s]."""
    command = [sys.executable, "-m", "pisigma", "calibrate", "ur10", str(ROWS), "--out", str(out)]
    started = time.monotonic()
    done = subprocess.run([*command, "--jobs", str(jobs), "--json"], capture_output=True, check=True)
    return float(json.loads(done.stdout)["seconds"]), time.monotonic() - started


def main() -> None:
    """Print both times, their ratios, and whether models and held-out errors are identical to the bit."""
    with TemporaryDirectory() as folder:
        outs = [Path(folder) / name for name in ("one", "two")]
        one, two = (timed(out, jobs) for jobs, out in enumerate(outs, 1))
        for what, before, after in zip(("calibration and folds", "the whole command"), one, two, strict=True):
            print(
                f"{what}: {before:.1f} s with one process, {after:.1f} s with two ({before / after:.2f} times)"
            )
        for name in ("model.safetensors", "held_out.csv"):
            same = (outs[0] / name).read_bytes() == (outs[1] / name).read_bytes()
            print(f"{name}: {'identical to the bit' if same else 'different'}")


if __name__ == "__main__":
    main()
