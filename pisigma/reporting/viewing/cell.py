"""What stands around the robot: floor, boxes to keep out of, tracker, line of sight and acceptance cone."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from pisigma.planning.surroundings.cell import Cell, ReflectorSection
from pisigma.reporting.viewing.colors import FORBIDDEN, SIGHT, TRACKER
from pisigma.reporting.viewing.surface import Surface, revolve, rotation_to

if TYPE_CHECKING:  # names in full, which type checkers at run time find without these imports
    import viser

FLOOR, HEAD, CONE, BEAM = 5.0, 0.05, 0.2, 0.003
"""Shares of the robot's reach: edge of the floor, radius of the tracker, length of the cone, width of the beam."""


def draw_cell(scene: "viser.SceneApi", cell: Cell, reach: float) -> None:
    """Draw floor, boxes and tracker.

    Args:
        scene: where to, in the robot's base frame.
        cell: the cell; without a floor the grid stands at the height of the robot's base.
        reach: of the robot [m].
    """
    edge = FLOOR * reach
    height = 0.0 if cell.floor_mm is None else cell.floor_mm / 1e3
    scene.add_grid("/floor", edge, edge, cell_size=0.25, section_size=1.0, position=(0.0, 0.0, height))
    for number, box in enumerate(cell.boxes):
        name, center, edges = f"/boxes/{number}", box.center.numpy(), 2 * box.half_size.numpy()
        half = np.deg2rad(box.yaw_deg) / 2
        turned = (np.cos(half), 0.0, 0.0, np.sin(half))
        scene.add_box(name, FORBIDDEN, edges, opacity=0.35, position=center, wxyz=turned, cast_shadow=False)
        top = center + np.array([0.0, 0.0, edges[2] / 2])
        scene.add_label(f"{name}_label", box.name, position=top, anchor="bottom-center")
    if cell.tracker is not None:
        head, size, up = cell.tracker.position.numpy(), HEAD * reach, np.array([0.0, 0.0, 1.0])
        scene.add_icosphere("/tracker", size, TRACKER, position=head)
        if (stand := float(head[2] - height)) > 0:
            scene.add_cylinder("/tracker/stand", size / 3, stand, TRACKER, position=-stand / 2 * up)
        scene.add_label("/tracker/label", "tracker", position=1.2 * size * up, anchor="bottom-center")


def draw_sight(
    scene: "viser.SceneApi", name: str, cell: Cell, T_base_tool: Float64[np.ndarray, "4 4"], reach: float
) -> None:
    """Draw the beam from the tracker to the reflector, and the cone from within which the reflector can be seen.

    Args:
        scene: where to.
        name: of the node that holds both.
        cell: says where the tracker is, and where the reflector looks; nothing is drawn without a tracker.
        T_base_tool: pose of the reflector [m].
        reach: of the robot [m].
    """
    if cell.tracker is None:
        return
    beam = np.stack([cell.tracker.position.numpy(), T_base_tool[:3, 3]])
    scene.add_line_segments(f"{name}/beam", beam[None], SIGHT, thickness=BEAM * reach)
    if cell.reflector is not None:
        cone = acceptance_cone(cell.reflector, CONE * reach).moved(T_base_tool[:3, :3], T_base_tool[:3, 3])
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
    """The cone from within which a reflector can be seen, in the frame of the tool.

    Args:
        reflector: gives its axis and half its angle.
        length: from its tip to its rim [m].
    """
    half = np.deg2rad(reflector.acceptance_deg)
    cone = revolve(np.array([0.0, length * np.sin(half)]), np.array([0.0, length * np.cos(half)]))
    return cone.moved(rotation_to(np.array(reflector.axis)), np.zeros(3))
