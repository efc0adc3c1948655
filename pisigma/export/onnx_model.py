"""A model's network as an ONNX graph, for programs that run no Python."""

import hashlib
import json
from typing import Any

from pisigma.errors import ModelError
from pisigma.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.export.onnx_joint_correction import add_joint_correction, add_share
from pisigma.export.onnx_network import add_network, needs_pose
from pisigma.hybrid.arms import HybridArm
from pisigma.joint_correction.conditions import learned_conditions
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.network.correction_network import CorrectionNetwork
from pisigma.onnx.graph import OnnxGraph, import_onnx

FORWARD = "forward_joint_correction"
INVERSE = "inverse_joint_correction"
"""What a graph computes, in its metadata."""


def export_onnx(model: CalibratedModel, model_sha256: str = "") -> bytes:
    """A model's network as the content of an ONNX file.

    All numbers are double, the first axis of every input and output is the batch. Units, frames, joints and the domain
    stand in the descriptions of inputs and outputs and in the metadata.

    With a network on nominal joint values (inverse calibration, distilled): `q_nominal`, and `T_base_tool` where the
    network looks at the pose, to `q_corrected` and `correction`. With a hybrid's joint correction: `q` to `correction`
    in force, `full_correction` and `share`.

    Args:
        model: the model.
        model_sha256: hash of its `model.yaml`, for the metadata.

    Raises:
        MissingExtraError: onnx is not installed.
        ModelError: the model has no network, or one without ONNX form.
    """
    import_onnx()
    if model.network is not None:
        return _inverse(model, model.network, model_sha256)
    if model.hybrid is not None:
        return _forward(model, model.hybrid, model_sha256)
    raise ModelError(
        f"model '{model.name}' has no network, only geometry; export that with --format urdf or dh, or make a network "
        "of it with `pisigma distill`."
    )


def onnx_remarks(model: CalibratedModel) -> tuple[str, ...]:
    """What a reader of the file should know."""
    if model.network is not None:
        return (
            "q_nominal has to come from the model's nominal robot on its base and with its tool; inputs outside the "
            "domain are not refused.",
        )
    return (
        "The graph corrects joint values on the way forward: the pose is that of the hybrid geometry in model.yaml at "
        "q + correction. For nominal to commanded joint values export a model of `pisigma distill`.",
    )


def _inverse(model: CalibratedModel, network: CorrectionNetwork, sha256: str) -> bytes:
    graph, dof, units = OnnxGraph(), model.robot.dof, _units(model)
    about = f"{_joints(model)} [{units}], as the controller counts"
    q = graph.add_input("q_nominal", [dof], f"nominal joint values {about}")
    T = None
    if needs_pose(network):
        T = graph.add_input("T_base_tool", [4, 4], "wanted poses of the tool in the base frame [m]")
    correction = add_network(graph, network, q, T)
    corrected = graph.node("Add", q, correction)
    graph.add_output(
        corrected, "q_corrected", [dof], f"joint values to command {about}: q_nominal + correction"
    )
    graph.add_output(correction, "correction", [dof], f"what is added to the nominal joint values [{units}]")
    doc = (
        f"Corrections of nominal joint values of robot {model.robot.name}, model {model.name}. Nominal joint values "
        "are the inverse kinematics of the nominal robot on the base and with the tool of the model."
    )
    return graph.finish(_graph_name(model), doc, _metadata(model, INVERSE, sha256))


def _forward(model: CalibratedModel, arm: HybridArm, sha256: str) -> bytes:
    graph, dof, units = OnnxGraph(), model.robot.dof, _units(model)
    q = graph.add_input(
        "q", [dof], f"commanded joint values {_joints(model)} [{units}], as the controller counts"
    )
    full = add_joint_correction(graph, arm.correction, q)
    share = add_share(graph, arm.coverage, q)
    in_force = graph.node("Mul", full, share)
    graph.add_output(
        in_force, "correction", [dof], f"correction in force, share times the full one [{units}]"
    )
    graph.add_output(
        full, "full_correction", [dof], f"correction as if all joint values had been measured [{units}]"
    )
    graph.add_output(share, "share", [1], "1 where every joint value was measured, 0 from the fade beyond on")
    doc = (
        f"Joint corrections of robot {model.robot.name}, model {model.name}, under the usual conditions. At share 1 "
        "the pose is that of the hybrid geometry at q + full_correction, at share 0 that of the geometric calibration "
        "at q; between, the model goes along the straight line from one pose to the other."
    )
    return graph.finish(_graph_name(model), doc, _metadata(model, FORWARD, sha256))


def _metadata(model: CalibratedModel, computes: str, sha256: str) -> dict[str, str]:
    """Everything as text, lists and tables as JSON."""
    values: dict[str, Any] = {
        "model": model.name,
        "kind": model.kind,
        "model_yaml_sha256": sha256,
        "computes": computes,
        "robot": model.robot.name,
        "joints": [joint.name for joint in model.robot.joints],
        "joint_units": ["rad" if turns else "m" for turns in model.robot.revolute],
        "length_unit": "m",
        "pose_frame": "T_base_tool maps coordinates of the tool into the base frame",
        "base_xyzrpy": model.robot.base.tolist(),
        "tool_xyzrpy": model.robot.tool.tolist(),
        "branches": list(model.branches),
        "domain": _domain(model),
    }
    arm = model.hybrid if model.network is None else None
    learned = None if arm is None else learned_conditions(arm.correction)
    if learned is not None:
        values["usual_conditions"] = dict(zip(learned.names, learned.mean, strict=True))
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in values.items()}


def _domain(model: CalibratedModel) -> dict[str, Any]:
    """Where it holds: the range of training rows, and of a hybrid the stretches of every joint that were measured."""
    found: dict[str, Any] = {}
    if len(model.starts):
        low, high = model.starts.aminmax(dim=0)
        found |= {"q_lower": low.tolist(), "q_upper": high.tolist()}
    if model.network is None and model.hybrid is not None:
        own = model.hybrid.coverage
        stretches: list[list[list[float]]] = [[] for _ in range(model.robot.dof)]
        for j, middle, half in zip(own.joint.tolist(), own.middle.tolist(), own.half.tolist(), strict=True):
            rate = float(own.rate[j])
            stretches[j].append([(middle - half) / rate, (middle + half) / rate])
        found |= {"measured": stretches, "fade_rad": own.fade}
    return found


def _graph_name(model: CalibratedModel) -> str:
    return f"pisigma {model.name}"


def _joints(model: CalibratedModel) -> str:
    return ", ".join(joint.name for joint in model.robot.joints)


def _units(model: CalibratedModel) -> str:
    kinds = dict.fromkeys("rad" if turns else "m" for turns in model.robot.revolute)
    return " or ".join(kinds)


def _write(request: ExportRequest) -> Exported:
    model = request.load()
    content = export_onnx(model, hashlib.sha256((request.model / "model.yaml").read_bytes()).hexdigest())
    return Exported(content, model_facts(model), onnx_remarks(model))


FORMAT = ExportFormat("onnx", "an ONNX graph", (".onnx",), _write)
