"""Check the rows of a growing file as they arrive, and update the accuracy in another process."""

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from pisigma.deployment.export.programs.languages import LANGUAGES, check_program
from pisigma.files.output_file import check_output
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.growing_file import FileGrowth, GrowingFile
from pisigma.planning.plan_file import YAML_SUFFIX, yaml_of
from pisigma.planning.session.state import Alarm, SessionStep
from pisigma.robot.description import Robot
from pisigma.workflow.measure import MeasuringSession

_REST_SUFFIX = ".rest.csv"
"""Suffix of the remaining plan; that of `poses.csv` is written to `poses.rest.csv`."""
PAUSE = 0.01
"""Time between two reads of the file [s]."""


def follow(
    session: MeasuringSession,
    file: GrowingFile,
    once: bool = False,
    before_read: Callable[[], None] = lambda: None,
    on_new_rows: Callable[[Measurements], None] = lambda rows: None,
) -> Iterator[SessionStep]:
    """Check the rows of a growing file until the session ends.

    Args:
        session: the session.
        file: the growing file.
        once: whether to check only the existing rows and then end.
        before_read: called before every read of the file; an exception that it raises ends the session.
        on_new_rows: called with new rows before they are checked, because a check takes longer the more rows there are.

    Yields:
        A step at the start and whenever there are new rows, a new accuracy, or a file to wait for.

    Raises:
        MeasurementError: the file cannot be used.
    """
    if once:
        growth = file.read(is_complete=True)
        alarms = session.add(growth.rows, growth.left_out)
        alarms += session.update()
        yield SessionStep(growth, alarms, session.state, session.state.reached_accuracy, session.replanned)
        return
    waiting, plan, state, ending = "", session.plan, session.state, False
    work: Future[tuple[Alarm, ...]] | None = None
    yield SessionStep(FileGrowth(), (), state)
    with ThreadPoolExecutor(1) as pool, session.in_background():
        while True:
            before_read()
            growth = file.read()
            if growth.rows is not None:
                on_new_rows(growth.rows)
            alarms = session.add(growth.rows, growth.left_out)
            worked = work is not None and work.done()
            if work is not None and worked:
                alarms += work.result()
                work = None
            if worked or growth.has_changes or growth.missing_part != waiting:
                waiting, before, state = growth.missing_part, state, session.state
                new = tuple(
                    point
                    for point in state.reached_accuracy
                    if all(point is not one for one in before.reached_accuracy)
                )
                yield SessionStep(growth, alarms, state, new, session.plan is not plan)
                plan = session.plan
            if work is None and ending:
                return
            if work is None:
                urgent = session.next_step()
                ending = state.is_finished and urgent is None
                step = urgent or session.idle_step()
                work = None if step is None else pool.submit(step)
            time.sleep(PAUSE)


def check_programs(programs: Sequence[Path], robot: Robot, inputs: Sequence[Path]) -> None:
    """Check that programs of the remaining poses can be written.

    Raises:
        OutputError: a file's suffix is not that of a known language, a file is an input, or it cannot be written.
    """
    for program in programs:
        check_output(program, tuple(LANGUAGES), "a program", inputs)
        check_program(program, robot, False, None)


def remaining_poses_file(plan: Path, rows: Path, requested_path: Path | None) -> Path:
    """Return the file for the remaining poses.

    Args:
        plan: CSV or YAML file of the plan.
        rows: the growing file of measurements.
        requested_path: file for the remaining poses; None for a file next to the plan.

    Raises:
        OutputError: the file cannot be written.
    """
    poses = plan.with_name(plan.name.removesuffix(YAML_SUFFIX).removesuffix(".csv") + ".csv")
    rest = requested_path or poses.with_suffix(_REST_SUFFIX)
    check_output(rest, (".csv",), "a plan", (poses, rows))
    check_output(yaml_of(rest), inputs=(yaml_of(poses),))
    return rest
