"""Transmission errors, which are periodic functions of the joint angles."""

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field, model_validator
from torch import Tensor

from pisigma.files.errors import RecipeError
from pisigma.files.yaml_file import Section
from pisigma.robot.description import Robot
from pisigma.simulation.errors.source import (
    AbstractJointSource,
    JointErrorFunction,
    amplitude_of,
    joint_index,
)


class Harmonic(Section):
    """One sine `amplitude · sin(m · q + phase)` of one joint's error.

    Attributes:
        joint: joint with the error.
        amplitude_deg: amplitude of a revolute joint [deg].
        amplitude_mm: amplitude of a prismatic joint [mm].
        harmonic: multiple m of the joint angle, or of the angle of a prismatic joint's screw.
        lead_mm: travel of a prismatic joint per revolution of its screw [mm], with `harmonic`.
        joints: multiples of the angles of revolute joints by name, instead of `harmonic`: gears of a coupled wrist
            rotate by sums of joint angles.
        phase_deg: phase [deg].
    """

    joint: str
    amplitude_deg: float | None = None
    amplitude_mm: float | None = None
    harmonic: int | None = None
    lead_mm: float | None = Field(default=None, gt=0)
    joints: dict[str, int] | None = None
    phase_deg: float = 0.0

    @model_validator(mode="after")
    def _one_of_each(self) -> "Harmonic":
        if (self.amplitude_deg is None) == (self.amplitude_mm is None):
            raise ValueError(
                "expected either amplitude_deg (revolute joint) or amplitude_mm (prismatic joint)"
            )
        if (self.harmonic is None) == (self.joints is None):
            raise ValueError(
                "expected either harmonic (of the joint's angle) or joints (a multiple per joint)"
            )
        if self.lead_mm is not None and self.harmonic is None:
            raise ValueError("lead_mm applies only to harmonic; remove it")
        return self


class TransmissionHarmonics(AbstractJointSource):
    """Errors of eccentric or inaccurate gears, which repeat one or several times per revolution.

    `e_j = Σ A · sin(Σ_i m_i q_i + phase)` over the terms of joint j, with integers m_i and the commanded joint angles
    q_i of the controller; for a screw with lead L, m · 2 pi q_j / L replaces m · q_j.

    Source: Judd and Knasinski, "A technique to calibrate industrial robots with experimental
    verification", IEEE Transactions on Robotics and Automation 6(1), 1990, 20-30 (gear errors as sines of
    the joint angle); Whitney, Lozinski and Rourke, ASME Journal of Dynamic Systems, Measurement, and
    Control 108(1), 1986, 1-8 (errors of gear transmissions).

    Attributes:
        kind: "transmission".
        terms: terms of the joint errors.
    """

    kind: Literal["transmission"]
    terms: tuple[Harmonic, ...] = Field(min_length=1)

    def bind(self, robot: Robot, place_in_recipe: str) -> JointErrorFunction:
        """Return the joint errors as a function of the joint values; see `AbstractJointSource.bind`."""
        places = [f"{place_in_recipe}, terms[{index}]" for index in range(len(self.terms))]
        stated = list(zip(self.terms, places, strict=True))
        # (terms, dof): amplitudes of the joint errors, and multiples of the joint values inside the sine
        amplitudes = [
            amplitude_of(robot, term.joint, term.amplitude_deg, term.amplitude_mm, where)
            for term, where in stated
        ]
        amplitude = torch.from_numpy(np.stack(amplitudes))
        multiple = torch.from_numpy(np.stack([_multiple(robot, term, where) for term, where in stated]))
        phase = torch.deg2rad(torch.tensor([term.phase_deg for term in self.terms], dtype=torch.float64))

        def error(q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
            angle = (q[..., None, :] * multiple.to(q)).sum(-1) + phase.to(q)
            return (torch.sin(angle)[..., None] * amplitude.to(q)).sum(-2)

        return error


def _multiple(robot: Robot, term: Harmonic, place: str) -> np.ndarray:
    """Return the multiples of the joint values [rad or m] inside the sine."""
    multiple = np.zeros(robot.dof)
    if term.joints is not None:
        for name, value in term.joints.items():
            index = joint_index(robot, name, place)
            if not robot.revolute[index]:
                raise RecipeError(
                    f"joint '{name}' is prismatic and has no angle",
                    option=place,
                    value=name,
                    remedy="remove it from joints",
                )
            multiple[index] = value
        return multiple
    assert term.harmonic is not None  # the validator has checked this
    index = joint_index(robot, term.joint, place)
    if robot.revolute[index] != (term.lead_mm is None):
        remedy = "remove lead_mm" if robot.revolute[index] else "add the lead_mm of its screw"
        kind = robot.joints[index].type
        raise RecipeError(f"joint '{term.joint}' is {kind}", option=place, value=term.joint, remedy=remedy)
    angle_per_unit = 1.0 if term.lead_mm is None else 2 * np.pi / (term.lead_mm / 1e3)
    multiple[index] = term.harmonic * angle_per_unit
    return multiple
