"""Features that have the same columns for every joint: scaled joints, sines and cosines, or the nominal pose."""

from abc import abstractmethod
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.joint_correction.feature import AbstractFeature, product_unit_inputs, scaled_joints
from pisigma.joint_correction.onnx_chain import add_pose, add_roll_pitch_yaw
from pisigma.joint_correction.onnx_graph import OnnxGraph
from pisigma.measurement.conditions import JointState
from pisigma.network.inputs import Inputs
from pisigma.robot.description import Robot
from pisigma.robot.kernels.forms import CompiledForm
from pisigma.robot.kinematics.forward import forward_kinematics


class AbstractSharedFeature(AbstractFeature):
    """Base class of features whose columns do not depend on the joint that they correct."""

    def __init__(self, robot: Robot) -> None:
        """Create the feature for a robot."""
        super().__init__(robot)
        count = self.values(torch.zeros(robot.dof, dtype=torch.float64)).shape[-1]
        self.used = torch.ones(robot.dof, count, dtype=torch.bool)
        self.group = torch.zeros(robot.dof, count, dtype=torch.int64)
        self.group_names = (self.name,)

    def columns(self, state: JointState) -> Float[Tensor, "*batch dof columns"]:
        """Return the columns, which are the same for every joint."""
        values = self.values(state.q)
        return values.unsqueeze(-2).expand(*state.q.shape, values.shape[-1])

    @abstractmethod
    def values(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch columns"]:
        """Compute the columns that all joints share, `(*batch, columns)`."""

    def add_onnx(self, graph: OnnxGraph, weight: Float64[np.ndarray, "dof columns"], q: str) -> str:
        """Add the weighted sum of the columns to an ONNX graph; see `AbstractFeature.add_onnx`."""
        return graph.add_node("MatMul", self.add_values(graph, q), weight.T)

    @abstractmethod
    def add_values(self, graph: OnnxGraph, q: str) -> str:
        """Add the columns `(batch, columns)` to an ONNX graph."""


@no_type_check
def add_scaled_joint_sum(arms: Any, correction: Any, first_value_index: int, memory: Any, q: Any) -> None:
    """Add the weighted sum of the scaled joint values to every joint's correction."""
    for j in range(arms.dof):
        for i in range(arms.dof):
            weight = correction.values[first_value_index + arms.dof * j + i]
            memory.delta[j] += weight * (q[i] - correction.middle[i]) / correction.half[i]


class ScaledJoints(AbstractSharedFeature):
    """Scaled values of all joints: 0 in the middle of the limits, and ±1 at the limits."""

    name = "joints"
    compiled = CompiledForm(add_scaled_joint_sum)

    def values(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch columns"]:
        """Return the scaled joint values; see `scaled_joints`."""
        return scaled_joints(self.robot, q)

    def add_values(self, graph: OnnxGraph, q: str) -> str:
        """Add the columns to an ONNX graph; see `AbstractSharedFeature.add_values`."""
        return add_scaled_joints(graph, self.robot, q)

    def is_periodic(self, weight: Float64[np.ndarray, "dof columns"]) -> bool:
        """Return False if a revolute joint has weights."""
        return not weight[:, np.array(self.robot.revolute)].any()


@no_type_check
def add_product_input_sum(arms: Any, correction: Any, first_value_index: int, memory: Any, q: Any) -> None:
    """Add the weighted sum of the inputs of product units to every joint's correction."""
    for j in range(arms.dof):
        for i in range(correction.inputs):
            memory.delta[j] += (
                correction.values[first_value_index + correction.inputs * j + i] * memory.phi[i]
            )


class SinesCosines(AbstractSharedFeature):
    """Sine and cosine of every revolute joint value, and scaled value of every prismatic joint."""

    name = "sin_cos"
    compiled = CompiledForm(add_product_input_sum)

    def values(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch columns"]:
        """Return the inputs of the product units; see `product_unit_inputs`."""
        return product_unit_inputs(self.robot, q)

    def add_values(self, graph: OnnxGraph, q: str) -> str:
        """Add the columns to an ONNX graph; see `AbstractSharedFeature.add_values`."""
        return add_product_unit_inputs(graph, self.robot, q)


class NominalPose(AbstractSharedFeature):
    """x, y, z of the nominal pose divided by the reach, and roll, pitch, yaw [rad] (Jeong et al. 1998, section 3.2)."""

    name = "pose"

    def __init__(self, robot: Robot) -> None:
        """Create the feature for a robot."""
        self._inputs = Inputs.from_names(robot, ("x", "y", "z", "roll", "pitch", "yaw"))
        super().__init__(robot)

    def values(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch columns"]:
        """Compute the scaled coordinates of the nominal pose."""
        values = self._inputs(forward_kinematics(self.robot, q), q)
        return values / values.new_tensor([self.robot.reach] * 3 + [1.0] * 3)

    def add_values(self, graph: OnnxGraph, q: str) -> str:
        """Add the columns to an ONNX graph; see `AbstractSharedFeature.add_values`."""
        position, R = add_pose(graph, self.robot, q)
        scaled = graph.add_node("Div", position, self.robot.reach)
        return graph.add_node("Concat", scaled, *add_roll_pitch_yaw(graph, R), axis=1)


def add_scaled_joints(graph: OnnxGraph, robot: Robot, q: str) -> str:
    """Add `scaled_joints` `(batch, dof)` to an ONNX graph."""
    zero = scaled_joints(robot, torch.zeros(robot.dof, dtype=torch.float64)).numpy()
    one = scaled_joints(robot, torch.ones(robot.dof, dtype=torch.float64)).numpy()
    return graph.add_node("Add", graph.add_node("Mul", q, one - zero), zero)


def add_product_unit_inputs(graph: OnnxGraph, robot: Robot, q: str) -> str:
    """Add `product_unit_inputs` `(batch, inputs)` to an ONNX graph."""
    turning = np.flatnonzero(robot.revolute).tolist()
    sliding = np.flatnonzero(~np.array(robot.revolute)).tolist()
    angle = graph.columns(q, turning)
    inputs = [graph.add_node("Sin", angle), graph.add_node("Cos", angle)] if turning else []
    if sliding:
        inputs.append(graph.columns(add_scaled_joints(graph, robot, q), sliding))
    return graph.add_node("Concat", *inputs, axis=1)
