"""A model's network or joint correction as an ONNX graph, for programs without Python."""

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from pisigma.calibration.hybrid.arm import HybridArm, JointCoverage
from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.deployment.export.geometry import HYBRID, pose_remarks
from pisigma.files.errors import ModelError
from pisigma.files.model_files import model_hash
from pisigma.joint_correction.conditions import learned_conditions, with_modelled_torques
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.joint_correction.onnx_chain import add_roll_pitch_yaw
from pisigma.joint_correction.onnx_graph import OnnxGraph, import_onnx
from pisigma.joint_correction.shared_features import add_product_unit_inputs
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.stated_conditions import condition_warnings
from pisigma.network.correction_network import CorrectionNetwork, JointGroup
from pisigma.network.inputs import POSE_INPUTS
from pisigma.network.pi_sigma import PiSigma


def needs_pose(network: CorrectionNetwork) -> bool:
    """Return whether an input of the network is a pose coordinate."""
    return any(set(group.inputs.names) & set(POSE_INPUTS) for group in network.groups)


def add_network(graph: OnnxGraph, network: CorrectionNetwork, q: str, T: str | None) -> str:
    """Add a network, and return the name of its corrections `(batch, dof)` [rad or m].

    Args:
        graph: graph to extend.
        network: network of the model.
        q: name of the nominal joint values.
        T: name of the poses; None if no input is a pose coordinate.
    """
    joints: list[int] = []
    outputs: list[str] = []
    for group, net in network.members():
        outputs.append(_add_group(graph, group, net, q, T))
        joints += group.joints
    every = outputs[0] if len(outputs) == 1 else graph.add_node("Concat", *outputs, axis=1)
    return graph.add_node("MatMul", every, np.eye(network.dof)[joints])


def _add_group(graph: OnnxGraph, group: JointGroup, net: PiSigma, q: str, T: str | None) -> str:
    """Add one network to a graph, and return the name of its outputs `(batch, outputs)`."""
    values, order = _add_inputs(graph, group, q, T)
    offset, scale = (part.detach().numpy()[order] for part in (net.input_offset, net.input_scale))
    scaled = graph.add_node("Div", graph.add_node("Sub", values, offset), scale)
    weight = (net.weight * net.fixed[..., None]).detach().numpy()[..., order].reshape(-1, net.inputs)
    bias = (net.bias * net.fixed).detach().numpy().ravel()
    sums = graph.add_node("Add", graph.add_node("MatMul", scaled, weight.T), bias)
    factors = graph.reshape(sums, [net.outputs, sum(net.orders)])
    product = graph.sum_of_products(factors, net.orders)
    scaled_back = graph.add_node("Mul", product, net.output_scale.detach().numpy())
    return graph.add_node("Add", scaled_back, net.output_offset.detach().numpy())


def _add_inputs(graph: OnnxGraph, group: JointGroup, q: str, T: str | None) -> tuple[str, list[int]]:
    """Add the inputs `(batch, inputs)` sorted by kind, and return their name and order."""
    names = group.inputs.names
    terms = [group.inputs.combination(name) for name in names]
    parts: list[str] = []
    order: list[int] = []
    for function, operator in (("sin", "Sin"), ("cos", "Cos"), ("", "")):
        rows = [i for i, (kind, factors) in enumerate(terms) if factors and kind == function]
        if rows:
            angle = graph.add_node("MatMul", q, np.array([terms[i][1] for i in rows]).T)
            parts.append(graph.add_node(operator, angle) if operator else angle)
            order += rows
    coordinates = [i for i, (_, factors) in enumerate(terms) if not factors]
    if coordinates:
        assert T is not None
        pose = _add_coordinates(graph, group.inputs.reference_rotation, T)
        parts += [pose[POSE_INPUTS.index(names[i])] for i in coordinates]
        order += coordinates
    return (parts[0] if len(parts) == 1 else graph.add_node("Concat", *parts, axis=1)), order


def _add_coordinates(graph: OnnxGraph, reference: np.ndarray, T: str) -> Sequence[str]:
    """Add x, y, z, roll, pitch, yaw of poses, each `(batch, 1)`."""
    cells = graph.reshape(T, [16])
    place = [graph.column(cells, 4 * axis + 3) for axis in range(3)]
    rotation = graph.columns(cells, [0, 1, 2, 4, 5, 6, 8, 9, 10])
    turned = graph.add_node(
        "MatMul", rotation, np.kron(reference, np.eye(3))
    )  # reference.T @ R, cell by cell
    return [*place, *add_roll_pitch_yaw(graph, turned)]


def add_joint_correction(graph: OnnxGraph, correction: JointCorrection, q: str) -> str:
    """Add a correction at the mean conditions, and return the name of its values `(batch, dof)` [rad or m].

    Raises:
        ModelError: the correction uses features without an ONNX form.
    """
    correction = with_modelled_torques(correction)
    robot, terms = correction.robot, []
    for feature, weight in zip(correction.features, correction.linear, strict=True):
        if feature.usually_zero:
            continue
        term = feature.add_onnx(graph, weight.detach().numpy(), q)
        if term is None:
            raise ModelError(
                f"the learned correction uses the feature '{feature.name}', which has no ONNX form",
                value=feature.name,
                remedy="calibrate without it, or implement its method `add_onnx`",
            )
        terms.append(term)
    if correction.orders:
        dof, factors, inputs = correction.weight.shape
        weight = (correction.weight * correction.fixed[..., None]).detach().numpy()
        bias = (correction.bias * correction.fixed).detach().numpy().ravel()
        phi = add_product_unit_inputs(graph, robot, q)
        sums = graph.add_node("Add", graph.add_node("MatMul", phi, weight.reshape(-1, inputs).T), bias)
        terms.append(graph.sum_of_products(graph.reshape(sums, [dof, factors]), correction.orders))
    total = terms[0] if terms else graph.add_node("Mul", q, 0.0)
    for term in terms[1:]:
        total = graph.add_node("Add", total, term)
    return total


def add_distance_outside(graph: OnnxGraph, coverage: JointCoverage, q: str) -> str:
    """Add the largest angle of any joint from its measured values, `(batch, 1)` [rad]; see `JointCoverage`."""
    node, joint = graph.add_node, coverage.joint.numpy()
    angle = node("Mul", graph.columns(q, joint.tolist()), coverage.angle_per_value.numpy()[joint])
    off = node("Sub", angle, coverage.middle.numpy())
    turning = np.array(coverage.is_periodic)[joint].astype(np.float64)
    turns = node("Round", node("Div", off, 2 * math.pi))
    off = node("Sub", off, node("Mul", turns, 2 * math.pi * turning))
    beyond = node("Max", node("Sub", node("Abs", off), coverage.half_width.numpy()), 0.0)
    per_joint = [
        node("ReduceMin", graph.columns(beyond, np.flatnonzero(joint == j).tolist()), axes=[1], keepdims=1)
        for j in range(len(coverage.is_periodic))
    ]
    return node("ReduceMax", node("Concat", *per_joint, axis=1), axes=[1], keepdims=1)


FORWARD = "forward_joint_correction"
INVERSE = "inverse_joint_correction"
"""Values of `computes` in the metadata of a graph."""


def export_onnx(model: CalibratedModel, model_sha256: str = "") -> bytes:
    """Convert a model's network to the content of an ONNX file.

    All numbers are double, and the first axis of every input and output is the batch. Units, frames, joints and the
    domain are in the descriptions of inputs and outputs and in the metadata.

    The graph of a network on nominal joint values (inverse calibration, distilled) maps `q_nominal`, and `T_base_tool`
    if the network uses the pose, to `q_corrected` and `correction`. The graph of a hybrid's joint correction maps `q`
    to `correction` and `beyond_measured`.

    Args:
        model: model to convert.
        model_sha256: hash of its `model.yaml`, for the metadata.

    Raises:
        MissingExtraError: onnx is not installed.
        ModelError: the model has no network, a network without an ONNX form, or coupled joints.
    """
    import_onnx()
    if model.robot.coupling is not None:
        raise ModelError(
            f"the joints of model '{model.name}' are coupled, and a graph would take joint values instead of the "
            "controller's values",
            value="coupling",
            remedy="use pisigma.load, which converts between them",
        )
    if model.network is not None:
        return _inverse(model, model.network, model_sha256)
    if model.hybrid is not None:
        return _forward(model, model.hybrid, model_sha256)
    raise ModelError(
        f"model '{model.name}' contains a geometry but no network",
        value=model.kind,
        remedy="export the geometry with --format urdf or dh, or distil it into a network with `pisigma distill`",
    )


def onnx_remarks(model: CalibratedModel) -> tuple[str, ...]:
    """Return remarks for the user of the file."""
    if model.network is not None:
        return (
            "q_nominal has to be computed with the model's nominal robot, base and tool; inputs outside the domain are "
            "not rejected.",
        )
    return (
        "The graph corrects joint values for forward kinematics: the pose is that of the hybrid geometry "
        "(--format urdf or dh --geometry hybrid), not of the geometric fit, at q + correction. To convert nominal "
        "to commanded joint values, export a model written by `pisigma distill`.",
        *pose_remarks(model),
    )


def _inverse(model: CalibratedModel, network: CorrectionNetwork, sha256: str) -> bytes:
    graph, dof, units = OnnxGraph(), model.robot.dof, _units(model)
    about = f"{_joints(model)} [{units}], in the controller's directions"
    q = graph.add_input("q_nominal", [dof], f"nominal joint values {about}")
    T = None
    if needs_pose(network):
        T = graph.add_input("T_base_tool", [4, 4], "target poses of the tool in the base frame [m]")
    correction = add_network(graph, network, q, T)
    corrected = graph.add_node("Add", q, correction)
    graph.add_output(
        corrected, "q_corrected", [dof], f"joint values to command {about}: q_nominal + correction"
    )
    graph.add_output(
        correction, "correction", [dof], f"correction that is added to the nominal joint values [{units}]"
    )
    doc = (
        f"Corrections of nominal joint values of robot {model.robot.name}, model {model.name}. Nominal joint values "
        "are the inverse kinematics of the nominal robot with the base and tool of the model."
    )
    return graph.to_bytes(f"pisigma {model.name}", doc, _metadata(model, INVERSE, sha256))


def _forward(model: CalibratedModel, arm: HybridArm, sha256: str) -> bytes:
    graph, dof, units = OnnxGraph(), model.robot.dof, _units(model)
    q = graph.add_input(
        "q", [dof], f"commanded joint values {_joints(model)} [{units}], in the controller's directions"
    )
    correction = add_joint_correction(graph, arm.correction, q)
    graph.add_output(
        correction, "correction", [dof], f"correction that is added to the joint values [{units}]"
    )
    graph.add_output(
        add_distance_outside(graph, arm.coverage, q),
        "beyond_measured",
        [1],
        "0 within the measured joint values, otherwise the largest angle by which a joint is outside them [rad]",
    )
    doc = (
        f"Joint corrections of robot {model.robot.name}, model {model.name}, at the mean conditions of the "
        "calibration. The pose is that of the hybrid geometry (pisigma export --geometry hybrid), not of the geometric "
        "fit, at q + correction."
    )
    return graph.to_bytes(f"pisigma {model.name}", doc, _metadata(model, FORWARD, sha256))


def _metadata(model: CalibratedModel, computes: str, sha256: str) -> dict[str, str]:
    """Return the metadata as strings, with lists and tables as JSON; base and tool are those of the graph."""
    arm = model.hybrid if computes == FORWARD else None
    robot = model.robot if arm is None else arm.robot
    values: dict[str, Any] = {
        "model": model.name,
        "kind": model.kind,
        "model_yaml_sha256": sha256,
        "computes": computes,
        "robot": model.robot.name,
        "joints": [joint.name for joint in model.robot.joints],
        "joint_units": ["rad" if is_revolute else "m" for is_revolute in model.robot.revolute],
        "length_unit": "m",
        "pose_frame": "T_base_tool maps coordinates of the tool into the base frame",
        "geometry": "nominal" if arm is None else HYBRID,
        "base_xyzrpy": robot.base.tolist(),
        "tool_xyzrpy": robot.tool.tolist(),
        "branches": list(model.branches),
        "domain": _domain(model),
    }
    learned = None if arm is None else learned_conditions(arm.correction)
    if learned is not None:
        values["usual_conditions"] = dict(zip(learned.names, learned.mean, strict=True))
    if arm is not None:
        values["warnings"] = condition_warnings(model)
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in values.items()}


def _domain(model: CalibratedModel) -> dict[str, Any]:
    """Return the range of the training rows and, for a hybrid, the measured intervals of every joint."""
    domain: dict[str, Any] = {}
    if len(model.starts):
        low, high = model.starts.aminmax(dim=0)
        domain |= {"q_lower": low.tolist(), "q_upper": high.tolist()}
    if model.network is None and model.hybrid is not None:
        coverage = model.hybrid.coverage
        intervals: list[list[list[float]]] = [[] for _ in range(model.robot.dof)]
        columns = (coverage.joint.tolist(), coverage.middle.tolist(), coverage.half_width.tolist())
        for j, middle, half in zip(*columns, strict=True):
            rate = float(coverage.angle_per_value[j])
            intervals[j].append([(middle - half) / rate, (middle + half) / rate])
        domain["measured"] = intervals
    return domain


def _joints(model: CalibratedModel) -> str:
    return ", ".join(joint.name for joint in model.robot.joints)


def _units(model: CalibratedModel) -> str:
    return " or ".join(dict.fromkeys("rad" if is_revolute else "m" for is_revolute in model.robot.revolute))


def _write(request: ExportRequest) -> Exported:
    model = request.load()
    content = export_onnx(model, model_hash(request.model))
    return Exported(content, model_facts(model), onnx_remarks(model))


FORMAT = ExportFormat("onnx", "an ONNX graph", (".onnx",), _write, contains="joint_values")
