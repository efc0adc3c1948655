"""What a robot looks like: capsules along its links, or the meshes of the URDF file that it was loaded from."""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float64

from pisigma.planning.surroundings.capsules import Capsules
from pisigma.reporting.viewing.colors import Color
from pisigma.reporting.viewing.surface import capsule, joined

if TYPE_CHECKING:  # names in full, which type checkers at run time find without these imports
    import viser


class AbstractBody(ABC):
    """Something that draws a robot at joint values, in the frame that poses are given in."""

    @abstractmethod
    def draw(
        self,
        scene: "viser.SceneApi",
        name: str,
        q: Float64[np.ndarray, " dof"],
        color: Color,
        opacity: float | None,
    ) -> None:
        """Draw the robot in place of what was drawn under the name before.

        Args:
            scene: where to.
            name: of the node that holds the robot, such as "/robot".
            q: joint values [rad or m].
            color: of the links.
            opacity: 0 to 1; None for what nothing shines through.
        """


class CapsuleBody(AbstractBody):
    """The robot as the capsules that plans are checked with."""

    def __init__(self, capsules: Capsules) -> None:
        self._capsules = capsules

    def draw(
        self,
        scene: "viser.SceneApi",
        name: str,
        q: Float64[np.ndarray, " dof"],
        color: Color,
        opacity: float | None,
    ) -> None:
        """Draw one mesh of all capsules; see `AbstractBody.draw`."""
        segments, radii = self._capsules.segments(torch.from_numpy(q)).numpy(), self._capsules.radius.tolist()
        links = joined(
            [capsule(start, end, radius) for (start, end), radius in zip(segments, radii, strict=True)]
        )
        scene.add_mesh_simple(name, links.points, links.faces, color=color, opacity=opacity)
