"""The result of a hostile input, and whether it is allowed."""

import hashlib
import os
import re
import resource
import signal
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import FrameType
from unittest.mock import patch

import torch
from click.testing import CliRunner
from hostile.case import Case
from hostile.clean import CleanRows
from testing.models import no_type_checker
from typer.main import get_command

from pisigma.calibration.geometric.initial_guess.base_and_tool import fit_base_and_tool
from pisigma.cli import progress
from pisigma.cli.main import app
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.workflow.calibrate import Calibration

COMMAND = get_command(app)
"""Created once, as it takes as long as most of the cases."""
LONGEST = 10.0
"""Maximum computing time of a command [s]."""
WAITS = 4
"""Factor on the maximum time where other processes compute as well."""
MOST_MAPPED = 2**31
"""Additional memory of a command [bytes]."""
LONGEST_SENTENCE = 2100
WORSE = 1.05
"""Factor by which a model may be worse than nominal, due to noise in few rows."""
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


class Ending(Enum):
    """How a command ended."""

    RIGHT = "accepted and right"
    REFUSED = "refused (2)"
    NOT_TRUSTED = "not trusted (3)"
    FALSE_ALARM = "healthy, but refused or not trusted"
    INACCURATE = "accepted and inaccurate"
    GARBLED = "refused with a garbled message"
    LOST = "an input was changed, or something left of a refused output"
    HANG = "took over 10 s"
    MEMORY = "took over 1 GB"
    DEFECT = "traceback or exit status 1"

    @property
    def allowed(self) -> bool:
        """Whether a hostile input may end like this."""
        return self in (Ending.RIGHT, Ending.REFUSED, Ending.NOT_TRUSTED)


@dataclass(frozen=True)
class Outcome:
    """How a command ended, and its output.

    Attributes:
        ending: the class.
        said: the error message, the traceback or the figures.
    """

    ending: Ending
    said: str = ""


class _TooLong(BaseException):
    """A command took too long; error handlers must not catch it."""


def attempt(case: Case, folder: Path) -> Outcome:
    """Run the command of a case in its folder, in this process, and classify its result.

    A calibration is written without its card and figures, which take a second.
    """
    calibrations: list[Calibration] = []

    def keep(calibration: Calibration, *_: object, **__: object) -> None:
        calibrations.append(calibration)

    before = _contents(folder)
    try:
        with (
            _inside(folder),
            _at_most(LONGEST),
            no_type_checker(),
            patch.object(Calibration, "_describe", keep),
            patch.object(progress, "QUIET_S", 1e9),
        ):
            result = CliRunner().invoke(COMMAND, list(case.arguments))
    except _TooLong:
        return Outcome(Ending.HANG)
    problem = result.exception
    if problem is not None and not isinstance(problem, SystemExit):
        return Outcome(Ending.DEFECT, "".join(traceback.format_exception(problem)))
    if result.exit_code not in (0, 2, 3):
        return Outcome(Ending.DEFECT, f"exit status {result.exit_code}: {result.output}")
    if changed := _lost(before, _contents(folder), case, result.exit_code):
        return Outcome(Ending.LOST, f"{changed}: {result.output}")
    if fault := _garbled(result.stdout, result.stderr, result.exit_code):
        return Outcome(Ending.GARBLED, f"{fault}: {result.output[:LONGEST_SENTENCE]!r}")
    if result.exit_code:
        ending = Ending.REFUSED if result.exit_code == 2 else Ending.NOT_TRUSTED
        return Outcome(Ending.FALSE_ALARM if case.healthy else ending, result.stderr)
    if case.check is not None and (wrong := case.check(folder)):
        return Outcome(Ending.INACCURATE, wrong)
    return _accuracy(case.truth, calibrations[0]) if calibrations and case.truth else Outcome(Ending.RIGHT)


def _accuracy(rows: CleanRows, calibration: Calibration) -> Outcome:
    """Compare the identified arm with the nominal one, with base and tool of both fitted to the same clean rows."""
    identified = calibration.model.calibrated
    if rows.other is None or identified is None or identified.dof != rows.other.dof:
        return Outcome(Ending.RIGHT)
    model, nominal = (arm_error(robot, rows.other) for robot in (identified, rows.nominal))
    said = f"{model * 1e3:.3f} mm on clean rows, nominal {nominal * 1e3:.3f} mm"
    return Outcome(Ending.INACCURATE if not model <= WORSE * nominal else Ending.RIGHT, said)


def arm_error(robot: Robot, rows: Measurements) -> float:
    """Return the RMS position error [m] of an arm whose base and tool are fitted to the rows."""
    positions = rows if rows.rotation is None else Measurements(q=rows.q, position=rows.position)
    with no_type_checker(), torch.no_grad():
        return fit_base_and_tool(robot, positions).rms_position


@contextmanager
def _inside(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


@contextmanager
def _at_most(seconds: float) -> Iterator[None]:
    """Limit time and memory, so that the machine stays usable."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise _TooLong

    clocks = {
        signal.ITIMER_PROF: (signal.SIGPROF, seconds),
        signal.ITIMER_REAL: (signal.SIGALRM, WAITS * seconds),
    }
    usual = {number: signal.signal(number, stop) for number, _ in clocks.values()}
    memory = resource.getrlimit(resource.RLIMIT_AS)
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + MOST_MAPPED, memory[1]))
    for clock, (_, after) in clocks.items():
        signal.setitimer(clock, after)
    try:
        yield
    finally:
        for clock in clocks:
            signal.setitimer(clock, 0)
        resource.setrlimit(resource.RLIMIT_AS, memory)
        for number, handler in usual.items():
            signal.signal(number, handler)


def _contents(folder: Path) -> dict[str, str]:
    """Return every file below a folder with the hash of its content; large and special files with their size."""
    contents = {}
    for path in sorted(folder.rglob("*")):
        plain = path.is_file() and path.stat().st_size < 2**26
        contents[str(path.relative_to(folder))] = (
            hashlib.sha256(path.read_bytes()).hexdigest() if plain else f"{path.lstat().st_mode}"
        )
    return contents


def _lost(before: dict[str, str], after: dict[str, str], case: Case, status: int) -> str:
    """Return the first file that was changed, or that a refused command left behind; "" for none."""
    for path, content in before.items():
        if after.get(path) != content:
            return path
    new = sorted(set(after) - set(before))
    left = next((path for path in new if path.endswith((".part", ".partial"))), "")
    wrote_rows = case.arguments[0] in ("ik", "export")  # a file with a status per row is written all the same
    return left or (new[0] if new and status == 2 and not wrote_rows else "")


def _garbled(stdout: str, stderr: str, status: int) -> str:
    """Return a fault of the output of a command; "" for none."""
    if odd := _CONTROL.search(stdout + stderr):
        return f"the control character {odd[0]!r}"
    if "Traceback" in stderr:
        return "a traceback"
    if status == 0 or stderr.startswith("Usage:"):
        return ""
    lines = [line for line in stderr.splitlines() if line.startswith("pisigma: ")]
    if not lines or len(stderr.strip().splitlines()) != len(lines):
        return "no line that begins with 'pisigma: ', or other lines"
    longest = max(map(len, lines))
    return f"a sentence of {longest} characters" if longest > LONGEST_SENTENCE else ""
