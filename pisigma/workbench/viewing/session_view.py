"""Live page of a measuring session in the browser."""

import math
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from pisigma.files.errors import OutputError
from pisigma.files.templates import template_environment
from pisigma.planning.board_sight import BoardSight
from pisigma.planning.session.state import AccuracyPoint, RowsSoFar, SessionState
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.robot.description import Robot
from pisigma.workbench.viewing.body import AbstractBody, CapsuleBody
from pisigma.workbench.viewing.colors import RAMP, round_up
from pisigma.workbench.viewing.scene import SessionScene

if TYPE_CHECKING:  # full names can be resolved by type checkers at run time even without these imports
    import viser
    import viser.uplot

_ERROR_SHARE = 0.15
"""Drawn length of an error at the end of the colour scale, as a share of the robot's reach."""
FIELD, _RISE, _AROUND_ROBOT, _CLOSER = 0.8, 0.5, 0.7, 0.92
"""First view: field of view [rad], downward slope, radius around the robot as a share of the reach, and distance of the
camera as a share of that at which this radius is visible."""
MAGNIFICATIONS = (0, 2000, 10)
"""Smallest and largest magnification of errors, and its step."""
_MAX_ALARMS = 8
"""Number of latest alarms that are shown."""

_CURVES: tuple["viser.uplot.Series", ...] = (
    {"label": "poses"},
    {"label": "predicted RMS", "stroke": "#1f5fa8", "width": 2},
    {"label": "predicted 95 %", "stroke": "#1f5fa8", "width": 1, "dash": (2, 3)},
    {"label": "cross-validated RMS", "stroke": "#b35806", "width": 2},
    {"label": "random poses, RMS", "stroke": "#8a8a8a", "width": 1, "dash": (6, 4)},
    {"label": "limit", "stroke": "#c81e1e", "width": 1, "points": {"show": False}},
)


class SessionView:
    """Server of the page until it is closed: `with SessionView(arm) as view: view.show(state)`.

    The page is self-contained.

    Attributes:
        url: link to the page, with its token.
    """

    def __init__(
        self,
        arm: ArmInSurroundings,
        body: AbstractBody | None = None,
        limit: float | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        sight: BoardSight | None = None,
    ) -> None:
        """Start serving.

        Args:
            arm: the robot in its cell.
            body: appearance of the robot; None for capsules.
            limit: limit on the 95 % quantile of the errors [m]; None for no limit.
            host: address to listen on; at 127.0.0.1 only this machine can open the page.
            port: port to listen on; if it is in use, the next free port.
            sight: camera and board; None without a camera.

        Raises:
            ImportError: viser is not installed.
            OutputError: the host is not an address of this machine.
        """
        from pisigma.workbench.server.front_server import FrontServer
        from pisigma.workbench.server.viser_server import ViserBackend

        self._reach, self._lock = arm.robot.reach, threading.Lock()
        self._state: SessionState | None = None
        self._magnified_by_hand = False
        self._behind = ViserBackend("pisigma measure")
        try:
            self._front = FrontServer(self._behind.pages(""), host, port, self._behind.close_sockets)
        except OutputError:
            self._behind.close()
            raise
        self.url, self._server = self._front.url, self._behind.server
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
        """Return the view."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop serving."""
        self._behind.close()
        self._front.close()

    def show_state(self, state: SessionState) -> None:
        """Show a state of the session on all open pages."""
        top = color_scale_maximum(state.rows)
        with self._lock, self._server.atomic():
            self._state = state
            if not self._magnified_by_hand:
                times = arrow_magnification(top, self._reach)
                self._panel.magnification.value = times  # type: ignore[misc]  # mypy misses its decorated setter
            self._scene.show_robot(state)
            if state.base is not None:
                self._scene.show_sensor(state.base)
            self._scene.show_rows(state.rows, top, self._panel.magnification.value)
            self._panel.show_state(state, top)
        self._server.flush()

    def _magnify(self, event: "viser.GuiEvent[Any]") -> None:
        """Draw the errors with the magnification of the slider, once a person has moved it."""
        if event.client is None:
            return
        with self._lock, self._server.atomic():
            self._magnified_by_hand = True
            if self._state is not None:
                rows = self._state.rows
                self._scene.show_rows(rows, color_scale_maximum(rows), self._panel.magnification.value)


def first_view(arm: ArmInSurroundings) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]:
    """Return camera position and target of a view with robot and tracker side by side [m]."""
    tracker = np.zeros(3) if arm.surroundings.tracker is None else arm.surroundings.tracker.position.numpy()
    around = _AROUND_ROBOT * arm.robot.reach
    low, high = np.minimum(tracker, (-around, -around, 0.0)), np.maximum(tracker, around)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    sideways = np.array([tracker[1], -tracker[0], 0.0]) if tracker[:2].any() else np.array([1.0, -1.0, 0.0])
    direction = sideways / np.linalg.norm(sideways) + np.array([0.0, 0.0, _RISE])
    return middle + _CLOSER * radius / np.sin(FIELD / 2) * direction / np.linalg.norm(direction), middle


def arrow_magnification(max_error: float, reach: float) -> int:
    """Return the magnification with which errors are visible next to a robot.

    Args:
        max_error: error at the end of the colour scale [m].
        reach: reach of the robot [m].
    """
    low, high, step = MAGNIFICATIONS
    return step * round(float(np.clip(_ERROR_SHARE * reach / max_error, low + step, high)) / step)


def color_scale_maximum(rows: RowsSoFar) -> float:
    """Return the error at the end of the colour scale: the 95 % quantile of the used rows, rounded up [m]."""
    errors = np.linalg.norm(rows.error, axis=1)[~rows.is_unused]
    errors = errors[np.isfinite(errors)]
    return round_up(float(np.quantile(errors, 0.95))) if errors.size else 1e-3


class SessionPanel:
    """Panel next to the scene; every call replaces the previous content.

    Attributes:
        magnification: slider of the magnification of errors.
    """

    def __init__(self, gui: "viser.GuiApi", robot: Robot, limit: float | None) -> None:
        """Set up the panel.

        Args:
            gui: GUI of the server.
            robot: robot with the names and units of the joints.
            limit: limit on the 95 % quantile of the errors [m]; None for no limit.
        """
        self._robot, self._limit = robot, limit
        environment = template_environment(
            "pisigma.workbench.viewing", {"mm": lambda length: f"{length * 1e3:.3f}"}
        )
        self._text: Any = environment.get_template("panel.html.j2").module
        self._advice = gui.add_html("")
        self._curve = gui.add_uplot(
            _curves((), limit),
            _CURVES,
            title="Accuracy over the task",
            scales=_scales(()),
            axes=({"label": "poses", "incrs": (1, 2, 5, 10, 20, 50, 100, 200, 500)}, {"label": "mm"}),
            aspect=1.6,
            visible=False,
        )
        self.magnification = gui.add_slider("errors magnified by", *MAGNIFICATIONS, initial_value=0)
        self._rows = gui.add_html("")

    def show_state(self, state: SessionState, max_error: float) -> None:
        """Show a state of the session.

        Args:
            state: the state.
            max_error: error at the end of the colour scale [m].
        """
        self._advice.content = str(self._text.advice(state, self._robot.axes, self._limit))
        self._rows.content = str(
            self._text.rows(state, self._robot.axes, state.alarms[: -_MAX_ALARMS - 1 : -1], max_error, RAMP)
        )
        points = (*state.expected_accuracy, *state.reached_accuracy)
        curves = _curves(points, self._limit)
        self._curve.visible = len(points) > 1
        self._curve.data, self._curve.scales = curves, _scales(curves)


def _curves(
    points: Sequence[AccuracyPoint], limit: float | None
) -> tuple[Float64[np.ndarray, " points"], ...]:
    """Return the columns of the curve [mm] over the number of poses; of points with the same number, the last one."""
    by_poses = {point.poses: point for point in points}
    line = math.nan if limit is None else limit
    rows = [
        (p.predicted_rms, p.predicted_p95, p.cross_validated_rms, p.random_rms, line)
        for _, p in sorted(by_poses.items())
    ]
    columns = np.array(rows, dtype=np.float64).reshape(-1, len(_CURVES) - 1).T * 1e3
    return np.array(sorted(by_poses), dtype=np.float64), *columns


def _scales(curves: Sequence[Float64[np.ndarray, " points"]]) -> dict[str, "viser.uplot.Scale"]:
    """Return the axes of the curve: errors from 0 to the largest, which uPlot cannot compute with missing values."""
    finite = [column[np.isfinite(column)].max(initial=0.0) for column in curves[1:]]
    return {"x": {"time": False}, "y": {"auto": False, "range": (0.0, 1.05 * max((1e-3, *finite)))}}
