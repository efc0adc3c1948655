"""Run many hostile inputs, each in a separate process with limited time and memory, and print the results.

`python tests/hostile/run.py --count 4000 [--seed 1] [--kind "wrong measurements"] [--number 17]`, or `--mistakes`
"""

import argparse
import os
import pickle
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.append(str(Path(__file__).parents[2] / "training" / "papers"))

from hostile import mistakes
from hostile.clean import Clean, write_clean
from hostile.kinds import KINDS, make, shares
from hostile.outcome import LONGEST, WAITS, Ending, Outcome, attempt

MOST_MEMORY = 10**9
"""Maximum memory of a process [bytes], of which the imported packages use 400 MB."""


def bounded(kind: str, seed: int, number: int, clean: Clean, folder: Path) -> tuple[str, Outcome]:
    """Run one hostile input in a separate process, and return its description and result."""
    folder.mkdir()
    answer = folder.with_suffix(".answer")
    child = os.fork()
    if child == 0:
        _answer(kind, seed, number, clean, folder, answer)
    usage = _wait(child, time.monotonic() + 2 * WAITS * LONGEST)
    case_and_outcome: tuple[str, Outcome] = (
        pickle.loads(answer.read_bytes())
        if answer.is_file()
        else ("", Outcome(Ending.HANG, "the process had to be ended"))
    )
    if usage > MOST_MEMORY:
        return case_and_outcome[0], Outcome(Ending.MEMORY, f"{usage / 1e9:.2f} GB")
    return case_and_outcome


def _answer(kind: str, seed: int, number: int, clean: Clean, folder: Path, answer: Path) -> None:
    """Write the result into a file, and end this process."""
    try:
        os.environ["PISIGMA_TRACEBACK"] = "1"
        sys.stdin = open(os.devnull)  # noqa: SIM115
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        case = make(kind, seed, number, clean, folder)
        answer.write_bytes(pickle.dumps((case.what, attempt(case, folder))))
    except BaseException as problem:
        answer.write_bytes(pickle.dumps(("", Outcome(Ending.DEFECT, repr(problem)))))
    finally:
        os._exit(0)


def _wait(child: int, until: float) -> int:
    """Wait for a process, or end it, and return its peak memory [bytes]."""
    while True:
        done, _, usage = os.wait4(child, os.WNOHANG)
        if done:
            return usage.ru_maxrss * 1024
        if time.monotonic() > until:
            os.kill(child, signal.SIGKILL)
            os.wait4(child, 0)
            return 0
        time.sleep(0.002)


def main() -> None:
    """Run the inputs, print a table, and how to repeat each failure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", choices=sorted(KINDS))
    parser.add_argument("--number", type=int, help="run this one only, and print all that it said")
    parser.add_argument("--mistakes", action="store_true", help="make the 60 realistic mistakes instead")
    wanted = parser.parse_args()
    if wanted.mistakes:
        sys.exit(mistakes.main([]))
    kinds = (wanted.kind,) if wanted.kind else tuple(KINDS)
    table: dict[str, Counter[Ending]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        (folder := Path(temporary) / "clean").mkdir()
        clean = write_clean(folder)
        for index, (kind, count) in enumerate(shares(wanted.count, kinds).items()):
            table[kind] = Counter()
            numbers = range(count) if wanted.number is None else (wanted.number,)
            for number in numbers:
                what, outcome = bounded(
                    kind, wanted.seed, number, clean, Path(temporary) / f"{index}_{number}"
                )
                table[kind][outcome.ending] += 1
                if not outcome.ending.allowed or wanted.number is not None:
                    said = outcome.said if wanted.number is not None else outcome.said.strip()[-150:]
                    again = (
                        f'python tests/hostile/run.py --kind "{kind}" --seed {wanted.seed} --number {number}'
                    )
                    print(f"{outcome.ending.value}: {what[:100]!r}\n    {again}\n    {said!r}", flush=True)
    for kind, endings in table.items():
        print(f"{kind:24}", ", ".join(f"{endings[e]} {e.value}" for e in Ending if endings[e]))
    bad = sum(count for endings in table.values() for e, count in endings.items() if not e.allowed)
    print(f"{sum(map(Counter.total, table.values()))} hostile inputs, {bad} that must not end so.")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
