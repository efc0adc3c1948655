"""Convert calibrated models to the plain arrays of the compiled inverse kinematics."""

import os
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from pisigma.files.errors import ModelError
from pisigma.joint_correction.conditions import with_modelled_torques
from pisigma.joint_correction.feature import angle_per_joint_value, scaled_joints
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.frame_choice import warnings_without_rows
from pisigma.model.stored_starts import StoredStarts, middle_of_starts
from pisigma.network.correction_network import JointGroup
from pisigma.network.inputs import POSE_INPUTS
from pisigma.network.pi_sigma import PiSigma
from pisigma.robot.kernels import arrays
from pisigma.robot.kernels.array_kinematics import KINDS, arm_rows, base_and_tool_matrices
from pisigma.robot.kernels.description_file import write_description
from pisigma.robot.kernels.forms import MAX_JOINTS, KernelForms
from pisigma.robot.kinematics.closed_form import AbstractClosedForm, closed_form_solver
from pisigma.robot.se3 import invert

_NUMERIC = ("numeric",)
_Input = tuple[int, list[float]]
_Member = tuple[JointGroup, PiSigma]
_COARSE = 0.01
"""Share of the largest range of any coordinate below which a coordinate hardly contributes to distances."""
_FUNCTIONS = {"": arrays.ANGLE, "sin": arrays.SINE, "cos": arrays.COSINE}


def save_compiled(model: CalibratedModel, file: str | os.PathLike[str], model_folder_hash: str = "") -> None:
    """Write the file that `CompiledIK.load` reads.

    Args:
        model: model to convert.
        file: file to write.
        model_folder_hash: `content_hash` of the model folder, which is stored in the file; a file with a different hash
            is out of date.

    Raises:
        ModelError: the model has no compiled form, see `describe_as_arrays`.
    """
    description, branches = describe_as_arrays(model)
    joints = [joint.name for joint in model.robot.joints]
    write_description(
        file,
        description,
        branches=branches,
        joints=joints,
        name=model.name,
        model_folder_hash=model_folder_hash,
        warnings=warnings_without_rows(model),
    )


def describe_as_arrays(model: CalibratedModel) -> tuple[arrays.Description, tuple[str, ...]]:
    """Return a model as arrays, and the names of its branches.

    Raises:
        ModelError: the model has both a network and an identified geometry, its learned correction uses features
            without a compiled form, it has neither a closed-form inverse nor initial joint values, or its joints are
            coupled (kernels use DH values, which must not be commanded to a controller).
    """
    if model.robot.dof > MAX_JOINTS:
        raise ModelError(
            f"expected at most {MAX_JOINTS} joints for a compiled model, got model '{model.name}' with "
            f"{model.robot.dof}",
            value=model.robot.dof,
            remedy="use pisigma.load, which solves without kernels",
        )
    if model.robot.coupling is not None:
        raise ModelError(
            f"compiled models do not support coupled joints, which model '{model.name}' has",
            value="coupling",
            remedy="use pisigma.load, which converts the controller's values to joint values",
        )
    if model.network is not None and model.calibrated is not None:
        raise ModelError(
            f"model '{model.name}' has both an identified geometry and a network that corrects nominal joint values, "
            "which has no compiled form",
            value="network",
            remedy="omit either the geometry or the network",
        )
    solver = closed_form_solver(model.robot)
    if solver is None and not len(model.starts):
        raise ModelError(
            f"the robot of model '{model.name}' has no closed-form inverse kinematics, and the model stores no initial "
            "joint values",
            value="starts",
            remedy="calibrate the robot again",
        )
    correction, features = _correction(model)
    stored = StoredStarts(model.identified, model.starts.double().cpu())
    description = arrays.Description(
        arms=_arms(model),
        correction=correction,
        forms=KernelForms(features, (solver.name,) if solver else ()),
        coverage=_coverage(model),
        network=_network(model),
        closed_form=_closed_form(model, solver),
        starts=arrays.Starts(stored.q.numpy(), stored.points.numpy(), stored.lever),
    )
    return description, solver.branches if solver else _NUMERIC


def _arms(model: CalibratedModel) -> arrays.Arms:
    nominal, hybrid = model.robot, model.hybrid
    of_correction = nominal if hybrid is None else hybrid.correction.robot
    arms = (
        nominal,
        model.identified,
        of_correction,
    )  # the order is NOMINAL, IDENTIFIED, NOMINAL_WITHOUT_BASE
    return arrays.Arms(
        kind=np.array([KINDS[row.type] for row in nominal.rows]),
        rows=np.stack([arm_rows(arm) for arm in arms]),
        ends=np.stack([base_and_tool_matrices(arm) for arm in arms]),
        reach=np.array([arm.reach or 1.0 for arm in arms]),
        direction=nominal.directions,
        revolute=np.array(nominal.revolute, dtype=np.int64),
        limits=nominal.limits,
        corrected=int(hybrid is not None),
    )


def _correction(model: CalibratedModel) -> tuple[arrays.Correction, tuple[str, ...]]:
    """Return the joint correction of a model as arrays, and the names of its features in order.

    Raises:
        ModelError: a feature has no compiled form, or two features have the same name.
    """
    dof, hybrid = model.robot.dof, model.hybrid
    robot = model.robot if hybrid is None else hybrid.correction.robot
    zero = scaled_joints(robot, torch.from_numpy(np.zeros(dof))).numpy()
    half = 1 / (scaled_joints(robot, torch.from_numpy(np.ones(dof))).numpy() - zero)
    correction = JointCorrection(robot, ()) if hybrid is None else with_modelled_torques(hybrid.correction)
    numbers: dict[str, np.ndarray] = {}
    for feature, weight in zip(correction.features, correction.linear, strict=True):
        if feature.compiled is not None and feature.name not in numbers:
            numbers[feature.name] = feature.pack(weight.detach().numpy())
        elif not feature.usually_zero:
            raise ModelError(
                f"the correction of model '{model.name}' uses the feature '{feature.name}', which has no compiled form "
                "or appears twice",
                value=feature.name,
                remedy="use pisigma.load, which solves without kernels",
            )
    fixed, starts = correction.fixed.numpy(), np.cumsum([0, *(len(values) for values in numbers.values())])
    compiled = arrays.Correction(
        rate=angle_per_joint_value(robot),
        middle=-zero * half,
        half=half,
        values=np.concatenate([np.zeros(0), *numbers.values()]),
        starts=starts[:-1].astype(np.int64),
        weight=(correction.weight.detach().numpy() * fixed[..., None]).transpose(1, 2, 0).copy(),
        bias=(correction.bias.detach().numpy() * fixed).T.copy(),
        orders=np.array(correction.orders, dtype=np.int64),
        periodic=int(correction.is_periodic),
        frames=int(
            any(feature.compiled is not None and feature.compiled.frames for feature in correction.features)
        ),
    )
    return compiled, tuple(numbers)


def _coverage(model: CalibratedModel) -> arrays.Coverage:
    if model.hybrid is None:
        none = np.zeros(0)
        return arrays.Coverage(
            np.zeros(0, dtype=np.int64), none, none, angle_per_joint_value(model.identified)
        )
    own = model.hybrid.coverage
    return arrays.Coverage(
        own.joint.numpy(), own.middle.numpy(), own.half_width.numpy(), own.angle_per_value.numpy()
    )


def _closed_form(model: CalibratedModel, solver: AbstractClosedForm | None) -> arrays.ClosedForm:
    if solver is None:
        none, zeros = np.zeros((3, 4)), np.zeros(model.robot.dof)
        first = np.zeros(1, dtype=np.int64)
        return arrays.ClosedForm(1, first, 1, none, none, *[zeros] * 6)
    if solver.compiled is None:
        raise ModelError(
            f"the closed-form inverse {type(solver).__name__} of model '{model.name}' has no compiled form",
            value=type(solver).__name__,
            remedy="use pisigma.load, which solves without kernels",
        )
    rows, names = solver.rows, solver.branches
    trained = [names.index(name) for name in model.branches] or list(range(len(names)))
    return arrays.ClosedForm(
        branches=len(names),
        order=np.array([*trained, *(index for index in range(len(names)) if index not in trained)]),
        trained=len(trained),
        first=invert(rows.T_base_first)[:3].numpy(),
        last=invert(rows.T_last_tool)[:3].numpy(),
        sign=rows.sign.numpy(),
        direction=rows.direction.numpy(),
        offset=rows.offset.numpy(),
        theta=np.array(rows.theta),
        d=np.array(rows.d),
        a=np.array(rows.a),
    )


def _network(model: CalibratedModel) -> arrays.Network:
    """Return the network of a model and its domain as arrays; without a network, the result is marked as unused."""
    dof = model.robot.dof
    members = model.network.members() if model.network else []
    inputs = [_input(group, name) for group, _ in members for name in group.inputs.names]
    counts = [net.inputs for _, net in members]
    first = np.cumsum([0, *counts])
    orders = np.zeros((len(members), max((len(net.orders) for _, net in members), default=0)), dtype=np.int64)
    factors = max((sum(net.orders) for _, net in members), default=0)
    weight, bias = np.zeros((dof, factors, max(counts, default=0))), np.zeros((dof, factors))
    group_of, scaling = np.full(dof, -1), np.zeros((2, dof))
    for index, (group, net) in enumerate(members):
        orders[index, : len(net.orders)] = net.orders
        fixed = net.fixed.numpy()
        for output, joint in enumerate(group.joints):
            used = slice(len(fixed[output]))
            group_of[joint] = index
            weight[joint, used, : net.inputs] = net.weight.detach().numpy()[output] * fixed[output][:, None]
            bias[joint, used] = net.bias.detach().numpy()[output] * fixed[output]
            scaling[:, joint] = float(net.output_offset[output]), float(net.output_scale[output])
    domain = _Domain.from_model(model, inputs, members)
    return arrays.Network(
        used=int(model.network is not None),
        source=np.array([source for source, _ in inputs], dtype=np.int64),
        factors=np.array([terms for _, terms in inputs]).reshape(-1, dof),
        offset=np.concatenate([np.zeros(0), *(net.input_offset.numpy() for _, net in members)]),
        scale=np.concatenate([np.zeros(0), *(net.input_scale.numpy() for _, net in members)]),
        reference=np.array([group.inputs.reference_rotation for group, _ in members]).reshape(-1, 3, 3),
        first=first.astype(np.int64),
        orders=orders,
        group=group_of.astype(np.int64),
        weight=weight,
        bias=bias,
        output_offset=scaling[0],
        output_scale=scaling[1],
        centre=middle_of_starts(model.starts).cpu().numpy() if len(model.starts) else np.zeros(dof),
        samples=len(domain.samples),
        column=domain.column,
        times=domain.times,
        coarse=domain.coarse,
        rows=domain.samples.T.ravel().copy(),
        radius=float(model.domain.radius) if model.domain is not None else 1.0,
    )


class _Domain(NamedTuple):
    """Samples of a domain in distinct coordinates, widest range first; see `robot.kernels.arrays.Network`."""

    samples: np.ndarray
    column: np.ndarray
    times: np.ndarray
    coarse: int

    @staticmethod
    def from_model(model: CalibratedModel, inputs: Sequence[_Input], members: Sequence[_Member]) -> "_Domain":
        """Return the samples of a model's domain; without a domain, the result has no rows."""
        none = np.zeros(0, dtype=np.int64)
        if model.network is None or model.domain is None:
            return _Domain(np.zeros((0, 0)), none, np.zeros(0), 0)
        references = [
            group.inputs.reference_rotation.tobytes() for group, _ in members for _ in group.inputs.names
        ]
        scaling = [
            scale
            for _, net in members
            for scale in zip(net.input_offset.tolist(), net.input_scale.tolist(), strict=True)
        ]
        meanings = [
            (source, *terms, *scale, reference if source < arrays.ANGLE else b"")
            for (source, terms), scale, reference in zip(inputs, scaling, references, strict=True)
        ]
        column = np.array([index for index, own in enumerate(meanings) if meanings.index(own) == index])
        times = np.sqrt([meanings.count(meanings[index]) for index in column])
        samples = model.domain.samples.double().cpu().numpy()[:, column] * times
        spread = np.ptp(samples, axis=0)
        order = np.argsort(-spread, kind="stable")
        coarse = int((spread > _COARSE * spread.max()).sum())
        return _Domain(samples[:, order], column[order].astype(np.int64), times[order], coarse)


def _input(group: JointGroup, name: str) -> _Input:
    """Return the kind of a network input, and the factor of every joint in it."""
    function, factors = group.inputs.combination(name)
    if not factors:
        return POSE_INPUTS.index(name), [0.0] * len(group.inputs.joint_names)
    return _FUNCTIONS[function], factors
