"""Movements of joint zeros, parameters, bases and tools since a calibration, with their uncertainties."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Float64
from pydantic import AliasChoices, BeforeValidator, Field, PlainSerializer
from torch import Tensor

from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.estimation.drift import DriftGroup
from pisigma.lifetime.recalibration.adaptation import Adaptation
from pisigma.lifetime.recalibration.recalibration_problem import RecalibrationProblem, frame_slice
from pisigma.measurement.sensors.sensor import SHOWN_UNITS, ShownUnit
from pisigma.robot.se3 import rotation_vector, transform_from_xyz_zyx

CLEAR = 3.3
"""Standard deviations above which a movement is significant: chance exceeds them in one of 1,000 cases."""
NORMAL_95 = 1.959964
"""Half-width of the 95 % interval of a normal distribution [standard deviations]."""
_CLEAR_DISTANCE, _DISTANCE_95 = 4.033, 3.058
"""Values that the length of a normal vector with three components exceeds in one of 1,000 and in 2.5 % of all cases
[standard deviations]; this length is positive even if nothing moved."""


@dataclass(frozen=True)
class Movement:
    """Movement of one joint zero, parameter, base or tool between two times or two models.

    Attributes:
        what: name of what moved, such as "joint 3", "a_2", "base" or "tool".
        shift: signed change of a joint zero or parameter [`unit`]; a joint zero counts in the positive direction of the
            joint. For a base or a tool, the distance between its origins or the angle of its rotation.
        sigma: standard deviation of the shift [`unit`].
        unit: "mm" or "deg"; a base or a tool has a movement in each unit.
        probability: posterior probability of this explanation among all others; None if it was not computed.
    """

    what: str
    shift: float
    sigma: Annotated[
        float, Field(validation_alias=AliasChoices("deviation", "sigma"), serialization_alias="deviation")
    ]
    unit: ShownUnit
    probability: float | None = None

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of the shift [`unit`]."""
        return self.shift - self.half_width, self.shift + self.half_width

    @property
    def half_width(self) -> float:
        """Half-width of the 95 % interval [`unit`], which contains 0 if chance explains the shift of a base or tool."""
        half, may_be_zero = NORMAL_95 * self.sigma, self.shift < _DISTANCE_95 * self.sigma
        return max(half, self.shift) if is_frame(self.what) and may_be_zero else half

    @property
    def is_significant(self) -> bool:
        """Whether chance exceeds the shift in less than one of 1,000 cases."""
        return abs(self.shift) > (_CLEAR_DISTANCE if is_frame(self.what) else CLEAR) * self.sigma

    @property
    def shift_text(self) -> str:
        """Shift, half-width of its 95 % interval and unit, such as "0.25 ± 0.01 deg"."""
        half = self.half_width
        digits = min(max(1 - math.floor(math.log10(max(half, 1e-6))), 0), 4)
        shown = max(half, 10.0**-digits)  # never an uncertainty of 0
        return f"{self.shift:.{digits}f} ± {shown:.{digits}f} {self.unit}"

    @property
    def sentence(self) -> str:
        """Clause, such as "joint 3 moved by 0.25 ± 0.01 deg"."""
        return f"{self.what} moved by {self.shift_text}"

    def to_json(self) -> dict[str, object]:
        """Return plain values; the key of the shift ends with the unit: `shift_mm` or `shift_deg`."""
        plain = {"what": self.what, f"shift_{self.unit}": self.shift, "interval": list(self.interval)}
        return plain if self.probability is None else plain | {"probability": self.probability}


def _fields(stored: Any) -> Any:
    """Convert stored forms of a movement to its fields: that of `to_json`, and that of earlier histories."""
    if not isinstance(stored, Mapping):
        return stored
    if isinstance(stored.get("moved"), Mapping):  # histories nested the movement in its probability
        return {**stored["moved"], "probability": stored.get("probability")}
    key = next((key for key in stored if key.startswith("shift_") and stored[key] is not None), None)
    if key is None or "interval" not in stored:
        return stored
    low, high = stored["interval"]
    deviation = (high - low) / (2 * NORMAL_95)
    fields = {"what": stored.get("what"), "shift": stored[key], "deviation": deviation}
    return fields | {"unit": key.removeprefix("shift_"), "probability": stored.get("probability")}


HistoryMovement = Annotated[Movement, BeforeValidator(_fields)]
"""Type of a movement that a history stores by its fields."""
SummaryMovement = Annotated[Movement, BeforeValidator(_fields), PlainSerializer(Movement.to_json)]
"""Type of a movement that a model folder stores as `Movement.to_json`."""


def is_frame(moved_name: str) -> bool:
    """Return whether something that moved is a base or a tool."""
    return moved_name.split()[0] in ("base", "tool")


def significant_movements(adaptation: Adaptation) -> tuple[Movement, ...]:
    """Return the significant movements: joints, then lengths and angles, then bases and tools.

    The shift of a joint zero is estimated without a prior, together with everything else that has drifted. It is
    positive in the positive direction of the joint: a joint with a shift of 0.1 deg is 0.1 deg beyond the value that
    its controller displays.
    """
    moved: list[Movement] = []
    for number, group in enumerate(adaptation.drift.groups):
        if group.drift_size and group.name.split()[0] in ("base", "tool", "joint", "lengths", "angles"):
            estimate = adaptation.search.estimate_shift(number, with_prior=not group.name.startswith("joint"))
            moved += movements_of_group(adaptation.problem, adaptation.arm.geometry, group, *estimate)
    return tuple(one for one in moved if one.is_significant)


def movements_of_group(
    problem: RecalibrationProblem,
    after: IdentifiedGeometry,
    group: DriftGroup,
    shift: Float64[Tensor, " members"],
    covariance: Float64[Tensor, "members members"],
) -> list[Movement]:
    """Return the movements of a group: one per arm parameter, or a distance and an angle of a base or a tool.

    Args:
        problem: recalibration problem to which the group belongs.
        after: geometry after the movement.
        group: group that moved.
        shift: shifts of the unknowns of the group [m or rad].
        covariance: their covariance [m or rad, squared].
    """
    kind, _, name = group.name.partition(" ")
    if kind in ("base", "tool"):
        return _of_frame(problem, after, group, name, shift, covariance)
    space, moved = problem.design.problem.space, []
    for index, by, variance in zip(group.index, shift, covariance.diagonal(), strict=True):
        parameter = space.parameters[int(index)]
        unit, factor = SHOWN_UNITS[parameter.unit]
        what, sign = parameter.name, 1
        if kind == "joint":
            what, sign = group.name, int(space.robot.directions[int(name) - 1])
        moved.append(Movement(what, sign * float(by) * factor, float(variance) ** 0.5 * factor, unit))
    return moved


def movements_text(movements: tuple[Movement, ...]) -> str:
    """Return a sentence about significant movements."""
    if not movements:
        return "Nothing moved beyond its uncertainty."
    clauses = "; ".join(one.sentence for one in movements)
    return f"{clauses[:1].upper()}{clauses[1:]}; nothing else moved beyond its uncertainty."


def _of_frame(
    problem: RecalibrationProblem,
    geometry: IdentifiedGeometry,
    group: DriftGroup,
    name: str,
    shift: Float64[Tensor, " members"],
    of_members: Float64[Tensor, "members members"],
) -> list[Movement]:
    """Return the movements of a base or a tool: distance and angle."""
    space, kind = problem.design.problem.space, group.name.split()[0]
    before, after = (
        one.bases if kind == "base" else one.tools for one in (problem.posterior.geometry, geometry)
    )
    name = name or next(iter(after))
    if name not in before:
        return []
    column = group.index - frame_slice(space, kind, name).start
    motion, covariance = torch.zeros(6).double(), torch.zeros(6, 6).double()
    motion[column], covariance[column[:, None], column] = shift, of_members
    if group.fixed_size:  # relocated: `shift` is relative to the initial guess, not to the frame of the model
        old, new = (
            transform_from_xyz_zyx(torch.from_numpy(np.asarray(one[name]))) for one in (before, after)
        )
        turn = rotation_vector(new[:3, :3] @ old[:3, :3].mT)
        motion = torch.cat([new[:3, 3] - old[:3, 3], turn])
        if kind == "base":
            motion = (
                motion.view(2, 3) @ problem.setup.reference_frames.bases[space.frames.index(name), :3, :3]
            ).flatten()
    return [
        Movement(group.name, float(vector.norm()) * factor, sigma_along(vector, block) * factor, unit)
        for vector, block, (unit, factor) in (
            (motion[:3], covariance[:3, :3], SHOWN_UNITS["m"]),
            (motion[3:], covariance[3:, 3:], SHOWN_UNITS["rad"]),
        )
    ]


def sigma_along(vector: Float64[Tensor, " 3"], covariance: Float64[Tensor, "3 3"]) -> float:
    """Compute the standard deviation along a vector; the largest of all directions if the vector is 0."""
    length = float(vector.norm())
    if length > 0.0:
        return math.sqrt(float(vector @ covariance @ vector)) / length
    return math.sqrt(max(float(torch.linalg.eigvalsh(covariance)[-1]), 0.0))
