"""A page in the browser that shows a measuring session while it goes on."""

import contextlib
import io
import socket
import threading
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from pisigma.files.errors import OutputError
from pisigma.planning.board_sight import BoardSight
from pisigma.planning.session.state import RowsSoFar, SessionState
from pisigma.planning.surroundings.arm_in_cell import ArmInCell
from pisigma.reporting.viewing.body import AbstractBody, CapsuleBody
from pisigma.reporting.viewing.colors import round_up
from pisigma.reporting.viewing.panel import SessionPanel
from pisigma.reporting.viewing.scene import SessionScene

if TYPE_CHECKING:  # names in full, which type checkers at run time find without these imports
    import viser

DRAWN = 0.15
"""Share of the robot's reach that an error at the end of the scale of colours is drawn with."""
FIELD, RISE, AROUND_ROBOT, CLOSER = 0.8, 0.5, 0.7, 0.92
"""Of the first view: its angle [rad], how steeply it looks down, the share of the reach that it shows around, and how
much nearer than for all of that ball it is."""


class SessionView:
    """Serves the page until it is closed: `with SessionView(arm) as view: view.show(state)`.

    The page fetches nothing from other machines.

    Attributes:
        url: address of the page.
    """

    def __init__(
        self,
        arm: ArmInCell,
        body: AbstractBody | None = None,
        limit: float | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        sight: BoardSight | None = None,
    ) -> None:
        """Start serving.

        Args:
            arm: the robot in its cell.
            body: what the robot looks like; None for capsules.
            limit: what 95 % of the errors are to stay below [m]; None for no limit.
            host: address to listen at; at 127.0.0.1 only this machine can open the page.
            port: to listen at; where it is taken, the next one that is free.
            sight: camera and board; None without a camera.

        Raises:
            ImportError: viser is not installed.
            OutputError: the host is no address of this machine.
        """
        import viser

        _check_host(host)
        self._reach, self._lock = arm.robot.reach, threading.Lock()
        self._state: SessionState | None = None
        self._magnified_by_hand = False
        with contextlib.redirect_stdout(io.StringIO()):  # it greets where results are printed
            self._server = viser.ViserServer(host, port, label="pisigma measure", verbose=False)
        self.url = f"http://{host}:{self._server.get_port()}"
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self._server.gui.main_panel.dock_right()
        self._server.scene.configure_default_lights(cast_shadow=False)
        camera = self._server.initial_camera
        camera.position, camera.look_at = first_view(arm)
        camera.fov = FIELD
        self._scene = SessionScene(self._server.scene, arm, body or CapsuleBody(arm.capsules), sight)
        self._panel = SessionPanel(self._server.gui, arm.robot, limit)
        self._panel.magnification.on_update(self._magnify)

    def __enter__(self) -> "SessionView":
        """The view itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop serving."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def show(self, state: SessionState) -> None:
        """Show a state of the session on every page that is open."""
        top = top_of_scale(state.rows)
        with self._lock, self._server.atomic():
            self._state = state
            if not self._magnified_by_hand:
                times = 10 * round(float(np.clip(DRAWN * self._reach / top, 10, 2000)) / 10)
                self._panel.magnification.value = times  # type: ignore[misc]  # mypy misses its decorated setter
            self._scene.show_robot(state)
            if state.base is not None:
                self._scene.show_sensor(state.base)
            self._scene.show_rows(state.rows, top, self._panel.magnification.value)
            self._panel.show(state, top)
        self._server.flush()

    def _magnify(self, event: "viser.GuiEvent[Any]") -> None:
        """Draw the errors as long as the slider says, from when a person moves it."""
        if event.client is None:
            return
        with self._lock, self._server.atomic():
            self._magnified_by_hand = True
            if self._state is not None:
                rows = self._state.rows
                self._scene.show_rows(rows, top_of_scale(rows), self._panel.magnification.value)


def _check_host(host: str) -> None:
    """Refuse an address that this machine has not; viser would look for a free port there for ever."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as trial:
            trial.bind(address)
    except OSError as problem:
        raise OutputError(
            f"the page cannot be served at '{host}' ({problem.strerror}); give an address of this machine, such as "
            "127.0.0.1, or 0.0.0.0 for all of them."
        ) from None


def first_view(arm: ArmInCell) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]:
    """From where to look at the robot and its tracker, which then stand side by side, and where to [m]."""
    tracker = np.zeros(3) if arm.cell.tracker is None else arm.cell.tracker.position.numpy()
    around = AROUND_ROBOT * arm.robot.reach
    low, high = np.minimum(tracker, (-around, -around, 0.0)), np.maximum(tracker, around)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    sideways = np.array([tracker[1], -tracker[0], 0.0]) if tracker[:2].any() else np.array([1.0, -1.0, 0.0])
    direction = sideways / np.linalg.norm(sideways) + np.array([0.0, 0.0, RISE])
    return middle + CLOSER * radius / np.sin(FIELD / 2) * direction / np.linalg.norm(direction), middle


def top_of_scale(rows: RowsSoFar) -> float:
    """Error [m] at which the scale of colours ends: a round one that 95 % of the rows that count stay below."""
    errors = np.linalg.norm(rows.error, axis=1)[~rows.alarmed]
    errors = errors[np.isfinite(errors)]
    return round_up(float(np.quantile(errors, 0.95))) if errors.size else 1e-3
