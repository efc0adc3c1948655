"""Follow a file of measurements while it grows: rows are judged at once, the accuracy is worked out beside."""

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from pisigma.deployment.export.programs.languages import LANGUAGES, check_program
from pisigma.files.output_file import check_output
from pisigma.measurement.growing_file import GrowingFile, Growth
from pisigma.planning.plan_file import YAML_SUFFIX, yaml_of
from pisigma.planning.session.state import AccuracyPoint, Alarm, SessionState
from pisigma.robot.description import Robot
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
        points: accuracies that were worked out since.
        replanned: whether other poses are left than those that are planned, or that were left before.
    """

    growth: Growth
    alarms: tuple[Alarm, ...]
    state: SessionState
    points: tuple[AccuracyPoint, ...] = ()
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
        alarms += session.work_out()
        yield SessionStep(growth, alarms, session.state, session.state.reached, session.replanned)
        return
    waiting, plan, state, ending = "", session.plan, session.state, False
    work: Future[tuple[Alarm, ...]] | None = None
    yield SessionStep(Growth(), (), state)
    with ThreadPoolExecutor(1) as pool:
        while True:
            growth = file.read()
            alarms = session.add(growth.rows, growth.left_out)
            worked = work is not None and work.done()
            if work is not None and worked:
                alarms += work.result()
                work = None
            if worked or growth.is_news or growth.waiting != waiting:
                waiting, before, state = growth.waiting, state, session.state
                new = tuple(
                    point for point in state.reached if all(point is not one for one in before.reached)
                )
                yield SessionStep(growth, alarms, state, new, session.plan is not plan)
                plan = session.plan
            if work is None and ending:
                return
            if work is None:
                urgent = session.next_step()
                ending = state.finished and urgent is None
                step = urgent or session.idle_step()
                work = None if step is None else pool.submit(step)
            time.sleep(PAUSE)


def check_programs(programs: Sequence[Path], robot: Robot, inputs: Sequence[Path]) -> None:
    """Make sure that programs of the poses that are left can be written.

    Raises:
        OutputError: a file is no program of a language that is known, is an input, or cannot be written.
    """
    for program in programs:
        check_output(program, tuple(LANGUAGES), "a program", inputs)
        check_program(program, robot, False, None)


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
