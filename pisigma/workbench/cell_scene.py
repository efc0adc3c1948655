"""The robot of a cell in three dimensions: the newest plan, rows with their errors, and a tried pose."""

import threading
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from pisigma.files.errors import ModelError, PisigmaError, RobotError
from pisigma.files.templates import template_environment
from pisigma.lifetime.cell.layout import PLANS, newest_plan
from pisigma.model.folder.model_folder import load_model
from pisigma.planning.plan_inputs import sight_of
from pisigma.planning.session.state import RowsSoFar, SessionState
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.robot.se3 import xyz_zyx_from_transform
from pisigma.workbench.viewing.body import AbstractBody, CapsuleBody, MeshBody
from pisigma.workbench.viewing.colors import RAMP, round_up
from pisigma.workbench.viewing.scene import SessionScene
from pisigma.workbench.viewing.session_view import (
    FIELD,
    MAGNIFICATIONS,
    arrow_magnification,
    color_scale_maximum,
    first_view,
)
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.measure import MeasuringSession
from pisigma.workflow.predicted_errors import PredictedErrors, predicted_errors
from pisigma.workflow.settings.measuring import MeasureSettings

if TYPE_CHECKING:  # the full name can be resolved by type checkers at run time even without this import
    import viser


class CellScene:
    """Scene of a cell; every call replaces earlier drawings."""

    def __init__(self, server: "viser.ViserServer") -> None:
        """Set up an empty scene.

        Args:
            server: viser.
        """
        self._server, self._lock = server, threading.Lock()
        self._rows: RowsSoFar | None = None
        self._marked: list[int] = []
        self._scene: SessionScene | None = None
        self._turn = 0
        self._before: dict[str, str] | None = None
        self._dragged: set[str] = set()
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._slider = server.gui.add_slider("errors magnified by", *MAGNIFICATIONS, initial_value=0)
        self._slider.on_update(self._magnify)
        self._cell: Cell | None = None
        self._predicted: tuple[str, PredictedErrors] | None = None
        self._errors = server.gui.add_checkbox("predicted 95 % errors", False)
        self._errors.on_update(lambda event: self.show_errors(self._cell))
        self._legend = server.gui.add_html("", visible=False)
        self._text: Any = (
            template_environment("pisigma.workbench.viewing", {"mm": str})
            .get_template("panel.html.j2")
            .module
        )
        server.scene.configure_default_lights(cast_shadow=False)

    def show_cell(self, cell: Cell, is_movable: bool = False) -> int:
        """Show the robot, its surroundings, and the poses of the newest plan.

        Args:
            cell: the cell.
            is_movable: whether floor, boxes, tracker, and camera or board can be dragged.

        Returns:
            The number of calls so far.
        """
        planned: MeasuringSession | None = None
        if any((cell.folder / PLANS).glob("*.csv")):
            try:
                planned = MeasuringSession.read(newest_plan(cell.folder), MeasureSettings())
            except PisigmaError:
                planned = None  # the tabs show what is wrong with the cell
        arm = ArmInSurroundings.from_robot(cell.robot, cell.file.document.surroundings)
        if planned is not None and not is_movable:
            arm = planned.plan.arm
        camera = None if planned is None else planned.plan.settings.camera
        with self._lock, self._server.atomic():
            self._server.scene.reset()
            view = self._server.initial_camera
            view.position, view.look_at = first_view(arm)
            view.fov = FIELD
            sight = None if camera is None else sight_of(camera)
            self._scene = SessionScene(self._server.scene, arm, _body(cell, arm), sight, is_movable)
            self._cell = cell
            self._reach, self._rows = arm.robot.reach, None
            self._turn += 1
            self._before, self._dragged = self._places() if is_movable else None, set()
            if planned is None:
                self._scene.show_pose("/tried", np.zeros(arm.robot.dof))
            else:
                self._scene.show_robot(planned.state)
        self._server.flush()
        self.show_errors(cell)
        return self._turn

    def show_errors(self, cell: Cell | None) -> None:
        """Show the errors that the model in use predicts, or the newest model, if a person switched them on.

        Args:
            cell: the cell; None before there is one.
        """
        self._legend.visible = bool(self._errors.value)
        if self._errors.value and cell is not None:
            self._legend.content = str(self._text.legend("", 0, RAMP, "The errors are being predicted."))
            try:
                found, note = self._predicted_errors(cell), ""
            except PisigmaError as problem:
                found, note = None, str(problem)
        else:
            found, note = None, ""
        with self._lock, self._server.atomic():
            top = 0.0
            if found is not None:
                top, note = (
                    round_up(float(found[1].p95.max())),
                    f"Model {found[0]}: 95 % of the position errors are smaller than the value of the colour.",
                )
            self._legend.content = str(self._text.legend("predicted error", top, RAMP, note))
            if self._scene is not None:
                self._scene.show_cloud(None if found is None else found[1], top)
        self._server.flush()

    def _predicted_errors(self, cell: Cell) -> tuple[str, PredictedErrors] | None:
        """Return the name of the model and its errors; None without a model.

        Raises:
            PisigmaError: the model predicts no errors, or cannot be read.
        """
        models, in_use = cell.history.models(), cell.history.in_use
        if not models:
            raise ModelError("there is no model yet", remedy="calibrate the robot first")
        name = models[-1].name if in_use is None else in_use.name
        if self._predicted is None or self._predicted[0] != name:
            self._predicted = name, predicted_errors(load_model(cell.model_folder(name)))
        return self._predicted

    def dragged_values(self) -> dict[str, Any]:
        """Return the values of `cell.yaml` that were changed by dragging, and the number of calls of `show_cell`.

        A value that was dragged back is included, because the page has shown it in between.
        """
        with self._lock:
            before, places = self._before, {} if self._before is None else self._places()
            self._dragged |= {key for key, value in places.items() if before and value != before[key]}
            values = {key: places[key] for key in places if key in self._dragged}
            return {"turn": 0 if before is None else self._turn, "values": values}

    def _places(self) -> dict[str, str]:
        """Return the positions of all objects that can be dragged [mm], and the angles of those that can turn [deg]."""
        places: dict[str, str] = {}
        for name, node in ({} if self._scene is None else self._scene.handles).items():
            key, at = (
                f"surroundings.{name}",
                [f"{1e3 * one + 0.0:.1f}".removesuffix(".0") for one in node.position],
            )
            if name == "floor_mm":
                places[key] = at[2]
            elif name == "view.frame":
                T = np.eye(4)
                T[:3, :3] = Rotation.from_quat(node.wxyz, scalar_first=True).as_matrix()
                angles = np.rad2deg(xyz_zyx_from_transform(torch.from_numpy(T))[3:].numpy())
                places |= {f"{key}.{axis}_mm": one for axis, one in zip("xyz", at, strict=True)}
                for axis, angle in zip(("roll", "pitch", "yaw"), angles, strict=True):
                    places[f"{key}.{axis}_deg"] = f"{180.0 - (180.0 - round(angle, 2)) % 360.0:.2f}"
            elif name == "tracker":
                places |= {f"{key}.{axis}_mm": one for axis, one in zip("xyz", at, strict=True)}
            else:
                places[f"{key}.center_mm"] = ", ".join(at)
                places[f"{key}.yaw_deg"] = f"{np.rad2deg(2 * np.arctan2(node.wxyz[3], node.wxyz[0])):.2f}"
        return places

    def show_state(self, state: SessionState) -> None:
        """Show the rows of a session with their errors."""
        with self._lock, self._server.atomic():
            if self._scene is not None:
                self._scene.show_robot(state)
                if state.base is not None:
                    self._scene.show_sensor(state.base)
        self.show_rows(state.rows)

    def show_rows(self, rows: RowsSoFar) -> None:
        """Show rows, and their errors if the rows have been compared with each other."""
        with self._lock, self._server.atomic():
            self._rows, self._marked = rows, []
            times = arrow_magnification(color_scale_maximum(rows), self._reach)
            self._slider.value = times  # type: ignore[misc]  # a decorated setter
            self._draw_rows()
        self._server.flush()

    def add_rows(self, q: Float64[np.ndarray, "rows dof"]) -> None:
        """Show the joint values of new rows [rad or m], which have not been compared with the others yet."""
        with self._lock, self._server.atomic():
            if self._scene is not None:
                self._scene.add_rows(q)
        self._server.flush()

    def mark_rows_of_lines(self, file_lines: list[int]) -> None:
        """Mark the rows of some lines in red with their numbers, and move the camera to the first of these rows."""
        with self._lock, self._server.atomic():
            self._marked = file_lines
            if (place := self._draw_rows()) is not None:
                for client in self._server.get_clients().values():
                    client.camera.look_at = place
        self._server.flush()

    def _draw_rows(self) -> Float64[np.ndarray, " 3"] | None:
        """Draw the rows with the magnification of the slider; return the position of the first marked row."""
        if self._scene is None or self._rows is None:
            return None
        rows = replace(self._rows, is_unused=self._rows.is_unused | np.isin(self._rows.line, self._marked))
        position = self._scene.show_rows(rows, color_scale_maximum(rows), float(self._slider.value))
        marked = np.flatnonzero(np.isin(rows.line, self._marked))
        return position[marked[0]] if marked.size else None

    def show_pose(self, q: Float64[np.ndarray, " dof"]) -> None:
        """Show the arm at joint values that were tried [rad or m]."""
        with self._lock, self._server.atomic():
            if self._scene is not None:
                self._scene.show_pose("/tried", q)
        self._server.flush()

    def _magnify(self, event: "viser.GuiEvent[Any]") -> None:
        """Draw the errors with the magnification of the slider, once a person has moved it."""
        if event.client is None:  # set by `show_rows`, which has the lock
            return
        with self._lock, self._server.atomic():
            self._draw_rows()


def _body(cell: Cell, arm: ArmInSurroundings) -> AbstractBody:
    """Return the meshes of a URDF file, or capsules if the file has none."""
    document = cell.file.document
    try:
        return MeshBody(arm.robot, cell.file.robot, document.base, document.tip, cell.folder)
    except RobotError:
        return CapsuleBody(arm.capsules)
