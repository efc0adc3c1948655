"""The parameters of an identification: names, units, expected errors, and how they make up a geometry."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import IdentificationError, nearest_choice
from pisigma.robot.description import DH_COLUMNS, FRAME_COLUMNS, Robot

LENGTHS = frozenset({"d", "a", "x", "y", "z"})
USUAL_LENGTH = 1e-3
"""[m] Scale of length parameters where no prior gives one."""
USUAL_ANGLE = 1e-3
"""[rad]"""


@dataclass(frozen=True)
class Prior:
    """What the maker's tolerances say: standard deviations of the parameters' errors, by class.

    Base and tool have none, they are wherever they were put.

    Attributes:
        theta: joint offsets [rad].
        d: link offsets [m].
        a: link lengths [m].
        alpha: twists [rad].
        beta: Hayati's angles [rad].
    """

    theta: float = 1e-3
    d: float = 1e-3
    a: float = 1e-3
    alpha: float = 1e-3
    beta: float = 1e-3

    def __post_init__(self) -> None:
        """Refuse standard deviations that are none."""
        for name in DH_COLUMNS:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise IdentificationError(
                    f"prior '{name}': a positive standard deviation in {'m' if name in LENGTHS else 'rad'} "
                    f"was wanted, got {value:g}; use prior=None for none."
                )


@dataclass(frozen=True)
class Parameter:
    """One number that can be identified.

    Attributes:
        name: such as "theta_1", "d_EE", "base_x" or, with several targets, "tool_B_x".
        group: "theta", "d", "a", "alpha", "beta", "base" or "tool".
        unit: "m" or "rad".
        owner: the row, frame or target it belongs to.
    """

    name: str
    group: str
    unit: Literal["m", "rad"]
    owner: str

    @property
    def usual_error(self) -> float:
        """A usual size of its error, for scaling: 1 mm or 1 mrad."""
        return USUAL_LENGTH if self.unit == "m" else USUAL_ANGLE


@dataclass(frozen=True, eq=False)
class ParameterSpace:
    """All parameters of a robot measured in some frames with some targets, in their order.

    Attributes:
        robot: the nominal robot.
        frames: names of the measuring frames, each with its own base.
        targets: names of the targets, each with its own tool.
    """

    robot: Robot
    frames: tuple[str, ...] = ("",)
    targets: tuple[str, ...] = ("",)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Rows x (theta, d, a, alpha, beta), frames x base, targets x tool."""
        found = []
        for label, row in zip(row_labels(self.robot), self.robot.rows, strict=True):
            found += [_parameter(column, f"{column}_{label}", column, row.name) for column in DH_COLUMNS]
        for group, owners in (("base", self.frames), ("tool", self.targets)):
            for owner in owners:
                stem = f"{group}_{owner}" if len(owners) > 1 else group
                found += [_parameter(column, f"{stem}_{column}", group, owner) for column in FRAME_COLUMNS]
        return tuple(found)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def arm_size(self) -> int:
        """Number of parameters of the rows, which come first."""
        return 5 * len(self.robot.rows)

    @cached_property
    def usual_errors(self) -> Float64[np.ndarray, " parameters"]:
        """Scale of every parameter [m or rad]."""
        return np.array([parameter.usual_error for parameter in self.parameters])

    def index(self, name: str) -> int:
        """Where a parameter stands.

        Raises:
            IdentificationError: there is none of that name.
        """
        if name not in self.names:
            raise IdentificationError(
                f"robot '{self.robot.name}' has no parameter '{name}'; {nearest_choice(name, self.names)}"
            )
        return self.names.index(name)

    def values(
        self, bases: Float64[np.ndarray, "frames 6"], tools: Float64[np.ndarray, "targets 6"]
    ) -> Float64[Tensor, " parameters"]:
        """All parameters as one vector: the robot's rows, and these bases and tools."""
        return torch.from_numpy(np.concatenate([self.robot.dh.ravel(), bases.ravel(), tools.ravel()]))

    def split(
        self, values: Float64[Tensor, " parameters"]
    ) -> tuple[Float64[Tensor, "rows 5"], Float64[Tensor, "frames 6"], Float64[Tensor, "targets 6"]]:
        """The reverse of `values`: rows, bases, tools."""
        tools = values[len(values) - 6 * len(self.targets) :]
        bases = values[self.arm_size : len(values) - 6 * len(self.targets)]
        return values[: self.arm_size].view(-1, 5), bases.view(-1, 6), tools.view(-1, 6)

    def precision(self, prior: Prior | None) -> Float64[np.ndarray, " parameters"]:
        """1 / variance of every parameter's error before anything is measured; 0 where nothing is known."""
        found = np.zeros(len(self.parameters))
        if prior is not None:
            for index, parameter in enumerate(self.parameters[: self.arm_size]):
                found[index] = getattr(prior, parameter.group) ** -2
        return found


def row_labels(robot: Robot) -> tuple[str, ...]:
    """What names end in: the joint's number, or a fixed row's name ("EE" for an end effector)."""
    labels, joint = [], 0
    for row in robot.rows:
        joint += row.type != "fixed"
        fixed = "EE" if row.name.lower() in ("end_effector", "ee") else row.name
        labels.append(fixed if row.type == "fixed" else str(joint))
    return tuple(labels)


def _parameter(column: str, name: str, group: str, owner: str) -> Parameter:
    return Parameter(name, group, "m" if column in LENGTHS else "rad", owner)
