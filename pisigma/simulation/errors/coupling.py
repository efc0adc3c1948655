"""Errors of a coupling of joints: factors, and lengths of its linkage."""

from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from pisigma.files.errors import RecipeError, RobotError, choice_remedy
from pisigma.robot.coupling_section import CoupledJointSection, coupling_document, rows_and_coupling
from pisigma.robot.description import Robot
from pisigma.simulation.errors.source import AbstractJointSource, JointErrorFunction


class CouplingDeviation(AbstractJointSource):
    """A true coupling of joints that differs from the coupling in the robot's file.

    `e = f_true(C_true q + b_true) - f(C q + b)` with the controller's values q; for example, gears with a different
    ratio, or a parallelogram whose bars differ in length and which is therefore a general four-bar linkage.

    Attributes:
        kind: "coupling".
        coupling: entries that replace the entries in the robot's file for the same joints.
    """

    kind: Literal["coupling"]
    coupling: tuple[CoupledJointSection, ...] = Field(min_length=1)

    def bind(self, robot: Robot, place_in_recipe: str) -> JointErrorFunction:
        """Return the joint errors as a function of the joint values; see `AbstractJointSource.bind`."""
        if robot.coupling is None:
            raise RecipeError(
                f"robot '{robot.name}' has no coupled joints",
                option=place_in_recipe,
                value=robot.name,
                remedy="omit the source",
            )
        stated = {section.joint: section for section in self.coupling}
        nominal = {
            section.joint: section
            for section in map(
                CoupledJointSection.model_validate, coupling_document(robot.coupling, robot.joints)
            )
        }
        if other := sorted(stated.keys() - nominal.keys()):
            raise RecipeError(
                f"joint '{other[0]}' of robot '{robot.name}' is not coupled",
                option=place_in_recipe,
                value=other[0],
                remedy=choice_remedy(other[0], nominal),
            )
        limited = {axis.name: axis for axis in robot.axes}
        rows = [
            limited.get(joint.name, replace(joint, lower=-np.inf, upper=np.inf)) for joint in robot.joints
        ]
        try:
            true = rows_and_coupling(rows, tuple((nominal | stated).values()))[1]
        except RobotError as problem:
            raise RecipeError(f"{place_in_recipe}: {problem}") from None
        assert true is not None

        def error(q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
            moved: Tensor = true.to_dh(robot.to_controller(q)) - q
            return moved

        return error
