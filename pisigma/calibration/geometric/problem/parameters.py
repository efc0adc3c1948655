"""Parameters of an identification: names, units, prior, and their arrangement in one vector."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.prior_scales import PriorGroup, prior_group_of
from pisigma.files.errors import IdentificationError, choice_remedy
from pisigma.measurement.sensors.sensor import ParameterUnit, UnknownGroup, Unknowns
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.parameter_jacobian import parameter_order
from pisigma.robot.row import DH_COLUMNS, FRAME_COLUMNS

LENGTHS = frozenset({"d", "a", "x", "y", "z"})
EVERYWHERE, _NOWHERE = -1, -2
"""Values instead of the index of a frame or target: the parameter moves the tool in all rows, or in no row."""
USUAL_LENGTH = 1e-3
"""Scale of length parameters without a prior [m]."""
USUAL_ANGLE = 1e-3
"""Scale of angle parameters without a prior [rad]."""
_USUAL_ERRORS: dict[ParameterUnit, float] = {"m": USUAL_LENGTH, "rad": USUAL_ANGLE, "px": 1.0, "1": 1e-3}
_SMALLEST_PRIOR = 1e-12
"""Smallest prior standard deviation [m or rad]; parameters that are more certain should not be in `free`."""

PriorScaling = Literal["stated", "widened", "estimated"]
"""Whether the prior scales are 1, at least 1, or estimated without bounds."""


@dataclass(frozen=True)
class Prior:
    """Prior of the geometric errors from manufacturing tolerances: standard deviations by kind of parameter.

    Base and tool have no prior.

    Attributes:
        theta: standard deviation of joint offsets [rad].
        d: standard deviation of link offsets [m].
        a: standard deviation of link lengths [m].
        alpha: standard deviation of twists [rad].
        beta: standard deviation of Hayati's angles [rad].
    """

    theta: float = 1e-3
    d: float = 1e-3
    a: float = 1e-3
    alpha: float = 1e-3
    beta: float = 1e-3

    def __post_init__(self) -> None:
        """Refuse invalid standard deviations."""
        for name in DH_COLUMNS:
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= _SMALLEST_PRIOR):
                unit = "m" if name in LENGTHS else "rad"
                raise IdentificationError(
                    option=f"prior '{name}'",
                    expected=f"a standard deviation >= {_SMALLEST_PRIOR:g} {unit}",
                    value=value,
                    remedy="use prior=None for no prior",
                )


@dataclass(frozen=True)
class Parameter:
    """One parameter that can be identified.

    Attributes:
        name: name, such as "theta_1", "d_EE", "base_x" or, with several targets, "tool_B_x".
        group: "theta", "d", "a", "alpha", "beta", "base", "tool", or a group of a sensor's unknowns, such as "socket".
        unit: "m", "rad", "px", or "1" for a number without unit.
        owner: row, frame, target or object (such as a socket) to which the parameter belongs.
    """

    name: str
    group: str
    unit: ParameterUnit
    owner: str

    @property
    def usual_error(self) -> float:
        """Usual size of the parameter's error, for scaling: 1 mm, 1 mrad, 1 px or 1e-3."""
        return _USUAL_ERRORS[self.unit]


@dataclass(frozen=True, eq=False)
class ParameterSpace:
    """All parameters of a robot that is measured in given frames with given targets, in a fixed order.

    Attributes:
        robot: the nominal robot.
        frames: names of the measuring frames; every frame has a base.
        targets: names of the targets; every target has a tool.
        unknowns: unknowns of the sensors, such as the positions of sockets.
    """

    robot: Robot
    frames: tuple[str, ...] = ("",)
    targets: tuple[str, ...] = ("",)
    unknowns: tuple[UnknownGroup, ...] = ()

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """All parameters: those of the rows, then of bases and tools, then the unknowns of sensors by group."""
        parameters = []
        for label, row in zip(row_labels(self.robot), self.robot.rows, strict=True):
            parameters += [_parameter(column, f"{column}_{label}", column, row.name) for column in DH_COLUMNS]
        for group, owners in (("base", self.frames), ("tool", self.targets)):
            for owner in owners:
                stem = f"{group}_{owner}" if len(owners) > 1 else group
                parameters += [
                    _parameter(column, f"{stem}_{column}", group, owner) for column in FRAME_COLUMNS
                ]
        for own in self.unknowns:
            for owner in own.owners:
                parameters += [
                    Parameter(
                        f"{own.name}_{owner}_{column}",
                        own.name,
                        own.unit(column),
                        owner,
                    )
                    for column in own.columns
                ]
        return tuple(parameters)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def arm_parameter_count(self) -> int:
        """Number of parameters of the rows, which come first."""
        return 5 * len(self.robot.rows)

    @cached_property
    def usual_errors(self) -> Float64[np.ndarray, " parameters"]:
        """Scale of every parameter [m or rad]."""
        return np.array([parameter.usual_error for parameter in self.parameters])

    @cached_property
    def motion_columns(self) -> Int64[Tensor, "3 parameters"]:
        """Per parameter, the column in a `ToolMotion`, the index of the frame and the index of the target."""
        order = parameter_order(len(self.robot.rows))
        arm, frames, targets = order[:-12], len(self.frames), len(self.targets)
        others = len(self.parameters) - len(arm) - 6 * (frames + targets)
        columns = arm + order[-12:-6] * frames + order[-6:] * targets + [0] * others
        in_frames = [f for f in range(frames) for _ in range(6)]
        at_targets = [t for t in range(targets) for _ in range(6)]
        frame = [EVERYWHERE] * len(arm) + in_frames + [EVERYWHERE] * 6 * targets + [_NOWHERE] * others
        target = [EVERYWHERE] * (len(arm) + 6 * frames) + at_targets + [_NOWHERE] * others
        return torch.tensor([columns, frame, target])

    @cached_property
    def is_length(self) -> Bool[Tensor, " parameters"]:
        """Mask of the parameters that are lengths."""
        return torch.tensor([parameter.unit == "m" for parameter in self.parameters])

    @cached_property
    def prior_groups(self) -> Int64[Tensor, "2 parameters"]:
        """Prior group of every parameter, for nominal values of 0 and for other values; see `prior_group_of`."""
        others = [int(PriorGroup.JOINT_OFFSET)] * (len(self.parameters) - self.arm_parameter_count)
        of_row = ([prior_group_of(column, nonzero) for column in DH_COLUMNS] for nonzero in (False, True))
        return torch.tensor([groups * len(self.robot.rows) + others for groups in of_row])

    @property
    def moves_in_all_rows(self) -> bool:
        """Mask of the parameters that move the tool in all rows."""
        return len(self.frames) == len(self.targets) == 1 and not self.unknowns

    def max_identifiable(self, with_orientation: bool) -> int:
        """Return the largest number of identifiable parameters of arm, bases and tools, for any measurements.

        A revolute axis is a line in space (4 parameters), a prismatic axis a direction (2), a target a pose (6) or a
        point (3), and every frame except the first a pose (6). With one frame and one pose this is `4 R + 2 P + 6`
        for R revolute and P prismatic joints (Everett, Driels and Mooring 1987, ICRA).

        Args:
            with_orientation: whether the orientation of the tool is measured.
        """
        axes = sum(2 if joint.type == "prismatic" else 4 for joint in self.robot.joints)
        return axes + (6 if with_orientation else 3) * len(self.targets) + 6 * (len(self.frames) - 1)

    def index(self, name: str) -> int:
        """Return the index of a parameter.

        Raises:
            IdentificationError: there is no parameter with this name.
        """
        if name not in self._numbers:
            raise IdentificationError(
                f"robot '{self.robot.name}' has no parameter '{name}'",
                value=name,
                remedy=choice_remedy(name, self.names),
            )
        return self._numbers[name]

    @cached_property
    def _numbers(self) -> dict[str, int]:
        return {name: number for number, name in enumerate(self.names)}

    def indices(self, name: str) -> list[int]:
        """Return the indices of a parameter; with several frames or targets, "base_x" and "tool_x" stand for all.

        Raises:
            IdentificationError: there is no parameter with this name.
        """
        group, _, column = name.partition("_")
        several = {"base": len(self.frames) > 1, "tool": len(self.targets) > 1}.get(group, False)
        if name in self.names or not several or column not in FRAME_COLUMNS:
            return [self.index(name)]
        return list(self.indices_of(group))[FRAME_COLUMNS.index(column) :: 6]

    def indices_of(self, group: str) -> range:
        """Return the indices of all parameters of a group: "base", "tool", or a group of sensors' unknowns."""
        return self._ranges[group]

    @cached_property
    def _ranges(self) -> dict[str, range]:
        sizes = {"base": 6 * len(self.frames), "tool": 6 * len(self.targets)}
        sizes |= {own.name: len(own.columns) * len(own.owners) for own in self.unknowns}
        start, stretches = self.arm_parameter_count, {}
        for name, size in sizes.items():
            stretches[name] = range(start, start + size)
            start += size
        return stretches

    def values(
        self,
        bases: Float64[np.ndarray, "frames 6"],
        tools: Float64[np.ndarray, "targets 6"],
        unknowns: Mapping[str, Float64[np.ndarray, "owners columns"]] = MappingProxyType({}),
    ) -> Float64[Tensor, " parameters"]:
        """Return a vector of all parameters: the robot's rows and the given values; missing unknowns are 0."""
        blocks = [self.robot.dh, bases, tools]
        for own in self.unknowns:
            blocks.append(unknowns.get(own.name, np.zeros((len(own.owners), len(own.columns)))))
        return torch.from_numpy(np.concatenate([block.ravel() for block in blocks]))

    def split(
        self, values: Float64[Tensor, " parameters"]
    ) -> tuple[
        Float64[Tensor, "rows 5"],
        Float64[Tensor, "frames 6"],
        Float64[Tensor, "targets 6"],
    ]:
        """Return rows, bases and tools in a vector of all parameters."""
        bases, tools = (
            values[self.indices_of(group).start : self.indices_of(group).stop] for group in ("base", "tool")
        )
        return values[: self.arm_parameter_count].view(-1, 5), bases.view(-1, 6), tools.view(-1, 6)

    def sensor_unknowns(self, values: Float64[Tensor, " parameters"]) -> Unknowns:
        """Return the sensors' unknowns in a vector of all parameters."""
        return {
            own.name: values[self.indices_of(own.name).start : self.indices_of(own.name).stop]
            .view(-1, len(own.columns))
            .t()
            for own in self.unknowns
        }

    def indices_in_group(
        self, group: str, active: Int64[Tensor, " active"]
    ) -> tuple[Int64[Tensor, " own"], Int64[Tensor, " own"], Int64[Tensor, " own"]]:
        """Return position, owner's index and column of the active parameters in a group of unknowns."""
        size = next(len(own.columns) for own in self.unknowns if own.name == group)
        stretch = self.indices_of(group)
        positions = ((active >= stretch.start) & (active < stretch.stop)).nonzero()[:, 0]
        number = active[positions] - stretch.start
        return positions, number // size, number % size

    def precision(self, prior: Prior | None) -> Float64[np.ndarray, " parameters"]:
        """Return the prior precision (1 / variance) of every parameter; 0 for parameters without a prior."""
        precision = np.zeros(len(self.parameters))
        if prior is not None:
            of_row = [getattr(prior, column) ** -2 for column in DH_COLUMNS]
            precision[: self.arm_parameter_count] = np.tile(of_row, len(self.robot.rows))
        return precision


def row_labels(robot: Robot) -> tuple[str, ...]:
    """Return the suffixes of parameter names: the joint number, or a fixed row's name ("EE" for an end effector)."""
    labels, joint = [], 0
    for row in robot.rows:
        joint += row.type != "fixed"
        fixed = "EE" if row.name.lower() in ("end_effector", "ee") else row.name
        labels.append(fixed if row.type == "fixed" else str(joint))
    return tuple(labels)


def direction_by_zero_parameter(robot: Robot) -> dict[str, int]:
    """Return the direction of every joint by the name of the parameter that is its zero, such as "theta_2".

    The zero of a joint with the direction -1 moves against the joint if the parameter increases.
    """
    columns = ("theta" if joint.type == "revolute" else "d" for joint in robot.joints)
    return {
        f"{column}_{number}": int(robot.directions[number - 1]) for number, column in enumerate(columns, 1)
    }


def _parameter(column: str, name: str, group: str, owner: str) -> Parameter:
    return Parameter(name, group, "m" if column in LENGTHS else "rad", owner)
