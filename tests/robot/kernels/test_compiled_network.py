"""Compiled inverse kinematics of models whose network corrects nominal joint values agrees with torch."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.models import hand_made_model, joints_around, no_type_checker
from testing.refusals import refused

from pisigma.files.errors import ModelError
from pisigma.model.compiled_model import describe_as_arrays, save_compiled
from pisigma.model.domain import Domain
from pisigma.model.inverse.compiled_ik import CompiledIK
from pisigma.model.inverse.numeric_ik import NumericIK
from pisigma.network.correction_network import CorrectionNetwork, JointGroup
from pisigma.network.inputs import Inputs
from pisigma.network.pi_sigma import PiSigma
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status

POSE = ("x", "roll", "y", "pitch", "z", "yaw", "theta_1")


@functools.cache
def grouped():
    """A model of two groups with different inputs, with uncorrected joints between them."""
    model = hand_made_model("ur10")
    robot, groups, networks = model.robot, [], []
    turned = forward_kinematics(robot, joints_around("ur10"))[:3, :3].numpy()
    for joints, names, orders in (
        ((4, 0), POSE, (2, 3)),
        ((2,), ("theta_2", "sin(theta_2 - theta_3)", "cos(theta_5)", "cos(8*theta_1)"), (1,)),
        ((3,), ("theta_2", "theta_1", "sin(theta_2 - theta_3)", "z", "sin(3*theta_1)"), (2,)),
    ):
        network = PiSigma(len(names), len(joints), orders, fixed_product=1.3)
        network.initialise(0.3, torch.Generator().manual_seed(len(names)))
        network.input_offset.fill_(0.1)
        network.input_scale.fill_(1.7)
        network.input_scale[-1] = 500.0
        network.output_scale.fill_(1e-3)
        network.output_offset.fill_(2e-3)
        groups.append(JointGroup(joints, Inputs.from_names(robot, names, turned)))
        networks.append(network)
    correction = CorrectionNetwork(robot.dof, groups, networks).requires_grad_(False)
    seen = correction.scaled_inputs(forward_kinematics(robot, model.starts), model.starts)
    return replace(model, network=correction, domain=Domain.from_rows(seen, torch.Generator().manual_seed(0)))


@functools.cache
def numeric():
    """A model of a robot without a closed form."""
    robot = Robot.load("ur10")
    dh = robot.dh.copy()
    dh[:, 3] += 0.01 * np.arange(1, 7)
    return hand_made_model("ur10", robot=robot.with_geometry(dh=dh))


MODELS = {
    "kiro3": functools.partial(hand_made_model, "kiro3"),
    "kiro4": functools.partial(hand_made_model, "kiro4"),
    "ur10": functools.partial(hand_made_model, "ur10"),
    "grouped": grouped,
    "numeric": numeric,
}


@functools.cache
def _model(name):
    return MODELS[name]()


@functools.cache
def _kernels(name):
    with no_type_checker():
        return CompiledIK.from_model(_model(name))


def _poses(name, rows=80, spread=0.6):
    model = _model(name)
    q = joints_around(name if name in ("kiro3", "kiro4") else "ur10", rows, seed=3, spread=spread)
    return q, forward_kinematics(model.robot, q)


def _assert_same(found, expected, residuals=True):
    """Assert that all fields of a compiled solution agree with those of torch."""
    solved = np.isfinite(expected.q.numpy()).all(-1)
    assert np.array_equal(np.isfinite(found.q).all(-1), solved)
    assert np.array_equal(found.status, expected.status.numpy())
    assert np.array_equal(found.branch, expected.branch.numpy())
    assert found.branches == expected.branches
    for field in ("q", "q_nominal", "correction", "domain_measure"):
        actual, wanted = getattr(found, field), getattr(expected, field).numpy()
        assert_close(actual[solved], wanted[solved], atol=1e-9)
        assert np.isnan(actual[~solved]).all()
    for field in ("position_residual", "rotation_residual") if residuals else ():
        actual, wanted = getattr(found, field), getattr(expected, field).numpy()
        both = np.isfinite(actual) & np.isfinite(wanted)
        assert both.sum() > 0.5 * solved.sum()
        assert_close(actual[both], wanted[both], atol=1e-11)


@pytest.mark.parametrize("name", MODELS)
def test_solutions_near_joint_values_agree_with_torch(name):
    model, (q, T) = _model(name), _poses(name)
    near = q + 0.1 * torch.sin(17 * q)
    near[::2, 0] += 2 * math.pi
    with no_type_checker():
        expected = NumericIK(model).solve_batch(T, near=near)
    found = _kernels(name).solve_batch(T.numpy(), near=near.numpy())
    _assert_same(found, expected)
    assert {Status.REACHED, Status.OUTSIDE_DOMAIN} <= set(found.status.tolist())
    assert np.abs(found.correction[found.status == Status.REACHED]).max() > 1e-3


@pytest.mark.parametrize("name", [name for name in MODELS if name != "numeric"])
def test_every_branch_agrees_with_torch(name):
    _, T = _poses(name)
    with no_type_checker():
        expected = NumericIK(_model(name)).all_branches(T)
    found = _kernels(name).all_branches(T.numpy())
    _assert_same(found, expected)
    for index, branch in enumerate(found.branches):
        alone = _kernels(name).solve_batch(T.numpy(), branch=branch)
        assert np.array_equal(alone.q, found.q[:, index], equal_nan=True)
        assert np.array_equal(alone.status, found.status[:, index])


def test_without_branches_stored_joint_values_are_the_start():
    _, T = _poses("numeric", spread=0.2)
    with no_type_checker():
        expected = NumericIK(_model("numeric")).solve_batch(T)
    found = _kernels("numeric").solve_batch(T.numpy())
    _assert_same(found, expected)
    every = _kernels("numeric").all_branches(T.numpy())
    assert every.q.shape == (len(T), 1, 6)
    assert_close(every.q[:, 0], found.q, atol=1e-12)


def test_poses_at_ninety_degrees_of_pitch_agree_with_torch():
    model = grouped()
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]], dtype=torch.float64)
    T[:3, :3] = torch.from_numpy(model.network.groups[0].inputs.reference_rotation) @ T[:3, :3]
    T[:3, 3] = torch.tensor([0.5, 0.3, 0.4], dtype=torch.float64)
    with no_type_checker():
        expected = NumericIK(model).all_branches(T[None])
    assert np.isfinite(expected.q.numpy()).all(-1).any()
    found = _kernels("grouped").all_branches(T[None].numpy())
    _assert_same(
        found, expected, residuals=False
    )  # roll and yaw jump there, so two joint values lead to one pose


def test_a_model_without_domain_has_no_measure():
    model = replace(_model("ur10"), domain=None)
    _, T = _poses("ur10", rows=3)
    found = CompiledIK.from_model(model).solve_batch(T.numpy())
    assert np.isnan(found.domain_measure).all()
    assert np.isfinite(found.q).all()


def test_a_file_keeps_the_network(tmp_path):
    _, T = _poses("grouped", rows=5)
    save_compiled(grouped(), tmp_path / "compiled.npz")
    again = CompiledIK.load(tmp_path / "compiled.npz").solve_batch(T.numpy())
    assert_close(again.q, _kernels("grouped").solve_batch(T.numpy()).q, atol=0.0)


def test_networks_that_are_too_large_are_rejected():
    model = _model("ur10")
    domain = Domain(model.domain.samples.repeat(40, 1), model.domain.radius)
    with refused(ModelError, expected="at most 2048 training rows", value=2560):
        CompiledIK.from_model(replace(model, domain=domain))
    assert describe_as_arrays(replace(model, domain=domain))[0].network.samples == 40 * 64
