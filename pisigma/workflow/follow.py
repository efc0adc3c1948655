"""Follow a file of measurements while it grows: rows are judged at once, the accuracy is worked out beside."""

import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from pisigma.files.output_file import check_output
from pisigma.measurement.growing_file import GrowingFile, Growth
from pisigma.measuring.state import Alarm, SessionState
from pisigma.planning.plan_file import YAML_SUFFIX, yaml_of
from pisigma.workflow.measure import MeasuringSession

REST_SUFFIX = ".rest.csv"
"""What is left of the plan `poses.csv` is written to `poses.rest.csv`."""
PAUSE = 0.2
"""[s] Between two looks at the file."""


@dataclass(frozen=True, eq=False)
class SessionStep:
    """What is new in a session.

    Attributes:
        growth: what came to the file.
        alarms: what is wrong with that, or with earlier rows in its light.
        state: of the session.
        replanned: whether other poses are left than those that are planned, or that were left before.
    """

    growth: Growth
    alarms: tuple[Alarm, ...]
    state: SessionState
    replanned: bool = False


def follow(session: MeasuringSession, file: GrowingFile, once: bool = False) -> Iterator[SessionStep]:
    """Judge what comes to a file, until the session ends.

    Args:
        session: the session.
        file: the rows.
        once: whether to judge what is there, and end.

    Yields:
        A step for everything that is new: rows, a file that is waited for, or the accuracy; the first at once.

    Raises:
        MeasurementError: the file cannot be used.
    """
    if once:
        growth = file.read(final=True)
        alarms = session.add(growth.rows, growth.left_out)
        session.work_out()
        yield SessionStep(growth, alarms, session.state, session.replanned)
        return
    waiting = ""
    work: Future[None] | None = None
    yield SessionStep(Growth(), (), session.state)
    with ThreadPoolExecutor(1) as pool:
        while True:
            growth = file.read()
            alarms = session.add(growth.rows, growth.left_out)
            worked = work is not None and work.done()
            if work is not None and worked:
                work.result()
                work = None
            if work is None and session.is_due:
                work = pool.submit(session.work_out)
            if worked or growth.is_news or growth.waiting != waiting:
                waiting = growth.waiting
                state = session.state
                yield SessionStep(growth, alarms, state, worked and session.replanned)
                if state.finished and work is None:
                    return
            time.sleep(PAUSE)


def rest_file(plan: Path, rows: Path, stated: Path | None) -> Path:
    """Where the poses that are left are written.

    Args:
        plan: the plan, by its CSV or the YAML beside it.
        rows: the file that is followed.
        stated: another place; None for beside the plan.

    Raises:
        OutputError: they cannot be written there.
    """
    poses = plan.with_name(plan.name.removesuffix(YAML_SUFFIX).removesuffix(".csv") + ".csv")
    rest = stated or poses.with_suffix(REST_SUFFIX)
    check_output(rest, (".csv",), "a plan", (poses, rows))
    check_output(yaml_of(rest), inputs=(yaml_of(poses),))
    return rest
