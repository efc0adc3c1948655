"""`pisigma measure`: check rows as they are measured according to a plan, and recommend the next pose."""

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson
from pisigma.cli.cell import settings_at
from pisigma.cli.endings import NOT_ACCEPTED
from pisigma.cli.output import print_json, print_line
from pisigma.cli.screen import print_result
from pisigma.cli.settings_options import StatedSettings, takes_settings
from pisigma.files.setting import Option
from pisigma.workflow.settings.measuring import MeasureSettings

if TYPE_CHECKING:
    from pisigma.planning.plan_settings import CameraSettings
    from pisigma.planning.session.state import SessionState, SessionStep
    from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
    from pisigma.robot.description import Robot
    from pisigma.workbench.viewing.body import MeshBody
    from pisigma.workflow.measure import MeasuringSession

PlanFile = Annotated[
    Path,
    typer.Argument(
        metavar="PLAN|CELL",
        help="Plan written by `pisigma plan` (.csv or .plan.yaml), or a cell, whose newest plan is used.",
    ),
]
RowsFile = Annotated[
    Path, typer.Option("--rows", help="Measurement file (CSV) to which rows are added during the session.")
]
Programs = Annotated[
    list[Path] | None,
    typer.Option(
        "--program",
        help="Robot program to rewrite whenever the remaining poses are replanned.",
    ),
]
RestFile = Annotated[
    Path | None,
    typer.Option("--rest", help="CSV file of the remaining poses. [default: PLAN.rest.csv next to the plan]"),
]
Once = Annotated[bool, typer.Option("--once", help="Evaluate the existing rows and exit.")]
View = Annotated[bool, typer.Option("--view", help="Also show robot, rows and errors in a browser.")]


@dataclass(frozen=True)
class PageOptions:
    """Display of a session in the browser.

    Attributes:
        host: address at which to serve the page (0.0.0.0: also for other machines).
        port: port of the page; the next free port is used if it is occupied.
        urdf: URDF file whose meshes the page shows instead of capsules.
    """

    host: Annotated[str, Option("--view-host")] = "127.0.0.1"
    port: Annotated[int, Option("--view-port", min=1, max=65535)] = 8080
    urdf: Annotated[Path | None, Option("--view-urdf")] = None

    def load_meshes(self, robot: "Robot") -> "MeshBody | None":
        """Load the meshes of a robot; None to show capsules.

        Raises:
            RobotError: the meshes cannot be shown.
        """
        from pisigma.workbench.viewing.body import MeshBody

        return None if self.urdf is None else MeshBody(robot, self.urdf)


@contextmanager
def serve_session_page(
    arm: "ArmInSurroundings",
    limit_mm: float | None,
    page: PageOptions | None,
    camera: "CameraSettings | None" = None,
) -> Iterator[Callable[["SessionState"], None]]:
    """Serve the page of a session, and yield a function that shows a state on it.

    On a terminal the page stays until Ctrl-C.

    Args:
        arm: the robot in its cell.
        limit_mm: limit for 95 % of the errors [mm]; None for no limit.
        page: options of the page; None if no page is served.
        camera: the camera that measures; None if another sensor measures.

    Raises:
        ImportError: viser is not installed.
        OutputError: the host is not an address of this machine.
        RobotError: the meshes cannot be shown.
    """
    if page is None:
        yield lambda state: None
        return
    from pisigma.planning.plan_inputs import sight_of
    from pisigma.workbench.viewing.session_view import SessionView

    limit = None if limit_mm is None else limit_mm / 1e3
    sight = None if camera is None else sight_of(camera)
    with SessionView(arm, page.load_meshes(arm.robot), limit, page.host, page.port, sight) as view:
        print_line(f"The session is shown at {view.url}", to_stderr=True)
        yield view.show_state
        if sys.stderr.isatty():
            print_line("The page is served until you press Ctrl-C.", to_stderr=True)
            threading.Event().wait()


@takes_settings
def measure(
    plan: PlanFile,
    rows: RowsFile,
    settings: StatedSettings[MeasureSettings],
    page: PageOptions,
    rest: RestFile = None,
    program: Programs = None,
    once: Once = False,
    view: View = False,
    as_json: AsJson = False,
) -> None:
    """Check rows as they are measured, and state wrong rows, the next pose, the accuracy, and when to stop.

    Ends when more poses would not help, or with Ctrl-C. Never overwrites the plan: if the remaining poses are planned
    again, they are written to --rest. With --json, progress goes to stderr and one JSON object to stdout at the end.
    Exits with status 3 if all rows have the same fault.
    """
    from pisigma.lifetime.cell.controller import model_in_use_warnings
    from pisigma.lifetime.cell.layout import newest_plan
    from pisigma.planning.session.growing_images import growing_file
    from pisigma.workflow.follow import check_programs, follow, remaining_poses_file
    from pisigma.workflow.measure import MeasuringSession

    for sentence in model_in_use_warnings(plan, "measure"):
        print_line(f"pisigma: {sentence}", to_stderr=True)
    chosen = settings_at(plan, "measure", settings)
    plan = newest_plan(plan)
    session = MeasuringSession.read(plan, chosen)
    growing = growing_file(rows, session.plan.arm.robot, session.plan.settings)
    rest = remaining_poses_file(plan, rows, rest)
    check_programs(program or [], session.plan.arm.robot, (plan, rows, rest))
    try:
        with (
            serve_session_page(
                session.plan.arm, chosen.limit_mm, page if view else None, session.plan.settings.camera
            ) as show_page,
            _printer(session, f"measure {plan}", as_json) as show,
        ):
            for step in follow(session, growing, once):
                show(step)
                show_page(step.state)
                if step.replanned:
                    session.write_remaining(rest, program or [])
    except KeyboardInterrupt:
        pass
    _print_summary(session, rest, as_json)
    if session.state.advice.action == "correct":
        raise typer.Exit(NOT_ACCEPTED)


@contextmanager
def _printer(
    session: "MeasuringSession", title: str, as_json: bool
) -> Iterator[Callable[["SessionStep"], None]]:
    """Yield a function that prints a step: on a page that is redrawn on a terminal, otherwise as lines."""
    from rich.console import Console
    from rich.live import Live

    from pisigma.reporting.session_text import session_page, step_lines

    console = Console(stderr=as_json)
    if console.is_terminal:
        with Live(session_page(None, session.state, title), console=console, auto_refresh=False) as live:
            yield lambda step: live.update(session_page(step, step.state, title), refresh=True)
        return

    def show(step: "SessionStep") -> None:
        for line in step_lines(step):
            print_line(line, to_stderr=as_json)

    yield show


def _print_summary(session: "MeasuringSession", rest: Path, as_json: bool) -> None:
    """Print the verdict on the session."""
    from pisigma.reporting.session_text import session_text

    state = session.state
    written = str(rest) if session.replanned else None
    if as_json:
        print_json({"rest": written, **state.to_json()})
        return
    again = [] if written is None else [f"The remaining poses were planned again: {written}."]
    print_result(session_text(state, again), elsewhere="--json")
