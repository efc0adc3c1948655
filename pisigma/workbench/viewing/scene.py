"""Three-dimensional scene of the robot, its surroundings and the rows so far, in the robot's base frame [m]."""

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from jaxtyping import Float64, UInt8
from scipy.spatial.transform import Rotation

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.pattern import board_sheet
from pisigma.planning.board_sight import BoardSight
from pisigma.planning.session.state import RowsSoFar, SessionState
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.planning.surroundings.surroundings import ReflectorSection, Surroundings
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import invert
from pisigma.workbench.viewing.body import AbstractBody
from pisigma.workbench.viewing.colors import (
    ALARM,
    FORBIDDEN,
    LINKS,
    NEXT,
    PLANNED,
    SIGHT,
    TRACKER,
    UNJUDGED,
    Color,
    error_colors,
)
from pisigma.workbench.viewing.surface import Surface, revolve, rotation_to
from pisigma.workflow.predicted_errors import PredictedErrors

if TYPE_CHECKING:  # full names can be resolved by type checkers at run time even without these imports
    import viser

_GHOST = 0.35
"""Opacity of the robot at the next pose."""

_DOT, _SHAFT, HEAD, _MAX_ARROW, AXES = 0.02, 0.003, 0.008, 0.3, 0.2
"""Shares of the robot's reach: diameter of a point, radii of shaft and head of an arrow, its largest length, and length
of the base axes."""
_SHEET, _PRINT = (245, 245, 245), (20, 20, 20)
"""Colours of a board's sheet and corners."""
_CORNER_DOT = 0.25
"""Diameter of a corner's dot, as a share of the distance of two corners."""
_CLOUD_DOT = 0.6
"""Diameter of the dot of a predicted error, as a share of the diameter of the dot of a row."""
_MAX_LABELS, _MAX_ARROWS = 50, 1000
"""Wrong rows that are labelled with their line, and errors that are drawn as arrows; more are drawn as lines."""
_FLOOR, _TRACKER_HEAD, _CONE, _BEAM, _HANDLE = 5.0, 0.05, 0.2, 0.003, 0.3
"""Shares of the robot's reach: edge of the floor, radius of the tracker, length of the cone, width of the beam, size of
the arrows for dragging objects."""


class SessionScene:
    """Scene of the robot and the rows; every call replaces earlier drawings.

    Attributes:
        handles: nodes of floor, boxes, tracker and camera or board by their keys in the surroundings.
    """

    def __init__(
        self,
        scene: "viser.SceneApi",
        arm: ArmInSurroundings,
        body: AbstractBody,
        sight: BoardSight | None = None,
        is_movable: bool = False,
    ) -> None:
        """Draw the surroundings.

        Args:
            scene: scene to draw in.
            arm: the robot in its surroundings.
            body: appearance of the robot.
            sight: camera and board; None without a camera.
            is_movable: whether floor, boxes, tracker, and camera or board can be dragged.
        """
        self._sight = sight
        self._scene, self._arm, self._robot, self._body = scene, arm, arm.robot, body
        self._groups: dict[str, viser.FrameHandle] = {}
        self._ghost = scene.add_frame("/ghost", show_axes=False)
        scene.set_up_direction("+z")
        axes = AXES * arm.robot.reach
        scene.add_frame("/base", axes_length=axes, axes_radius=axes / 20)
        self.handles = draw_surroundings(scene, arm.surroundings, arm.robot.reach, is_movable)

    def show_robot(self, state: SessionState) -> None:
        """Draw the robot at the last row and as a ghost at the next pose."""
        measured = state.rows.q if state.rows.line else np.zeros((1, self._robot.dof))
        self._body.draw(self._scene, "/robot", measured[-1], LINKS, None)
        self._begin("/next")
        self._ghost.visible = state.next_pose is not None
        if state.next_pose is not None:
            pose, T = state.next_pose, self._poses(state.next_pose.q)
            self._body.draw(self._scene, "/ghost/robot", pose.q, NEXT, _GHOST)
            self._label("/next/label", f"next: pose {pose.number}", T[:3, 3])
            draw_line_of_sight(self._scene, "/next", self._arm.surroundings, T, self._robot.reach)
            if self._sight is not None and self._sight.is_fixed:
                self._scene.add_frame("/next/board", show_axes=False, wxyz=_quaternion(T), position=T[:3, 3])
                draw_board(self._scene, "/next/board", self._sight.board)
        if len(state.remaining):
            self._dots("/next/remaining", self._poses(state.remaining)[:, :3, 3], PLANNED, 0.5)

    def show_pose(self, name: str, q: Float64[np.ndarray, " dof"]) -> None:
        """Draw the robot at joint values [rad or m], with the axes of its tool."""
        self._body.draw(self._scene, f"{name}/arm", q, LINKS, None)
        T, axes = self._poses(q), AXES * self._robot.reach / 2
        self._scene.add_frame(
            f"{name}/tool", axes_length=axes, axes_radius=axes / 20, wxyz=_quaternion(T), position=T[:3, 3]
        )

    def show_sensor(self, T_sensor_base: Float64[np.ndarray, "4 4"]) -> None:
        """Draw the axes of the measuring frame, as determined by the rows."""
        T = invert(torch.from_numpy(T_sensor_base)).numpy()
        axes = AXES * self._robot.reach
        self._scene.add_frame(
            "/sensor", axes_length=axes, axes_radius=axes / 20, wxyz=_quaternion(T), position=T[:3, 3]
        )
        if self._sight is not None:
            self._label("/sensor/label", "camera" if self._sight.is_fixed else "board", np.zeros(3))
            if not self._sight.is_fixed:
                draw_board(self._scene, "/sensor", self._sight.board)
        elif self._arm.surroundings.tracker is None:
            self._label("/sensor/label", "frame of the sensor", np.zeros(3))

    def show_rows(
        self, rows: RowsSoFar, max_error: float, magnification: float
    ) -> Float64[np.ndarray, "rows 3"]:
        """Draw every row as a point in the colour of its error, with the error as an arrow.

        Args:
            rows: measured rows; rows that cannot be checked yet are drawn at the tool of the nominal robot.
            max_error: error at the end of the colour scale [m].
            magnification: ratio of the lengths of the arrows to the lengths of the errors.

        Returns:
            The positions at which the rows are drawn [m].
        """
        self._begin("/rows")
        if not rows.line:
            return rows.position
        nominal = self._poses(rows.q)[:, :3, 3]
        position = np.where(np.isfinite(rows.position), rows.position, nominal)
        colors = error_colors(np.linalg.norm(rows.error, axis=1), max_error)
        colors[rows.is_unused] = ALARM
        if not rows.is_test_row.all():
            self._dots("/rows/measured", position[~rows.is_test_row], colors[~rows.is_test_row])
        if rows.is_test_row.any():
            self._dots("/rows/check", position[rows.is_test_row], colors[rows.is_test_row], shape="diamond")
        for row in np.flatnonzero(rows.is_unused)[:_MAX_LABELS]:
            self._label(f"/rows/alarm_{row}", f"line {rows.line[row]}", position[row])
        self._arrows(position, rows, colors, magnification)
        return position

    def show_cloud(self, errors: PredictedErrors | None, max_error: float) -> None:
        """Draw predicted errors as one cloud of points.

        Args:
            errors: predicted errors; None to draw none.
            max_error: error at the end of the colour scale [m].
        """
        self._begin("/predicted")
        if errors is not None:
            colors = error_colors(errors.p95.numpy(), max_error)
            self._dots("/predicted/errors", errors.position.numpy(), colors, _CLOUD_DOT)

    def add_rows(self, q: Float64[np.ndarray, "rows dof"]) -> None:
        """Draw new rows in grey at the tool of the nominal robot, until all rows are drawn again.

        Args:
            q: joint values [rad or m].
        """
        self._body.draw(self._scene, "/robot", q[-1], LINKS, None)
        self._dots("/rows/new", self._poses(q)[:, :3, 3], UNJUDGED)

    def _arrows(
        self,
        position: Float64[np.ndarray, "rows 3"],
        rows: RowsSoFar,
        colors: UInt8[np.ndarray, "rows 3"],
        magnification: float,
    ) -> None:
        judged, reach = np.isfinite(rows.error).all(axis=1), self._robot.reach
        if not judged.any() or magnification == 0:
            return
        lengths = magnification * np.linalg.norm(rows.error, axis=1, keepdims=True)
        arrow = magnification * rows.error * np.minimum(1.0, _MAX_ARROW * reach / np.maximum(lengths, 1e-12))
        ends = np.stack([position, position + arrow], axis=1)
        if judged.sum() > _MAX_ARROWS:
            both = np.repeat(colors[judged][:, None], 2, axis=1)
            self._scene.add_line_segments("/rows/errors", ends[judged], both, thickness=_SHAFT * reach)
            return
        self._scene.add_arrows(
            "/rows/errors",
            ends[judged],
            colors[judged],
            shaft_radius=_SHAFT * reach,
            head_radius=HEAD * reach,
            head_length=3 * HEAD * reach,
        )

    def _poses(self, q: Float64[np.ndarray, "*batch dof"]) -> Float64[np.ndarray, "*batch 4 4"]:
        """Compute T_base_tool of the nominal robot [m]."""
        T: Float64[np.ndarray, "*batch 4 4"] = forward_kinematics(self._robot, torch.from_numpy(q)).numpy()
        return T

    def _begin(self, name: str) -> None:
        """Clear a group of nodes."""
        if name in self._groups:
            self._groups[name].remove()
        self._groups[name] = self._scene.add_frame(name, show_axes=False)

    def _label(self, name: str, text: str, position: Float64[np.ndarray, " 3"]) -> None:
        self._scene.add_label(name, text, position=position, anchor="bottom-left")

    def _dots(
        self,
        name: str,
        position: Float64[np.ndarray, "points 3"],
        colors: UInt8[np.ndarray, "points 3"] | Color,
        size: float = 1.0,
        shape: Literal["circle", "diamond"] = "circle",
    ) -> None:
        diameter = size * _DOT * self._robot.reach
        self._scene.add_point_cloud(
            name, position, colors, point_size=diameter, point_shape=shape, precision="float32"
        )


def _quaternion(T: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, " 4"]:
    """Return the rotation of a pose as a quaternion, w first."""
    wxyz: Float64[np.ndarray, " 4"] = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
    return wxyz


def draw_board(scene: "viser.SceneApi", name: str, board: Board) -> None:
    """Draw a board in the frame of a node.

    Args:
        scene: scene to draw in.
        name: name of the node.
        board: board to draw.
    """
    left, top, right, bottom = board_sheet(board)
    ends = np.array([[left, top, 0.0], [right, top, 0.0], [right, bottom, 0.0], [left, bottom, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    scene.add_mesh_simple(f"{name}/sheet", ends, faces, color=_SHEET, side="double", cast_shadow=False)
    size = _CORNER_DOT * board.square
    scene.add_point_cloud(f"{name}/corners", board.corners, _PRINT, point_size=size, precision="float32")


def draw_surroundings(
    scene: "viser.SceneApi", surroundings: Surroundings, reach: float, is_movable: bool = False
) -> dict[str, "viser.SceneNodeHandle"]:
    """Draw the surroundings; return the nodes that can be dragged by their keys in the surroundings.

    Args:
        scene: scene to draw in, in the robot's base frame.
        surroundings: surroundings to draw; if there is no floor, the grid is at the height of the robot's base.
        reach: reach of the robot [m].
        is_movable: whether floor (height), boxes (with their yaw), tracker, and camera or board can be dragged.
    """
    edge, fixed, free = _FLOOR * reach, (0.0, 0.0), (-1000.0, 1000.0)
    height = 0.0 if surroundings.floor_mm is None else surroundings.floor_mm / 1e3

    def node(
        name: str, position: Any, wxyz: Any = (1.0, 0.0, 0.0, 0.0), turns: str = "", moves: str = "xyz"
    ) -> Any:
        at: dict[str, Any] = {"position": position, "wxyz": wxyz}
        if not is_movable:
            return scene.add_frame(name, show_axes=False, **at)
        x, y, z = (free if axis in turns else fixed for axis in "xyz")
        along_x, along_y, along_z = (free if axis in moves else fixed for axis in "xyz")
        return scene.add_transform_controls(
            name,
            _HANDLE * reach,
            disable_rotations=not turns,
            active_axes=("x" in moves, "y" in moves, "z" in moves),
            translation_limits=(along_x, along_y, along_z),
            rotation_limits=(x, y, z),
            depth_test=False,
            **at,
        )

    handles = {"floor_mm": node("/floor", (0.0, 0.0, height), moves="z")}
    scene.add_grid("/floor/grid", edge, edge, cell_size=0.25, section_size=1.0)
    for number, box in enumerate(surroundings.boxes):
        name, edges = f"/boxes/{number}", 2 * box.half_size.numpy()
        handles[f"boxes.{number}"] = node(name, box.center.numpy(), _turned(np.deg2rad(box.yaw_deg)), "z")
        scene.add_box(f"{name}/box", FORBIDDEN, edges, opacity=0.35, cast_shadow=False)
        scene.add_label(f"{name}/label", box.name, position=(0, 0, edges[2] / 2), anchor="bottom-center")
    if surroundings.tracker is not None:
        head, size = surroundings.tracker.position.numpy(), _TRACKER_HEAD * reach
        handles["tracker"] = node("/tracker", head)
        scene.add_icosphere("/tracker/head", size, TRACKER)
        if (stand := float(head[2] - height)) > 0:
            scene.add_cylinder("/tracker/stand", size / 3, stand, TRACKER, position=(0, 0, -stand / 2))
        scene.add_label("/tracker/label", "tracker", position=(0, 0, 1.2 * size), anchor="bottom-center")
    if surroundings.view is not None and surroundings.view.T_cell_frame is not None:
        T = surroundings.view.T_cell_frame.numpy()
        handles["view.frame"] = node("/view", T[:3, 3], _quaternion(T), "xyz")
        axes = AXES * reach / 2
        scene.add_frame("/view/axes", axes_length=axes, axes_radius=axes / 20)
        scene.add_label("/view/label", "board, or fixed camera", anchor="bottom-center")
    return handles


def _turned(yaw: float) -> tuple[float, float, float, float]:
    """Return a rotation about z [rad] as a quaternion, w first."""
    return float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))


def draw_line_of_sight(
    scene: "viser.SceneApi",
    name: str,
    surroundings: Surroundings,
    T_base_tool: Float64[np.ndarray, "4 4"],
    reach: float,
) -> None:
    """Draw the beam from the tracker to the reflector, and the acceptance cone of the reflector.

    Args:
        scene: scene to draw in.
        name: name of the parent node.
        surroundings: surroundings with tracker and reflector; if there is no tracker, nothing is drawn.
        T_base_tool: pose of the reflector [m].
        reach: reach of the robot [m].
    """
    if surroundings.tracker is None:
        return
    beam = np.stack([surroundings.tracker.position.numpy(), T_base_tool[:3, 3]])
    scene.add_line_segments(f"{name}/beam", beam[None], SIGHT, thickness=_BEAM * reach)
    if surroundings.reflector is not None:
        cone = acceptance_cone(surroundings.reflector, _CONE * reach).transformed(
            T_base_tool[:3, :3], T_base_tool[:3, 3]
        )
        scene.add_mesh_simple(
            f"{name}/cone",
            cone.points,
            cone.faces,
            color=SIGHT,
            opacity=0.25,
            side="double",
            cast_shadow=False,
        )


def acceptance_cone(reflector: ReflectorSection, length: float) -> Surface:
    """Return the acceptance cone of a reflector in the frame of the tool.

    Args:
        reflector: reflector with axis and acceptance angle.
        length: distance from the tip of the cone to its rim [m].
    """
    half = np.deg2rad(reflector.acceptance_deg)
    cone = revolve(np.array([0.0, length * np.sin(half)]), np.array([0.0, length * np.cos(half)]))
    return cone.transformed(rotation_to(np.array(reflector.axis)), np.zeros(3))
