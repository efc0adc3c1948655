"""Kill commands of one cell at random moments, and see that nothing is lost and that its status is right afterwards.

`python tests/hostile/cell_kills.py --count 200 [--seed 0]`
"""

import argparse
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from hostile.kills import contents, start
from testing.cell_rows import ROBOT, day, measured

from pisigma.lifetime.cell.history import HISTORY
from pisigma.model.folder.model_folder import load_model
from pisigma.workflow.cell.cell import Cell

LONGER = 1.1
"""Factor on the time of a command that was killed, so that some end before they are killed on a busy machine."""
COMMANDS = ("import", "monitor", "recalibrate", "import", "verify", "calibrate", "use", "event", "plan")


class KilledCell:
    """A cell with a model in use whose commands are killed.

    Attributes:
        folder: that the cell and the files of rows are in.
        cell: the cell.
    """

    def __init__(self, folder: Path) -> None:
        """Calibrate and verify a first model."""
        self.folder, self.cell = folder, Cell.create(folder / "cell", "ur10", limit_mm=0.5)
        self.cell.add_session(measured(60, 1), day=day(90))
        self.cell.calibrate(folds=0)
        self.cell.add_session(measured(12, 2), day=day(80))
        self.cell.verify()
        self._before, self._entries = self.files(), self.entries()

    def start(self, number: int) -> subprocess.Popen[bytes]:
        """Start a command, with rows of its own where it takes some in."""
        name = COMMANDS[number % len(COMMANDS)]
        words: tuple[str, ...] = (name, "cell")
        if name == "import":
            rows = self.folder / f"rows {number}.csv"
            measured(12, 1000 + number).write_csv(rows, ROBOT)
            words = ("import", rows.name, "--cell", "cell", "--date", day(max(1, 70 - number)))
        elif name == "calibrate":
            words += ("--folds", "0")
        elif name == "use":
            words += (self.cell.history.models()[0].name,)
        elif name == "event":
            words += ("firmware",)
        elif name == "plan":
            words += ("--count", "5", "--check", "0", "--set", "candidates=100")
        self._before, self._entries = self.files(), self.entries()
        return start(words, self.folder)

    def files(self) -> dict[str, bytes]:
        """Contents of sessions, plans and models, without scratch files."""
        parts = ("sessions/", "plans/", "models/", "cell.yaml")
        held = contents(self.cell.folder)
        return {
            path: content
            for path, content in held.items()
            if path.startswith(parts) and "/." not in path and ".sqlite" not in path
        }

    def entries(self) -> set[tuple[str, ...]]:
        """All rows of all tables of the history."""
        with closing(sqlite3.connect(self.cell.folder / HISTORY)) as database:
            assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
            tables = [
                name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
            ]
            return {
                (table, *map(str, row))
                for table in tables
                for row in database.execute(f"SELECT * FROM {table}")
            }

    def fault(self) -> str:
        """What the last command lost or left in pieces; "" where all is well."""
        now = self.files()
        lost = [path for path, content in self._before.items() if now.get(path) != content]
        gone = self._entries - self.entries()
        if lost or gone:
            return f"{lost} changed, {gone} are gone"
        opened = Cell.open(self.cell.folder)
        status = opened.status()
        if status.facts.edited_sessions:
            return f"sessions {status.facts.edited_sessions} differ from what was added"
        for one in opened.history.models():
            load_model(opened.model_folder(one.name))
        return "" if opened.model is not None else "no model is in use any more"


def main() -> None:
    """Run each command once, kill the commands one after the other at random times, and finally run each to its end."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    wanted = parser.parse_args()
    rng, faults, killed = np.random.default_rng(wanted.seed), list[str](), 0
    seconds: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as temporary:
        target = KilledCell(Path(temporary))
        for number in range(wanted.count + 2 * len(COMMANDS)):
            name = COMMANDS[number % len(COMMANDS)]
            whole = not len(COMMANDS) <= number < wanted.count + len(COMMANDS)
            began, process = time.monotonic(), target.start(number)
            if not whole:
                time.sleep(seconds[name] * float(rng.uniform(0.2, 1.2)))
                process.kill()
                seconds[name] *= LONGER
            status = process.wait()
            if status != -signal.SIGKILL:
                seconds[name] = time.monotonic() - began
            killed += status == -signal.SIGKILL
            if whole and status not in (0, 2, 3):  # 2 where no session is new to the model
                faults.append(f"{name} ends with {status}")
                print(faults[-1], flush=True)
            if fault := target.fault():
                faults.append(f"command {number} ({name}): {fault}")
                print(faults[-1], flush=True)
            if number % 20 == 19:
                print(
                    f"{killed} of {number + 1 - len(COMMANDS)} killed, {len(faults)} faults",
                    file=sys.stderr,
                    flush=True,
                )
        print(f"{len(target.cell.history.models())} models, {len(target.cell.history.sessions())} sessions.")
    print(f"{killed} of {wanted.count} killed, {len(faults)} faults.")
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
