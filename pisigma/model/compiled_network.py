"""A network that corrects nominal joint values, and its domain, as plain arrays for the compiled kernels."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pisigma.kernels.arrays import ANGLE, COSINE, SINE, Network
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.network.correction_network import JointGroup
from pisigma.network.inputs import POSE_INPUTS
from pisigma.network.pi_sigma import PiSigma

_Input = tuple[int, list[float]]
_Member = tuple[JointGroup, PiSigma]
_COARSE = 0.01
"""Coordinates that vary by less, of the one that varies most, say next to nothing about a distance."""
_FUNCTIONS = {"": ANGLE, "sin": SINE, "cos": COSINE}


def describe_network(model: CalibratedModel) -> Network:
    """The network of a model and its domain; one that is not used where the model has none."""
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
    domain = _Domain.of(model, inputs, members)
    return Network(
        used=int(model.network is not None),
        source=np.array([source for source, _ in inputs], dtype=np.int64),
        factors=np.array([terms for _, terms in inputs]).reshape(-1, dof),
        offset=_joined([net.input_offset.numpy() for _, net in members]),
        scale=_joined([net.input_scale.numpy() for _, net in members]),
        reference=np.array([group.inputs.reference for group, _ in members]).reshape(-1, 3, 3),
        first=first.astype(np.int64),
        orders=orders,
        group=group_of.astype(np.int64),
        weight=weight,
        bias=bias,
        output_offset=scaling[0],
        output_scale=scaling[1],
        centre=_centre(model),
        samples=len(domain.samples),
        column=domain.column,
        times=domain.times,
        coarse=domain.coarse,
        rows=domain.samples.T.ravel().copy(),
        radius=float(model.domain.radius) if model.domain is not None else 1.0,
    )


class _Domain(NamedTuple):
    """Rows of a domain by the coordinates that differ, those that vary most first; see `compiled.arrays.Network`."""

    samples: np.ndarray
    column: np.ndarray
    times: np.ndarray
    coarse: int

    @staticmethod
    def of(model: CalibratedModel, inputs: Sequence[_Input], members: Sequence[_Member]) -> "_Domain":
        """The domain of a model; one without rows where it has none."""
        none = np.zeros(0, dtype=np.int64)
        if model.network is None or model.domain is None:
            return _Domain(np.zeros((0, 0)), none, np.zeros(0), 0)
        references = [group.inputs.reference.tobytes() for group, _ in members for _ in group.inputs.names]
        scaling = [
            scale
            for _, net in members
            for scale in zip(net.input_offset.tolist(), net.input_scale.tolist(), strict=True)
        ]
        meanings = [
            (source, *terms, *scale, reference if source < ANGLE else b"")
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
    """What kind of input a name means, and the factor of every joint in it."""
    function, factors = group.inputs.combination(name)
    if not factors:
        return POSE_INPUTS.index(name), [0.0] * len(group.inputs.joint_names)
    return _FUNCTIONS[function], factors


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros(0), *parts])


def _centre(model: CalibratedModel) -> np.ndarray:
    """Middle of the joint values of training rows [rad or m]."""
    if not len(model.starts):
        return np.zeros(model.robot.dof)
    q = model.starts.double().cpu().numpy()
    centre: np.ndarray = (q.min(0) + q.max(0)) / 2
    return centre
