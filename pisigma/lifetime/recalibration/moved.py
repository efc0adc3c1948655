"""What has moved since a calibration, by how much, and how sure that is."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.estimation.drift import DriftGroup
from pisigma.lifetime.recalibration.adaptation import Adaptation
from pisigma.lifetime.recalibration.recalibration_problem import RecalibrationProblem, frame_stretch
from pisigma.measurement.sensors.sensor import SHOWN_UNITS, ShownUnit
from pisigma.robot.se3 import rotation_vector, transform_from_xyzrpy

CLEAR = 3.3
"""[standard deviations] What moved by less is not told from chance: one in 1,000 of what did not move."""
NORMAL_95 = 1.959964


@dataclass(frozen=True)
class Moved:
    """One thing that moved.

    Attributes:
        what: such as "joint 3", "a_2", "base" or "tool".
        shift: by how much; of a base or a tool how far its origin, or by what angle it turned.
        deviation: its standard deviation.
        unit: of both.
    """

    what: str
    shift: float
    deviation: float
    unit: ShownUnit

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the shift."""
        half = NORMAL_95 * self.deviation
        return self.shift - half, self.shift + half

    @property
    def size(self) -> str:
        """The shift with half its 95 % interval and the unit."""
        half = NORMAL_95 * self.deviation
        digits = min(max(1 - math.floor(math.log10(max(half, 1e-6))), 0), 4)
        shown = max(half, 10.0**-digits)  # never an uncertainty of 0
        return f"{self.shift:.{digits}f} ± {shown:.{digits}f} {self.unit}"

    @property
    def sentence(self) -> str:
        """It in words, with half the 95 % interval."""
        return f"{self.what} moved by {self.size}"

    def to_json(self) -> dict[str, object]:
        """Return it as plain values, the unit in the name of the shift."""
        return {"what": self.what, f"shift_{self.unit}": self.shift, "interval": list(self.interval)}


def moved_by(adaptation: Adaptation) -> tuple[Moved, ...]:
    """Give what moved clearly: joints first, then lengths and angles of the arm, bases and tools.

    A joint's shift is estimated with no prior, beside all else that has drifted, and counts in the joint's positive
    direction: by so much the joint stands beyond the value that its controller shows.
    """
    moved: list[Moved] = []
    for number, group in enumerate(adaptation.drift.groups):
        if group.size and group.what.split()[0] in ("base", "tool", "joint", "lengths", "angles"):
            estimate = adaptation.search.shift(number, held=not group.what.startswith("joint"))
            moved += moved_of_group(adaptation.problem, adaptation.arm.geometry, group, *estimate)
    return tuple(one for one in moved if abs(one.shift) > CLEAR * one.deviation)


def moved_of_group(
    problem: RecalibrationProblem,
    after: IdentifiedGeometry,
    group: DriftGroup,
    shift: Float64[Tensor, " members"],
    covariance: Float64[Tensor, "members members"],
) -> list[Moved]:
    """Give the motion of parameters of the arm, one by one, or of a base or a tool.

    Args:
        problem: of the rows.
        after: the geometry with what moved.
        group: that moved.
        shift: of its unknowns [m or rad].
        covariance: of the shift.
    """
    kind, _, name = group.what.partition(" ")
    if kind in ("base", "tool"):
        return _of_frame(problem, after, group, name, shift, covariance)
    space, moved = problem.design.problem.space, []
    for index, by, variance in zip(group.index, shift, covariance.diagonal(), strict=True):
        parameter = space.parameters[int(index)]
        unit, factor = SHOWN_UNITS[parameter.unit]
        what, sign = parameter.name, 1
        if kind == "joint":
            what, sign = group.what, int(space.robot.directions[int(name) - 1])
        moved.append(Moved(what, sign * float(by) * factor, float(variance) ** 0.5 * factor, unit))
    return moved


def what_moved(moved: tuple[Moved, ...]) -> str:
    """Say in a sentence what moved."""
    if not moved:
        return "Nothing moved beyond its uncertainty."
    clauses = "; ".join(one.sentence for one in moved)
    return f"{clauses[:1].upper()}{clauses[1:]}; nothing else moved beyond its uncertainty."


def _of_frame(
    problem: RecalibrationProblem,
    geometry: IdentifiedGeometry,
    group: DriftGroup,
    name: str,
    shift: Float64[Tensor, " members"],
    of_members: Float64[Tensor, "members members"],
) -> list[Moved]:
    """How far a base or a tool has moved, and by what angle it has turned."""
    space, kind = problem.design.problem.space, group.what.split()[0]
    before, after = (
        one.bases if kind == "base" else one.tools for one in (problem.posterior.geometry, geometry)
    )
    name = name or next(iter(after))
    if name not in before:
        return []
    column = group.index - frame_stretch(space, kind, name).start
    motion, covariance = torch.zeros(6).double(), torch.zeros(6, 6).double()
    motion[column], covariance[column[:, None], column] = shift, of_members
    if group.stands:  # the shift is that from the guess
        old, new = (transform_from_xyzrpy(torch.from_numpy(np.asarray(one[name]))) for one in (before, after))
        turn = rotation_vector(new[:3, :3] @ old[:3, :3].mT)
        motion = torch.cat([new[:3, 3] - old[:3, 3], turn])
        if kind == "base":
            motion = (
                motion.view(2, 3) @ problem.setup.anchors.bases[space.frames.index(name), :3, :3]
            ).flatten()
    return [
        Moved(group.what, float(vector.norm()) * factor, deviation_along(vector, block) * factor, unit)
        for vector, block, (unit, factor) in (
            (motion[:3], covariance[:3, :3], SHOWN_UNITS["m"]),
            (motion[3:], covariance[3:, 3:], SHOWN_UNITS["rad"]),
        )
    ]


def deviation_along(vector: Float64[Tensor, " 3"], covariance: Float64[Tensor, "3 3"]) -> float:
    """Standard deviation along a vector, or at most where it has no length."""
    length = float(vector.norm())
    if length > 0.0:
        return math.sqrt(float(vector @ covariance @ vector)) / length
    return math.sqrt(max(float(torch.linalg.eigvalsh(covariance)[-1]), 0.0))
