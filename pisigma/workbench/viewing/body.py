"""Appearance of a robot: capsules along its links, or the meshes of its URDF file."""

import io
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from pisigma.files.errors import Phrase, Place, RobotError
from pisigma.files.input_file import read_input
from pisigma.planning.surroundings.capsules import Capsules
from pisigma.robot.description import Robot
from pisigma.robot.urdf_chain import origin_of, read_chain
from pisigma.robot.urdf_file import parse_xml, read_urdf
from pisigma.robot.urdf_frames import Frame, frame_of, translation
from pisigma.workbench.viewing.colors import Color
from pisigma.workbench.viewing.surface import Surface, capsule, join_surfaces

if TYPE_CHECKING:  # full names can be resolved by type checkers at run time even without these imports
    import trimesh
    import viser


Values = Float64[np.ndarray, " dof"]


class AbstractBody(ABC):
    """Interface of the appearance of a robot, drawn at joint values in the base frame of poses."""

    @abstractmethod
    def draw(
        self, scene: "viser.SceneApi", name: str, q: Values, color: Color, opacity: float | None
    ) -> None:
        """Draw the robot in a scene, and replace the earlier drawing of the same name.

        Args:
            scene: scene to draw in.
            name: name of the robot's node, such as "/robot".
            q: joint values [rad or m].
            color: colour of the links.
            opacity: opacity from 0 to 1; None for opaque.
        """


class CapsuleBody(AbstractBody):
    """Robot that is drawn as the capsules with which plans are checked for collisions."""

    def __init__(self, capsules: Capsules) -> None:
        self._capsules = capsules

    def draw(
        self, scene: "viser.SceneApi", name: str, q: Values, color: Color, opacity: float | None
    ) -> None:
        """Draw one mesh of all capsules of the robot; see `AbstractBody.draw`."""
        segments, radii = self._capsules.segments(torch.from_numpy(q)).numpy(), self._capsules.radius.tolist()
        links = join_surfaces(
            [capsule(start, end, radius) for (start, end), radius in zip(segments, radii, strict=True)]
        )
        scene.add_mesh_simple(name, links.points, links.faces, color=color, opacity=opacity)


class MeshBody(AbstractBody):
    """Meshes of the links of a URDF file, each moved with its joint."""

    def __init__(
        self,
        robot: Robot,
        path: str | os.PathLike[str],
        base: str | None = None,
        tip: str | None = None,
        inside: Path | None = None,
    ):
        """Read the meshes.

        Args:
            robot: robot as loaded from the file.
            path: URDF file.
            base: base link, as in `Robot.load`.
            tip: tool link, as in `Robot.load`.
            inside: folder that contains all meshes that may be read; None for any folder.

        Raises:
            RobotError: the file cannot be used, belongs to another robot or has no visual, or a mesh is missing or has
                an unsupported format.
        """
        chain = read_chain(path, base, tip)
        self._base, self._joints = chain.base, [joint.name for joint in robot.joints]
        if [joint.name for joint in chain.joints] != self._joints:
            raise RobotError(
                expected=f"the joints of robot '{robot.name}': {', '.join(self._joints)}",
                value=Phrase(", ".join(joint.name for joint in chain.joints)),
                at=Place(path),
                remedy="give the file that the robot was loaded from",
            )
        self._urdf, _ = read_urdf(path)
        self.links: dict[str, Surface] = {}
        for element in parse_xml(path).iterchildren("{*}link"):
            if visuals := [
                _surface(visual, Path(path), inside) for visual in element.iterchildren("{*}visual")
            ]:
                self.links[element.get("name")] = join_surfaces(visuals)
        if not self.links:
            raise RobotError("no link has a <visual>", at=Place(path))
        self._drawn: dict[str, viser.MeshHandle] = {}

    def draw(
        self, scene: "viser.SceneApi", name: str, q: Values, color: Color, opacity: float | None
    ) -> None:
        """Draw one mesh per link in the first call, and move the meshes in later calls; see `AbstractBody.draw`."""
        values = dict(zip(self._joints, q.tolist(), strict=True))
        for link, T in self.frames(values).items():
            if link not in self.links:
                continue
            node = f"{name}/{link}"
            if node not in self._drawn:
                surface = self.links[link]
                self._drawn[node] = scene.add_mesh_simple(
                    node,
                    surface.points,
                    surface.faces,
                    color=color,
                    opacity=opacity,
                    side="double",
                    flat_shading=True,
                )
            self._drawn[node].position = T[:3, 3]
            self._drawn[node].wxyz = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)

    def frames(self, values: Mapping[str, float]) -> dict[str, Frame]:
        """Compute the frames of all links after the base link, in the frame of that link [m].

        Args:
            values: joint values by the names of the joints [rad or m]; others are 0.
        """
        frames, parents = {self._base: np.eye(4)}, [self._base]
        while parents:
            parent = parents.pop()
            for name, child in self._urdf.child_map.get(parent, ()):
                joint = self._urdf.joint_map[name]
                if child not in frames:
                    frames[child] = frames[parent] @ origin_of(joint) @ _motion(joint, values.get(name, 0.0))
                    parents.append(child)
        return frames


def _motion(joint: Any, value: float) -> Frame:
    axis = np.array(joint.axis or (1.0, 0.0, 0.0))
    T: Frame = translation(*(value * axis)) if joint.type == "prismatic" else np.eye(4)
    if joint.type in ("revolute", "continuous"):
        T[:3, :3] = Rotation.from_rotvec(value * axis).as_matrix()
    return T


def _surface(visual: Any, path: Path, inside: Path | None) -> Surface:
    """Return the surface of a <visual> in the frame of its link.

    Raises:
        RobotError: the visual cannot be drawn.
    """
    origin = next(visual.iterchildren("{*}origin"), None)
    try:
        shape = next(
            child
            for geometry in visual.iterchildren("{*}geometry")
            for child in geometry.iterchildren("{*}*")
        )
        mesh = _mesh(shape, path, inside)
        xyz, rpy = ([0.0] * 3 if origin is None else _numbers(origin, key, "0 0 0") for key in ("xyz", "rpy"))
        T = frame_of([*xyz, *rpy[::-1]])
    except RobotError:
        raise
    except Exception as problem:  # trimesh raises various exceptions on malformed files
        raise RobotError(
            f"the <visual> cannot be drawn: {type(problem).__name__}: {problem}",
            at=Place(path, visual.sourceline),
        ) from None
    return Surface(mesh.vertices, mesh.faces).transformed(T[:3, :3], T[:3, 3])


def _mesh(shape: Any, path: Path, inside: Path | None) -> "trimesh.Trimesh":
    import trimesh
    from lxml import etree

    mesh: trimesh.Trimesh
    match etree.QName(shape).localname:
        case "box":
            mesh = trimesh.creation.box(_numbers(shape, "size"))
        case "cylinder":
            (radius,), (length,) = _numbers(shape, "radius"), _numbers(shape, "length")
            mesh = trimesh.creation.cylinder(radius, length)
        case "sphere":
            mesh = trimesh.creation.icosphere(radius=_numbers(shape, "radius")[0])
        case _:
            file = _mesh_file(shape.get("filename", ""), path, inside)
            mesh = trimesh.load_mesh(io.BytesIO(read_input(file, RobotError)), file.suffix[1:].lower())
            mesh.apply_transform(np.diag((*_numbers(shape, "scale", "1 1 1"), 1.0)))
    return mesh


def _numbers(element: Any, key: str, default: str = "") -> list[float]:
    return [float(word) for word in element.get(key, default).split()]


def _mesh_file(name: str, path: Path, inside: Path | None) -> Path:
    """Find the file of a mesh; `package://name/...` is searched for in the parent folders of the URDF file.

    Raises:
        RobotError: the file does not exist.
    """
    kind, _, rest = name.rpartition("://")
    folders = path.resolve().parents
    if kind == "package":
        package, _, below = rest.partition("/")
        choices = [folder / rest for folder in folders]
        choices += [folder / below for folder in folders if folder.name == package]
    else:
        choices = [folders[0] / rest]
    for choice in choices:
        is_allowed = inside is None or choice.resolve().is_relative_to(inside.resolve())
        if is_allowed and choice.is_file():
            return choice
    raise RobotError(f"there is no mesh file '{name}'", value=name, at=Place(path))
