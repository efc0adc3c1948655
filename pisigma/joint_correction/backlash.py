"""Feature for the backlash of joints, which depends on the direction of approach."""

from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.joint_correction.feature import AbstractFeature, FeatureOptions
from pisigma.joint_correction.onnx_graph import OnnxGraph
from pisigma.measurement.conditions import APPROACH, JointState
from pisigma.robot.description import Robot
from pisigma.robot.kernels.forms import CompiledForm


@no_type_check
def add_backlash(arms: Any, correction: Any, first_value_index: int, memory: Any, q: Any) -> None:
    """Add the weight of every joint times its approach direction."""
    for j in range(arms.dof):
        memory.delta[j] += correction.values[first_value_index + j] * memory.approach[j]


class Backlash(AbstractFeature):
    """`Δ_j = b_j · approach_j`: half the backlash of a joint in its direction of approach.

    The approach is +1 if the joint value increased before it stopped and -1 if it decreased; it is 0, the middle of
    the backlash, if it is not stated. The weight b_j of a joint is half its backlash; all joints share a prior scale.

    Source: Whitney, Lozinski and Rourke, ASME Journal of Dynamic Systems, Measurement, and Control 108(1), 1986, 1-8,
    who list backlash among the errors of joints. Its effect on the pose is the multi-directional pose accuracy
    variation of ISO 9283:1998, 7.2.3.
    """

    name = "backlash"
    compiled = CompiledForm(add_backlash)
    group_names = ("backlash",)

    def __init__(self, robot: Robot) -> None:
        """Create the feature with one weight per joint."""
        super().__init__(robot)
        self.used = torch.ones(robot.dof, 1, dtype=torch.bool)
        self.group = torch.zeros(robot.dof, 1, dtype=torch.int64)

    @classmethod
    def candidates(cls, robot: Robot, options: FeatureOptions, state: JointState) -> tuple["Backlash", ...]:
        """Return the feature if any joint was approached from both sides, otherwise an empty tuple."""
        approach = state.conditions.get(APPROACH)
        if approach is None or not bool(((approach > 0).any(0) & (approach < 0).any(0)).any()):
            return ()
        return (Backlash(robot),)

    def columns(self, state: JointState) -> Float[Tensor, "*batch dof columns"]:
        """Return one column per joint, the joint's approach direction."""
        approach = state.conditions.get(APPROACH)
        if approach is None:
            return torch.zeros_like(state.q)[..., None]
        return approach.to(state.q).nan_to_num(0.0).expand(state.q.shape)[..., None]

    def unstated_covariance_root(
        self, state: JointState, weight: Float64[Tensor, "dof columns"]
    ) -> Float[Tensor, "*batch dof sources"]:
        """Return half the backlash where the direction is not stated: the joint stops on one of the two sides."""
        return torch.diag_embed(weight[:, 0] * (1 - self.columns(state)[..., 0].abs()))

    def add_onnx(self, graph: OnnxGraph, weight: Float64[np.ndarray, "dof columns"], q: str) -> str:
        """Add the graph input `approach` and the correction; see `AbstractFeature.add_onnx`."""
        doc = (
            "approach direction of every joint: 1 if its value increased, -1 if it decreased, 0 if not stated"
        )
        return graph.add_node("Mul", graph.add_input(APPROACH, [len(weight)], doc), weight[:, 0])
