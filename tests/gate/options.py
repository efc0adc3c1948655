"""Every option of every command, run for real: the calls of `options.txt`, in their order, in one folder."""

import hashlib
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from dataclasses import dataclass
from pathlib import Path

from click.testing import CliRunner
from typer.main import get_command

from pisigma.cli.main import app

TABLE = Path(__file__).with_suffix(".txt")
COMMAND = (sys.executable, "-m", "pisigma")
HASH_OF = "SHA256:"
"""Prefix of a file in a call, which is replaced by the hash of the file."""
LONGEST_S = 60.0
"""Time for a server to end [s]."""


@dataclass(frozen=True)
class Call:
    """A line of the table.

    Attributes:
        line: number of the line.
        status: expected exit status.
        words: arguments of `pisigma`.
    """

    line: int
    status: int
    words: tuple[str, ...]


def calls() -> list[Call]:
    """Read the table: one line `pisigma ...` per call, after its exit status where that is not 0."""
    found = []
    for number, line in enumerate(TABLE.read_text(encoding="utf-8").splitlines(), 1):
        if match := re.fullmatch(r"(?:\[(\d)\] )?pisigma (.+)", line):
            found.append(Call(number, int(match[1] or 0), tuple(shlex.split(match[2]))))
        else:
            assert not line or line.startswith("#"), (
                f"{TABLE.name}, line {number}: expected a call, got {line}"
            )
    return found


def run_call(call: Call) -> tuple[int, str]:
    """Run a call in this folder, and return exit status and output; servers are stopped as soon as they are ready."""
    if call.words[0] in ("serve", "open"):
        return _served(call)
    words = [_hash(word) if word.startswith(HASH_OF) else word for word in call.words]
    if "--plugin" in words:  # what it registers is known to its process
        done = subprocess.run([*COMMAND, *words], capture_output=True, text=True, check=False)
        return done.returncode, done.stdout + done.stderr
    result = CliRunner().invoke(get_command(app), words)
    printed = result.stdout + result.stderr
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        printed += "".join(traceback.format_exception(result.exception))
        return 1, printed
    return result.exit_code, printed


def _hash(word: str) -> str:
    return hashlib.sha256(Path(word.removeprefix(HASH_OF)).read_bytes()).hexdigest()


def _served(call: Call) -> tuple[int, str]:
    command = [*COMMAND, *call.words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as server:
        assert server.stdout is not None
        ready = server.stdout.readline()
        server.send_signal(signal.SIGTERM)
        rest, _ = server.communicate(timeout=LONGEST_S)
        return server.returncode, ready + rest


def main() -> int:
    """Run all calls, print those with an unexpected status and return their number."""
    from gate.option_inputs import prepare

    failed, before = 0, Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        prepare(Path(folder))
        os.chdir(folder)
        try:
            for call in calls():
                begun = time.perf_counter()
                status, printed = run_call(call)
                right = status == call.status
                failed += not right
                sign = "ok" if right else "FAILED"
                print(
                    f"{sign} {time.perf_counter() - begun:5.1f} s, status {status}: pisigma {shlex.join(call.words)}",
                    flush=True,
                )
                if not right:
                    print(
                        f"  expected {call.status} (options.txt, line {call.line})\n{printed[-2000:]}",
                        flush=True,
                    )
        finally:
            os.chdir(before)
    return failed
