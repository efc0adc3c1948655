"""A page in the browser that shows a measuring session while it goes on."""

import contextlib
import io
import math
import socket
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from pisigma.files.errors import OutputError
from pisigma.files.templates import template_environment
from pisigma.planning.board_sight import BoardSight
from pisigma.planning.session.state import AccuracyPoint, RowsSoFar, SessionState
from pisigma.planning.surroundings.arm_in_cell import ArmInCell
from pisigma.reporting.viewing.body import AbstractBody, CapsuleBody
from pisigma.reporting.viewing.colors import RAMP, round_up
from pisigma.reporting.viewing.scene import SessionScene
from pisigma.robot.description import Robot

if TYPE_CHECKING:  # names in full, which type checkers at run time find without these imports
    import viser
    import viser.uplot

DRAWN = 0.15
"""Share of the robot's reach that an error at the end of the scale of colours is drawn with."""
FIELD, RISE, AROUND_ROBOT, CLOSER = 0.8, 0.5, 0.7, 0.92
"""Of the first view: its angle [rad], how steeply it looks down, the share of the reach that it shows around, and how
much nearer than for all of that ball it is."""
MOST_ALARMS = 8
"""The latest are shown."""

CURVES: tuple["viser.uplot.Series", ...] = (
    {"label": "poses"},
    {"label": "predicted RMS", "stroke": "#1f5fa8", "width": 2},
    {"label": "predicted 95 %", "stroke": "#1f5fa8", "width": 1, "dash": (2, 3)},
    {"label": "cross-validated RMS", "stroke": "#b35806", "width": 2},
    {"label": "random poses, RMS", "stroke": "#8a8a8a", "width": 1, "dash": (6, 4)},
    {"label": "limit", "stroke": "#c81e1e", "width": 1, "points": {"show": False}},
)


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


class SessionPanel:
    """Fills the panel beside the scene; every call replaces what the call before has written.

    Attributes:
        magnification: slider: how many times longer than they are errors are drawn.
    """

    def __init__(self, gui: "viser.GuiApi", robot: Robot, limit: float | None) -> None:
        """Lay the panel out.

        Args:
            gui: where to.
            robot: gives the joints their names and units.
            limit: what 95 % of the errors are to stay below [m]; None for no limit.
        """
        self._robot, self._limit = robot, limit
        environment = template_environment(
            "pisigma.reporting.viewing", {"mm": lambda length: f"{length * 1e3:.3f}"}
        )
        self._text: Any = environment.get_template("panel.html.j2").module
        self._advice = gui.add_html("")
        self._curve = gui.add_uplot(
            _curves((), limit),
            CURVES,
            title="Accuracy over the task",
            scales=_scales(()),
            axes=({"label": "poses", "incrs": (1, 2, 5, 10, 20, 50, 100, 200, 500)}, {"label": "mm"}),
            aspect=1.6,
            visible=False,
        )
        self.magnification = gui.add_slider("errors magnified by", min=0, max=2000, step=10, initial_value=0)
        self._rows = gui.add_html("")

    def show(self, state: SessionState, top: float) -> None:
        """Write a state of the session.

        Args:
            state: the state.
            top: error [m] at which the scale of colours ends.
        """
        self._advice.content = str(self._text.advice(state, self._robot.axes, self._limit))
        self._rows.content = str(
            self._text.rows(state, self._robot.axes, state.alarms[: -MOST_ALARMS - 1 : -1], top, RAMP)
        )
        points = (*state.expected, *state.reached)
        curves = _curves(points, self._limit)
        self._curve.visible = len(points) > 1
        self._curve.data, self._curve.scales = curves, _scales(curves)


def _curves(
    points: Sequence[AccuracyPoint], limit: float | None
) -> tuple[Float64[np.ndarray, " points"], ...]:
    """Columns of the curve [mm] by the number of poses; of several points for one number the last counts."""
    by_poses = {point.poses: point for point in points}
    line = math.nan if limit is None else limit
    rows = [
        (p.predicted_rms, p.predicted_p95, p.cross_validated_rms, p.random_rms, line)
        for _, p in sorted(by_poses.items())
    ]
    columns = np.array(rows, dtype=np.float64).reshape(-1, len(CURVES) - 1).T * 1e3
    return np.array(sorted(by_poses), dtype=np.float64), *columns


def _scales(curves: Sequence[Float64[np.ndarray, " points"]]) -> dict[str, "viser.uplot.Scale"]:
    """Axes of the curve: errors from 0 to the largest, which uPlot does not work out where one is missing."""
    finite = [column[np.isfinite(column)].max(initial=0.0) for column in curves[1:]]
    return {"x": {"time": False}, "y": {"auto": False, "range": (0.0, 1.05 * max((1e-3, *finite)))}}
