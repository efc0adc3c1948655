"""Named network inputs, computed from a pose and its nominal joint values."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.files.errors import RecipeError, choice_remedy
from pisigma.robot.description import Robot
from pisigma.robot.se3 import zyx_from_rotation

POSE_INPUTS = ("x", "y", "z", "roll", "pitch", "yaw")
"""Names of the coordinates of the pose: x, y, z [m], and angles [rad] of the rotation relative to the reference."""

_FUNCTION = re.compile(r"^(sin|cos)\((.+)\)$")


@dataclass(frozen=True, eq=False)
class Inputs:
    """Named inputs of a network for one robot.

    A name is a coordinate of the pose (`x`, `y`, `z`, `roll`, `pitch`, `yaw`), a joint (`theta_1`: its
    nominal value [rad or m]), or `sin(...)` or `cos(...)` of a sum of revolute joints with optional integer factors
    (`sin(theta_1)`, `cos(theta_2 + theta_3)`, `sin(theta_5 - theta_4)`, `cos(8*theta_1)`).

    Attributes:
        names: names of the inputs in order.
        joint_names: names of the robot's joints.
        reference_rotation: rotation to which roll, pitch and yaw are relative: `R = reference · RotZ · RotY · RotX`.
    """

    names: tuple[str, ...]
    joint_names: tuple[str, ...]
    reference_rotation: Float64[np.ndarray, "3 3"]

    @staticmethod
    def from_names(
        robot: Robot, names: Sequence[str], reference_rotation: Float64[np.ndarray, "3 3"] | None = None
    ) -> "Inputs":
        """Return the inputs with the given names for a robot.

        Raises:
            RecipeError: a name is invalid (the message lists the valid ones), two inputs are the same, or one is a sine
                or cosine of a length.
        """
        joints = tuple(joint.name for joint in robot.joints)
        chosen = Inputs(tuple(names), joints, np.eye(3) if reference_rotation is None else reference_rotation)
        meanings: dict[tuple[str, tuple[float, ...]], str] = {}
        for name in names:
            if name in POSE_INPUTS and name in joints:
                raise RecipeError(
                    f"the network input '{name}' is both a coordinate of the pose and a joint of robot '{robot.name}'",
                    value=name,
                    remedy="rename the joint",
                )
            function, factors = chosen.combination(name)
            meaning = (function if factors else name, tuple(factors))
            if meaning in meanings:
                problem = f"the network inputs '{meanings[meaning]}' and '{name}' are the same"
                raise RecipeError(problem, value=name, remedy="omit one of them")
            meanings[meaning] = name
            if function:
                _check_angle(robot, name, factors)
        return chosen

    def __call__(
        self, T: Float[Tensor, "*batch 4 4"], q: Float[Tensor, "*batch dof"]
    ) -> Float[Tensor, "*batch inputs"]:
        """Compute the unscaled inputs [m, rad or 1].

        Args:
            T: poses T_base_tool [m].
            q: nominal joint values of the poses [rad or m].
        """
        zyx: tuple[Tensor, ...] = ()
        if set(self.names) & set(POSE_INPUTS[3:]):
            reference = torch.as_tensor(self.reference_rotation, dtype=T.dtype, device=T.device)
            zyx = zyx_from_rotation(reference.mT @ T[..., :3, :3]).unbind(-1)
        columns = []
        for name in self.names:
            if name in POSE_INPUTS:
                index = POSE_INPUTS.index(name)
                columns.append(T[..., index, 3] if index < 3 else zyx[index - 3])
                continue
            function, factors = self.combination(name)
            angle = q @ torch.tensor(factors, dtype=q.dtype, device=q.device)
            columns.append({"sin": torch.sin, "cos": torch.cos}[function](angle) if function else angle)
        return torch.stack(columns, -1)

    def combination(self, name: str) -> tuple[str, list[float]]:
        """Return the function of an input ("" for none) and its integer factors by joint (none for a coordinate).

        Raises:
            RecipeError: the name is not valid.
        """
        if name in POSE_INPUTS:
            return "", []
        factors = [0.0] * len(self.joint_names)
        if name in self.joint_names:
            factors[self.joint_names.index(name)] = 1.0
            return "", factors
        match = _FUNCTION.match(name)
        if not match:
            raise self._unknown(name)
        function, argument = match.groups()
        for factor, term in self._terms(argument, name):
            factors[self.joint_names.index(term)] += factor
        return function, factors

    def _terms(self, argument: str, name: str) -> list[tuple[float, str]]:
        """Return the factor and joint of every term of a sum, which must be parsed completely."""
        joints = "|".join(re.escape(joint) for joint in sorted(self.joint_names, key=len, reverse=True))
        rest = argument
        terms: list[tuple[float, str]] = []
        while match := re.match(
            rf"\s*({'[+-]' if terms else '[+-]?'})\s*(?:([1-9][0-9]{{0,3}})\s*\*\s*)?({joints})\s*", rest
        ):
            terms.append((float(match[1] + (match[2] or "1")), match[3]))
            rest = rest[match.end() :]
        if rest or not terms:
            raise self._unknown(name)
        return terms

    def _unknown(self, name: str) -> RecipeError:
        functions = [f"{f}({joint})" for f in ("sin", "cos") for joint in self.joint_names]
        choices = [*POSE_INPUTS, *self.joint_names, *functions]
        hint = choice_remedy(name, choices)
        return RecipeError(f"unknown network input '{name}'", value=name, remedy=hint)


def _check_angle(robot: Robot, name: str, factors: Sequence[float]) -> None:
    """Check that the argument of a sine or cosine is a variable angle."""
    for joint, factor in zip(robot.joints, factors, strict=True):
        if factor and joint.type == "prismatic":
            raise RecipeError(
                f"the network input '{name}' is a function of an angle, but joint '{joint.name}' is prismatic",
                expected="a revolute joint",
                value=name,
                remedy=f"use '{joint.name}' itself",
            )
    if not any(factors):
        problem = f"the network input '{name}' is the same for all joint values"
        raise RecipeError(problem, expected="a variable angle", value=name, remedy="omit it")
