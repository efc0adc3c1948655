"""Run Python programs as separate processes that need not import pisigma again, which takes most of their time."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

PAPERS = Path(__file__).parents[2] / "training" / "papers"
SERVER = """
import json, os, runpy, sys, traceback
import matplotlib.figure, pisigma, pisigma.simulation, torch
for name in pisigma.__all__:
    getattr(pisigma, name)
for line in sys.stdin:
    program, folder = json.loads(line)
    child = os.fork()
    if child:
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
        continue
    os.chdir(folder)
    for number, name in ((1, "stdout.txt"), (2, "stderr.txt")):
        os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    sys.argv, sys.path[0] = [program], os.path.dirname(program)
    status = 1
    try:
        runpy.run_path(program, run_name="__main__")
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
"""
"""Imports all public names first; programs start with `from`, so that each still names what it uses."""


@dataclass(frozen=True)
class Programs:
    """A process that starts programs."""

    server: subprocess.Popen[str]

    def run(self, program: Path, folder: Path) -> subprocess.CompletedProcess[str]:
        """Run a program within a folder, which has `stdout.txt` and `stderr.txt` afterwards."""
        assert self.server.stdin is not None
        assert self.server.stdout is not None
        self.server.stdin.write(json.dumps([str(program), str(folder)]) + "\n")
        self.server.stdin.flush()
        status = int(self.server.stdout.readline())
        output, errors = ((folder / f"{name}.txt").read_text() for name in ("stdout", "stderr"))
        return subprocess.CompletedProcess([str(program)], status, output, errors)


@contextmanager
def programs() -> Iterator[Programs]:
    """Start a process that runs programs with warnings as errors, which may import the papers' programs."""
    paths = filter(None, (str(PAPERS), os.environ.get("PYTHONPATH")))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-W", "error", "-c", SERVER]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, env=environment, text=True, **pipes) as server:
        yield Programs(server)
