"""The joint correction of a hybrid calibration as ONNX nodes, with how far it is in force."""

import math

import numpy as np
import torch

from pisigma.errors import ModelError
from pisigma.export.onnx_chain import add_gravity, add_pose
from pisigma.export.onnx_graph import OnnxGraph
from pisigma.export.onnx_network import add_roll_pitch_yaw
from pisigma.hybrid.coverage import JointCoverage
from pisigma.joint_correction.features import (
    AbstractFeatures,
    ConditionFeatures,
    FourierSeries,
    GravityTorques,
    SharedFeatures,
    scaled_joints,
    turning_rate,
)
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.robot.description import Robot


def add_joint_correction(graph: OnnxGraph, correction: JointCorrection, q: str) -> str:
    """Add a correction under the usual conditions; gives `(batch, dof)` [rad or m].

    Raises:
        ModelError: it uses features that have no ONNX form.
    """
    robot, parts = correction.robot, []
    for features, weight in zip(correction.features, correction.linear, strict=True):
        if not isinstance(features, ConditionFeatures):  # 0 under the usual conditions
            parts.append(_add_features(graph, features, weight.detach().numpy(), robot, q))
    if correction.orders:
        dof, factors, inputs = correction.weight.shape
        weight = (correction.weight * correction.fixed[..., None]).detach().numpy()
        bias = (correction.bias * correction.fixed).detach().numpy().ravel()
        phi = _add_unit_inputs(graph, robot, q)
        sums = graph.node("Add", graph.node("MatMul", phi, weight.reshape(-1, inputs).T), bias)
        parts.append(graph.sum_of_products(graph.reshape(sums, [dof, factors]), correction.orders))
    total = parts[0] if parts else graph.node("Mul", q, 0.0)
    for part in parts[1:]:
        total = graph.node("Add", total, part)
    return total


def add_share(graph: OnnxGraph, coverage: JointCoverage, q: str) -> str:
    """Add how much of a correction is in force, `(batch, 1)`; see `JointCoverage.share`."""
    node, joint = graph.node, coverage.joint.numpy()
    angle = node("Mul", graph.columns(q, joint.tolist()), coverage.rate.numpy()[joint])
    off = node("Sub", angle, coverage.middle.numpy())
    turning = np.array(coverage.turning)[joint].astype(np.float64)
    turns = node("Round", node("Div", off, 2 * math.pi))
    off = node("Sub", off, node("Mul", turns, 2 * math.pi * turning))
    beyond = node("Max", node("Sub", node("Abs", off), coverage.half.numpy()), 0.0)
    per_joint = [
        node("ReduceMin", graph.columns(beyond, np.flatnonzero(joint == j).tolist()), axes=[1], keepdims=1)
        for j in range(len(coverage.turning))
    ]
    farthest = node("ReduceMax", node("Concat", *per_joint, axis=1), axes=[1], keepdims=1)
    faded = node("Min", node("Div", farthest, coverage.fade), 1.0)
    left = node("Mul", node("Mul", faded, faded), node("Sub", 3.0, node("Mul", faded, 2.0)))
    return node("Sub", 1.0, left)


def _add_features(
    graph: OnnxGraph, features: AbstractFeatures, weight: np.ndarray, robot: Robot, q: str
) -> str:
    """The weighted sum of features, `(batch, dof)`."""
    if isinstance(features, FourierSeries):
        return _add_series(graph, features.harmonics, weight, robot, q)
    if isinstance(features, GravityTorques):
        return add_gravity(graph, features, weight, robot, q)
    if isinstance(features, SharedFeatures):
        values = {"joints": _add_scaled, "sin_cos": _add_unit_inputs, "pose": _add_pose_values}
        return graph.node("MatMul", values[features.name](graph, robot, q), weight.T)
    raise ModelError(
        f"the learned correction uses the features '{features.name}', which have no ONNX form; calibrate with series, "
        "gravity, joints, sin_cos or pose."
    )


def _add_series(graph: OnnxGraph, harmonics: int, weight: np.ndarray, robot: Robot, q: str) -> str:
    own = graph.reshape(graph.node("Mul", q, turning_rate(robot)), [robot.dof, 1])
    angle = graph.node("Mul", own, np.arange(1.0, harmonics + 1))
    parts = [
        graph.total(graph.node("Mul", graph.node(operator, angle), part), 2)
        for operator, part in (("Sin", weight[:, :harmonics]), ("Cos", weight[:, harmonics:]))
    ]
    return graph.node("Add", *parts)


def _add_scaled(graph: OnnxGraph, robot: Robot, q: str) -> str:
    """See `pisigma.joint_correction.features.scaled_joints`."""
    zero = scaled_joints(robot, torch.zeros(robot.dof, dtype=torch.float64)).numpy()
    one = scaled_joints(robot, torch.ones(robot.dof, dtype=torch.float64)).numpy()
    return graph.node("Add", graph.node("Mul", q, one - zero), zero)


def _add_unit_inputs(graph: OnnxGraph, robot: Robot, q: str) -> str:
    """See `pisigma.joint_correction.features.unit_inputs`."""
    turning = np.flatnonzero(robot.revolute).tolist()
    sliding = np.flatnonzero(~np.array(robot.revolute)).tolist()
    angle = graph.columns(q, turning)
    parts = [graph.node("Sin", angle), graph.node("Cos", angle)] if turning else []
    if sliding:
        parts.append(graph.columns(_add_scaled(graph, robot, q), sliding))
    return graph.node("Concat", *parts, axis=1)


def _add_pose_values(graph: OnnxGraph, robot: Robot, q: str) -> str:
    """See `pisigma.joint_correction.features.SharedFeatures`: x, y, z over the reach, roll, pitch, yaw."""
    place, R = add_pose(graph, robot, q)
    scaled = graph.node("Div", place, robot.reach)
    return graph.node("Concat", scaled, *add_roll_pitch_yaw(graph, R), axis=1)
