"""A coupling that is not quite what the controller assumes: factors, and lengths of a linkage."""

from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from pisigma.files.errors import RecipeError, RobotError
from pisigma.robot.coupling_section import CoupledJointSection, coupled, coupling_document
from pisigma.robot.description import Robot
from pisigma.simulation.errors.source import AbstractJointSource, JointErrorFunction


class CouplingDeviation(AbstractJointSource):
    """Joints follow the controller's values by another coupling than the one in the robot's file.

    `e = f_true(C_true q + b_true) - f(C q + b)` with q the controller's values: gears of another ratio, and the bars of
    a parallelogram that are not equally long, so that it is a general four-bar linkage.

    Attributes:
        kind: "coupling".
        coupling: entries in the place of those of the robot's file, of the same joints.
    """

    kind: Literal["coupling"]
    coupling: tuple[CoupledJointSection, ...] = Field(min_length=1)

    def bind(self, robot: Robot, place: str) -> JointErrorFunction:
        """The differences as a function of the joint values. See `AbstractJointSource.bind`."""
        if robot.coupling is None:
            raise RecipeError(f"{place}: robot '{robot.name}' has no coupled joints; leave the source out.")
        stated = {section.joint: section for section in self.coupling}
        nominal = {
            section.joint: section
            for section in map(
                CoupledJointSection.model_validate, coupling_document(robot.coupling, robot.joints)
            )
        }
        if other := sorted(stated.keys() - nominal.keys()):
            raise RecipeError(
                f"{place}: joint '{other[0]}' of robot '{robot.name}' is not coupled; name one that is."
            )
        limited = {axis.name: axis for axis in robot.axes}
        rows = [
            limited.get(joint.name, replace(joint, lower=-np.inf, upper=np.inf)) for joint in robot.joints
        ]
        try:
            true = coupled(rows, tuple((nominal | stated).values()))[1]
        except RobotError as problem:
            raise RecipeError(f"{place}: {problem}") from None
        assert true is not None

        def error(q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
            moved: Tensor = true.to_dh(robot.to_controller(q)) - q
            return moved

        return error
