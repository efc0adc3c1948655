"""All mistakes of the table through every command: `python tests/gate/run.py mistakes`."""

import tempfile
import time
from pathlib import Path

from gate.agreement import disagreements
from gate.commands import COMMANDS
from gate.table import MISTAKES, Mistake


def main() -> int:
    """Print which commands disagree without a reason in the table, and return how many do."""
    failures = excused = 0
    with tempfile.TemporaryDirectory() as folder:
        for mistake in (Mistake("none", lambda rows: rows, ()), *MISTAKES):
            start = time.perf_counter()
            found = disagreements(mistake, Path(folder))
            failures, excused = failures + len(found), excused + len(mistake.unnoticed)
            seconds = time.perf_counter() - start
            print(f"{'MISS' if found else 'ok  '} {seconds:5.1f} s  {mistake.name}", flush=True)
            for line in found:
                print(f"       {line}")
            for command, reason in mistake.unnoticed.items():
                print(f"       {command} need not notice: {reason}")
    count = (1 + len(MISTAKES)) * len(COMMANDS)
    print(f"{count - failures} of {count} answers agree; {excused} are excused by the table.")
    return failures
