"""Kill a chain of recalibrations, and the monitoring of its models, at random moments, and check that nothing is lost.

`python tests/hostile/chain_kills.py --count 50 [--seed 0]`
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from hostile.kills import contents, start
from testing.aged import original_model, rows_after_change

from pisigma.lifetime.cell.layout import history_of_model
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.model.model_posterior import ModelPosterior

SECONDS = 6.0
"""Of a command, to begin with."""


def _files(folder: Path) -> set[str]:
    """List all files below a folder, while others are created and deleted."""
    return {os.path.join(place, name) for place, _, names in os.walk(folder) for name in names}


class Chain:
    """Models link-0, link-1, ... in a folder, each recalibrated from the one before, and the sessions of each.

    Attributes:
        folder: folder of the models.
        links: number of whole models.
    """

    def __init__(self, folder: Path) -> None:
        """Write the first model."""
        self.folder, self.links = folder, 1
        (folder / "link-0").mkdir()
        save_model(original_model(), folder / "link-0")
        self._before, self._files = contents(folder), _files(folder)

    def start(self, number: int, monitor: bool) -> subprocess.Popen[bytes]:
        """Start to monitor the last model, or to recalibrate it, with new rows."""
        rows = self.folder / f"2026-01-{number % 28 + 1:02d}.csv"
        rows_after_change(10, number + 1000).write_csv(rows, original_model().robot)
        self._before, self._sessions = contents(self.folder), self.sessions()
        self._files = _files(self.folder)
        last = f"link-{self.links - 1}"
        if monitor:
            return start(("monitor", last, rows.name), self.folder)
        return start(("recalibrate", last, rows.name, "--out", f"link-{self.links}"), self.folder)

    def wait_for_writing(self, process: subprocess.Popen[bytes]) -> None:
        """Wait until the command starts to write next to the models, or ends."""
        while process.poll() is None and _files(self.folder) == self._files:
            time.sleep(0.005)

    def sessions(self) -> set[tuple[str, str]]:
        """Return the sessions in the histories of all models, by model and rows."""
        held: set[tuple[str, str]] = set()
        for number in range(self.links):
            history = history_of_model(self.folder / f"link-{number}")
            held |= {(one.model_sha256, one.rows_sha256) for one in history.monitored_sessions()}
        return held

    def fault(self) -> str:
        """Return what the last command lost or left incomplete; "" for nothing."""
        now = contents(self.folder)
        kept = (path for path in self._before if path[0] != "." and ".sqlite" not in path)
        lost = [path for path in kept if now.get(path) != self._before[path]]
        if lost or self._sessions - self.sessions():
            return f"{lost} changed, {len(self._sessions - self.sessions())} sessions are gone"
        following = self.folder / f"link-{self.links}"
        if following.exists():
            ModelPosterior.from_model(load_model(following))
            self.links += 1
        return ""


def main() -> None:
    """Kill recalibrations and monitorings alternately, at any time or while they write, and finally let each finish."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    wanted = parser.parse_args()
    rng, faults, killed, seconds = np.random.default_rng(wanted.seed), [], 0, [SECONDS, SECONDS]
    with tempfile.TemporaryDirectory() as temporary:
        chain = Chain(Path(temporary))
        for number in range(-2, wanted.count + 2):
            whole, began = not 0 <= number < wanted.count, time.monotonic()
            process = chain.start(number, bool(number % 2))
            if not whole:
                if number % 4 < 2:
                    time.sleep(seconds[number % 2] * float(rng.uniform(0.3, 1.1)))
                else:
                    chain.wait_for_writing(process)
                    time.sleep(float(rng.uniform(0.0, 0.3)))
                process.kill()
            status = process.wait()
            seconds[number % 2] = time.monotonic() - began if whole else seconds[number % 2]
            killed += status == -signal.SIGKILL
            if whole and status not in (0, 3):
                faults.append(f"command {number} ends with {status}")
            if fault := chain.fault():
                faults.append(f"command {number}: {fault}")
        faults += [f"{path} was left" for path in contents(chain.folder) if path.startswith(".")]
        print(f"{chain.links} models, {len(chain.sessions())} sessions.")
    print("\n".join(faults))
    print(f"{killed} of {wanted.count} killed, {len(faults)} faults.")
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
