"""Kill commands that write at random moments, like a power cut, and check that nothing is lost.

`python tests/hostile/kills.py --count 50 [--seed 0]`
"""

import argparse
import hashlib
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.append(str(Path(__file__).parents[2] / "training" / "papers"))

import numpy as np
from testing.models import small_recipe_text
from testing.simulated_arm import simulate

from pisigma.model.folder.model_folder import load_model

_QUICK = ("--model", "geometric", "--folds", "0")
COMMANDS = {
    "calibrate": ("calibrate", "ur5", "rows.csv", "--out", "model", "--overwrite", *_QUICK),
    "train": ("train", "recipe.yaml", "--out", "trained", "--overwrite"),
    "dh table": ("export", "model", "--format", "dh", "--out", "dh.csv"),
    "onnx": ("export", "trained", "--format", "onnx", "--out", "arm.onnx"),
    "simulate": ("simulate", "recipe.yaml", "--out", "simulated.csv"),
    "report": ("report", "model", "rows.csv", "--out", "report.html", "--figures", "figures"),
}
"""Commands that replace existing outputs."""
_FOLDERS = {"calibrate": "model", "train": "trained"}


def start(command: tuple[str, ...], folder: Path) -> subprocess.Popen[bytes]:
    """Start a command in a folder, as a separate process."""
    program = [sys.executable, "-m", "pisigma", *command]
    quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen(program, cwd=folder, **quiet)


def write_inputs(folder: Path) -> None:
    """Write all inputs of the commands, and all outputs once."""
    arm = simulate("ur5", rows=40, noise=5e-5)
    arm.measurements.write_csv(folder / "rows.csv", arm.nominal)
    (folder / "recipe.yaml").write_text(small_recipe_text("kiro3"), encoding="utf-8")
    (folder / "mine.txt").write_text("mine", encoding="utf-8")


def contents(folder: Path) -> dict[str, str]:
    """Return the hash of every file below a folder."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def after_kill(name: str, before: dict[str, str], folder: Path) -> str:
    """Return what was lost, or is neither the old nor a whole new output; "" for nothing."""
    now, output = contents(folder), _FOLDERS.get(name, "")
    if changed := [path for path in _INPUTS if now.get(path) != before[path]]:
        return f"{changed[0]} was changed"
    if output and not (folder / output).is_dir():
        kept = list(folder.glob(f".{output}.*.old/model"))
        return "" if kept and load_model(kept[0]) else f"{output} is gone"
    if output:
        load_model(folder / output)
    return ""


_INPUTS = ("rows.csv", "recipe.yaml", "mine.txt")


def main() -> None:
    """Kill every command, one after the other, and let it finish after every kill."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    wanted = parser.parse_args()
    rng, bad, killed = np.random.default_rng(wanted.seed), [], Counter[str]()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_inputs(folder)
        seconds = {}
        for name, command in COMMANDS.items():
            started = time.monotonic()
            assert start(command, folder).wait() == 0, f"{name} does not run"
            seconds[name] = time.monotonic() - started
        before, names = contents(folder), list(COMMANDS)
        for number in range(wanted.count):
            name = names[number % len(names)]
            process = start(COMMANDS[name], folder)
            time.sleep(seconds[name] * float(rng.uniform(0.3, 1.1)))
            process.kill()
            killed[name] += process.wait() == -signal.SIGKILL
            if fault := after_kill(name, before, folder):
                bad.append(f"{name}, kill {number}: {fault}")
        for name, command in COMMANDS.items():
            if start(command, folder).wait():
                bad.append(f"{name} does not run again")
        bad += [f"{path} was left" for path in contents(folder) if path not in before]
    print("\n".join(bad))
    print(f"{sum(killed.values())} of {wanted.count} killed ({dict(killed)}), {len(bad)} faults.")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
