"""The correction of nominal joint values as ONNX nodes."""

from collections.abc import Sequence

import numpy as np

from pisigma.network.correction_network import CorrectionNetwork, JointGroup
from pisigma.network.inputs import POSE_INPUTS
from pisigma.network.pi_sigma import PiSigma
from pisigma.onnx.chain import add_roll_pitch_yaw
from pisigma.onnx.graph import OnnxGraph


def needs_pose(network: CorrectionNetwork) -> bool:
    """Whether an input is a coordinate of the pose."""
    return any(set(group.inputs.names) & set(POSE_INPUTS) for group in network.groups)


def add_network(graph: OnnxGraph, network: CorrectionNetwork, q: str, T: str | None) -> str:
    """Add a network; gives the corrections `(batch, dof)` [rad or m].

    Args:
        graph: to add to.
        network: of the model.
        q: nominal joint values.
        T: poses; None where no input is a coordinate of them.
    """
    joints: list[int] = []
    outputs: list[str] = []
    for group, net in network.members():
        outputs.append(_add_group(graph, group, net, q, T))
        joints += group.joints
    every = outputs[0] if len(outputs) == 1 else graph.node("Concat", *outputs, axis=1)
    return graph.node("MatMul", every, np.eye(network.dof)[joints])


def _add_group(graph: OnnxGraph, group: JointGroup, net: PiSigma, q: str, T: str | None) -> str:
    """Outputs of one network, `(batch, outputs)`."""
    values, order = _add_inputs(graph, group, q, T)
    offset, scale = (part.detach().numpy()[order] for part in (net.input_offset, net.input_scale))
    scaled = graph.node("Div", graph.node("Sub", values, offset), scale)
    weight = (net.weight * net.fixed[..., None]).detach().numpy()[..., order].reshape(-1, net.inputs)
    bias = (net.bias * net.fixed).detach().numpy().ravel()
    sums = graph.node("Add", graph.node("MatMul", scaled, weight.T), bias)
    factors = graph.reshape(sums, [net.outputs, sum(net.orders)])
    product = graph.sum_of_products(factors, net.orders)
    scaled_back = graph.node("Mul", product, net.output_scale.detach().numpy())
    return graph.node("Add", scaled_back, net.output_offset.detach().numpy())


def _add_inputs(graph: OnnxGraph, group: JointGroup, q: str, T: str | None) -> tuple[str, list[int]]:
    """The inputs `(batch, inputs)` in an order of kinds, and which input stands where."""
    names = group.inputs.names
    terms = [group.inputs.combination(name) for name in names]
    parts: list[str] = []
    order: list[int] = []
    for function, operator in (("sin", "Sin"), ("cos", "Cos"), ("", "")):
        own = [i for i, (kind, factors) in enumerate(terms) if factors and kind == function]
        if own:
            angle = graph.node("MatMul", q, np.array([terms[i][1] for i in own]).T)
            parts.append(graph.node(operator, angle) if operator else angle)
            order += own
    coordinates = [i for i, (_, factors) in enumerate(terms) if not factors]
    if coordinates:
        assert T is not None
        pose = _add_coordinates(graph, group.inputs.reference, T)
        parts += [pose[POSE_INPUTS.index(names[i])] for i in coordinates]
        order += coordinates
    return (parts[0] if len(parts) == 1 else graph.node("Concat", *parts, axis=1)), order


def _add_coordinates(graph: OnnxGraph, reference: np.ndarray, T: str) -> Sequence[str]:
    """x, y, z, roll, pitch, yaw of poses, each `(batch, 1)`."""
    cells = graph.reshape(T, [16])
    place = [graph.column(cells, 4 * axis + 3) for axis in range(3)]
    rotation = graph.columns(cells, [0, 1, 2, 4, 5, 6, 8, 9, 10])
    seen = graph.node("MatMul", rotation, np.kron(reference, np.eye(3)))  # reference.T @ R, cell by cell
    return [*place, *add_roll_pitch_yaw(graph, seen)]
