"""What stands beside the scene: what to do next, the accuracy curve, alarms, and the legend."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from pisigma.files.templates import template_environment
from pisigma.planning.session.state import AccuracyPoint, SessionState
from pisigma.reporting.viewing.colors import RAMP
from pisigma.robot.description import Robot

if TYPE_CHECKING:  # names in full, which type checkers at run time find without these imports
    import viser.uplot

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
