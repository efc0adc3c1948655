"""Feature for lines of high order in the error spectrum of gears and motors."""

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Float64
from pydantic import Field
from torch import Tensor

from pisigma.joint_correction.feature import (
    AbstractFeature,
    FeatureOptions,
    FeatureSection,
    angle_per_joint_value,
)
from pisigma.joint_correction.fourier_series import add_harmonics, sines_cosines
from pisigma.joint_correction.onnx_graph import OnnxGraph
from pisigma.measurement.conditions import JointState
from pisigma.robot.description import Robot
from pisigma.robot.kernels.forms import CompiledForm


class LinesSection(FeatureSection):
    """Section of the lines of every joint in the description of a model."""

    name: Literal["lines"]
    orders: tuple[tuple[Annotated[int, Field(ge=1, le=100_000)], ...], ...]


@no_type_check
def add_lines(arms: Any, correction: Any, first_value_index: int, memory: Any, q: Any) -> None:
    """Add the lines; `correction.values` contains the number of lines, and joint, order and weights of each."""
    for line in range(int(correction.values[first_value_index])):
        start = first_value_index + 1 + 4 * line
        j, order = int(correction.values[start]), correction.values[start + 1]
        angle = order * correction.rate[j] * q[j]
        sine, cosine = correction.values[start + 2], correction.values[start + 3]
        memory.delta[j] += sine * math.sin(angle) + cosine * math.cos(angle)


@no_type_check
def add_lines_slope(arms: Any, correction: Any, first_value_index: int, memory: Any, q: Any) -> None:
    """Add the derivative of the lines with respect to every joint's value."""
    for line in range(int(correction.values[first_value_index])):
        start = first_value_index + 1 + 4 * line
        j = int(correction.values[start])
        rate = correction.values[start + 1] * correction.rate[j]
        sine, cosine = correction.values[start + 2], correction.values[start + 3]
        memory.slope[j] += rate * (sine * math.cos(rate * q[j]) - cosine * math.sin(rate * q[j]))


class GearLines(AbstractFeature):
    """Columns sin(k q_j) and cos(k q_j) of the value q_j of a joint for a few orders k, which may be in the thousands.

    The error of a strain wave gear of ratio N has 2N and 4N cycles per turn, and the cogging of a motor with p pole
    pairs has multiples of pN. Between these lines, the spectrum is empty, and a series up to them would have thousands
    of weights. `hybrid.spectrum` finds the significant orders. All lines of a joint share a prior scale.

    Source: Tuttle and Seering, IEEE Transactions on Robotics and Automation 12(3), 1996, 368-374, on the transmission
        errors of strain wave gears.

    Attributes:
        orders: orders of the lines of every joint [cycles per turn; for a prismatic joint, per twice its travel].
    """

    name = "lines"
    section = LinesSection
    compiled = CompiledForm(add_lines, add_lines_slope)

    def __init__(self, robot: Robot, orders: Sequence[Sequence[int]]) -> None:
        """Create the feature with the lines of every joint.

        Raises:
            ValueError: there are no lines, or the number of joints is wrong.
        """
        super().__init__(robot)
        self.orders = tuple(tuple(of_joint) for of_joint in orders)
        most = max((len(of_joint) for of_joint in self.orders), default=0)
        if len(self.orders) != robot.dof or not most:
            raise ValueError(f"expected orders for each of {robot.dof} joints, got {self.orders}.")
        self.highest_harmonic = max(map(max, filter(None, self.orders)))
        self._rate = torch.from_numpy(angle_per_joint_value(robot))
        padded = [[*of_joint, *[0] * (most - len(of_joint))] for of_joint in self.orders]
        self._orders = torch.tensor(padded, dtype=torch.float64)
        self.used = (self._orders > 0).repeat(1, 2)
        self.group = torch.arange(robot.dof)[:, None].expand(self.used.shape)
        self.group_names = tuple(f"lines, {row.name}" for row in robot.joints)

    @classmethod
    def candidates(cls, robot: Robot, options: FeatureOptions, state: JointState) -> tuple["GearLines", ...]:
        """Return no features, because the orders are found in residuals of a first model (see `hybrid.spectrum`)."""
        return ()

    def columns(self, state: JointState) -> Float[Tensor, "*batch dof columns"]:
        """Return the columns: the sines of all lines of a joint, then the cosines."""
        return sines_cosines(state.q * self._rate.to(state.q), self._orders)

    def pack(self, weight: Float64[np.ndarray, "dof columns"]) -> Float64[np.ndarray, " values"]:
        """Return the number of lines, and joint, order and weights of sine and cosine of every line."""
        sines, cosines = np.split(weight, 2, axis=1)
        lines = [
            (j, order, sines[j, k], cosines[j, k])
            for j, of_joint in enumerate(self.orders)
            for k, order in enumerate(of_joint)
        ]
        return np.concatenate([[len(lines)], np.ravel(lines)])

    def add_onnx(self, graph: OnnxGraph, weight: Float64[np.ndarray, "dof columns"], q: str) -> str:
        """Add the weighted sum of the lines to an ONNX graph; see `AbstractFeature.add_onnx`."""
        return add_harmonics(
            graph, graph.add_node("Mul", q, self._rate.numpy()), self._orders.numpy(), weight
        )
