"""The page in the browser that `pisigma measure --view` shows a session on."""

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.output import print_line
from pisigma.files.setting import Option

if TYPE_CHECKING:
    from pisigma.planning.camera_settings import CameraSettings
    from pisigma.planning.session.state import SessionState
    from pisigma.planning.surroundings.arm_in_cell import ArmInCell
    from pisigma.reporting.viewing.body import MeshBody
    from pisigma.robot.description import Robot

View = Annotated[
    bool, typer.Option("--view", help="Show robot, rows and errors on a page in the browser too.")
]


@dataclass(frozen=True)
class PageOptions:
    """How a session is shown in the browser.

    Attributes:
        host: where the page is served; 0.0.0.0: for other machines too.
        port: port of the page; where it is taken, the next one that is free.
        urdf: URDF file of the robot, whose meshes the page shows instead of capsules.
    """

    host: Annotated[str, Option("--view-host")] = "127.0.0.1"
    port: Annotated[int, Option("--view-port", least=1, most=65535)] = 8080
    urdf: Annotated[Path | None, Option("--view-urdf")] = None

    def body(self, robot: "Robot") -> "MeshBody | None":
        """Load the meshes of a robot; None where capsules are shown.

        Raises:
            RobotError: the meshes cannot be shown.
        """
        from pisigma.reporting.viewing.body import MeshBody

        return None if self.urdf is None else MeshBody(robot, self.urdf)


@contextmanager
def shown_in_browser(
    arm: "ArmInCell", limit_mm: float | None, page: PageOptions | None, camera: "CameraSettings | None" = None
) -> Iterator[Callable[["SessionState"], None]]:
    """Serve the page of a session, and give what shows a state on it; on a terminal it then stays until Ctrl-C.

    Args:
        arm: the robot in its cell.
        limit_mm: what 95 % of the errors are to stay below [mm]; None for no limit.
        page: how it is shown; None for no page.
        camera: that measures; None for another sensor.

    Raises:
        ImportError: viser is not installed.
        OutputError: the host is no address of this machine.
        RobotError: the meshes cannot be shown.
    """
    if page is None:
        yield lambda state: None
        return
    from pisigma.planning.plan_inputs import sight_of
    from pisigma.reporting.viewing.session_view import SessionView

    limit = None if limit_mm is None else limit_mm / 1e3
    sight = None if camera is None else sight_of(camera)
    with SessionView(arm, page.body(arm.robot), limit, page.host, page.port, sight) as view:
        print_line(f"The session is shown at {view.url}", to_stderr=True)
        yield view.show
        if sys.stderr.isatty():
            print_line("The page stays until Ctrl-C.", to_stderr=True)
            threading.Event().wait()
