"""What an error source is: a section of a recipe that changes the geometry or the joint values of a robot."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from torch import Tensor

from pisigma.robot.description import Robot
from pisigma.yaml_file import Section

JointErrorFunction = Callable[[Tensor], Tensor]
"""From commanded joint values `(*batch, dof)` to what is added to them [rad or m], of the same shape."""


@dataclass(frozen=True, eq=False)
class GeometryChange:
    """What is added to the geometric parameters of a robot; columns as `DH_COLUMNS` and `FRAME_COLUMNS`.

    Attributes:
        dh: `(rows, 5)` [rad or m].
        base: x, y, z [m], roll, pitch, yaw [rad].
        tool: the same for the tool.
    """

    dh: Float64[np.ndarray, "rows 5"]
    base: Float64[np.ndarray, " 6"]
    tool: Float64[np.ndarray, " 6"]


class AbstractGeometrySource(Section, ABC):
    """An error source that changes geometric parameters; the changes of several sources are added."""

    @abstractmethod
    def change(self, robot: Robot, place: str) -> GeometryChange:
        """What this source adds to the parameters of the nominal robot.

        Args:
            robot: the nominal robot.
            place: where the source stands in its recipe, for complaints.

        Raises:
            RecipeError: the source does not fit the robot.
        """


class AbstractJointSource(Section, ABC):
    """An error source that moves joints away from where they are commanded; several sources are added."""

    @abstractmethod
    def bind(self, robot: Robot, place: str) -> JointErrorFunction:
        """The source as a function of the commanded joint values of one robot.

        Args:
            robot: the nominal robot.
            place: where the source stands in its recipe, for complaints.

        Raises:
            RecipeError: the source does not fit the robot.
        """
