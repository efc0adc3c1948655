"""The joint correction of a hybrid calibration as ONNX nodes, with how far it is in force."""

import math

import numpy as np

from pisigma.errors import ModelError
from pisigma.hybrid.coverage import JointCoverage
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.joint_correction.shared_features import add_unit_inputs
from pisigma.onnx.graph import OnnxGraph


def add_joint_correction(graph: OnnxGraph, correction: JointCorrection, q: str) -> str:
    """Add a correction under the usual conditions; gives `(batch, dof)` [rad or m].

    Raises:
        ModelError: it uses features that have no ONNX form.
    """
    robot, terms = correction.robot, []
    for feature, weight in zip(correction.features, correction.linear, strict=True):
        if feature.usually_zero:
            continue
        try:
            terms.append(feature.add_onnx(graph, weight.detach().numpy(), q))
        except NotImplementedError:
            raise ModelError(
                f"the learned correction uses the feature '{feature.name}', which has no ONNX form; calibrate without "
                "it, or give it the method `add_onnx`."
            ) from None
    if correction.orders:
        dof, factors, inputs = correction.weight.shape
        weight = (correction.weight * correction.fixed[..., None]).detach().numpy()
        bias = (correction.bias * correction.fixed).detach().numpy().ravel()
        phi = add_unit_inputs(graph, robot, q)
        sums = graph.node("Add", graph.node("MatMul", phi, weight.reshape(-1, inputs).T), bias)
        terms.append(graph.sum_of_products(graph.reshape(sums, [dof, factors]), correction.orders))
    total = terms[0] if terms else graph.node("Mul", q, 0.0)
    for term in terms[1:]:
        total = graph.node("Add", total, term)
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
