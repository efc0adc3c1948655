"""Gears that run out of true: errors that repeat with the angles of the joints."""

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
        joint: the joint that errs.
        amplitude_deg: of a revolute joint [deg].
        amplitude_mm: of a prismatic joint [mm].
        harmonic: m as a multiple of the joint's own angle; of a prismatic joint, of the angle of its screw.
        lead_mm: travel of a prismatic joint per turn of its screw [mm]; goes with `harmonic`.
        joints: instead of `harmonic`, m as a multiple per revolute joint, by name: the gears of a coupled
            wrist turn with sums of joint angles.
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
            raise ValueError("state either amplitude_deg (revolute joint) or amplitude_mm (prismatic joint)")
        if (self.harmonic is None) == (self.joints is None):
            raise ValueError(
                "state either harmonic (of the joint's own angle) or joints (a multiple per joint)"
            )
        if self.lead_mm is not None and self.harmonic is None:
            raise ValueError("lead_mm goes with harmonic; remove it")
        return self


class TransmissionHarmonics(AbstractJointSource):
    """Eccentric or badly cut gears: the joint wobbles once or several times per turn.

    `e_j = Σ A · sin(Σ_i m_i q_i + phase)` over the terms of joint j, with whole numbers m_i and q_i the
    commanded joint angles as the controller counts; for a screw with lead L, m · 2 pi q_j / L takes the place
    of m · q_j.

    Source: Judd and Knasinski, "A technique to calibrate industrial robots with experimental
    verification", IEEE Transactions on Robotics and Automation 6(1), 1990, 20-30 (gear errors as sines of
    the joint angle); Whitney, Lozinski and Rourke, ASME Journal of Dynamic Systems, Measurement, and
    Control 108(1), 1986, 1-8 (errors of gear transmissions).

    Attributes:
        kind: "transmission".
        terms: the sines.
    """

    kind: Literal["transmission"]
    terms: tuple[Harmonic, ...] = Field(min_length=1)

    def bind(self, robot: Robot, place: str) -> JointErrorFunction:
        """The sines as a function of the joint values. See `AbstractJointSource.bind`."""
        places = [f"{place}, terms[{index}]" for index in range(len(self.terms))]
        stated = list(zip(self.terms, places, strict=True))
        # (terms, dof): which joint errs by how much, and the multiples of the joint values inside the sine.
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
    """What every joint value [rad or m] is multiplied by inside the sine."""
    multiple = np.zeros(robot.dof)
    if term.joints is not None:
        for name, value in term.joints.items():
            index = joint_index(robot, name, place)
            if not robot.revolute[index]:
                raise RecipeError(
                    f"{place}: joint '{name}' is prismatic and has no angle; take it out of joints."
                )
            multiple[index] = value
        return multiple
    assert term.harmonic is not None  # the section's validator sees to it
    index = joint_index(robot, term.joint, place)
    if robot.revolute[index] != (term.lead_mm is None):
        remedy = "take lead_mm out" if robot.revolute[index] else "state the lead_mm of its screw"
        raise RecipeError(f"{place}: joint '{term.joint}' is {robot.joints[index].type}; {remedy}.")
    per_turn = 1.0 if term.lead_mm is None else 2 * np.pi / (term.lead_mm / 1e3)
    multiple[index] = term.harmonic * per_turn
    return multiple
