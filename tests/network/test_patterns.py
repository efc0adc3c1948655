"""Scaling, validation rows, and data that do not determine a network."""

import dataclasses

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import IdentificationError
from pisigma.network.networks import fit_networks
from pisigma.network.pairs import TrainingPairs
from pisigma.network.patterns import TARGET_RANGE, build_network, build_patterns
from pisigma.network.sections import GradientDescentSection, LevenbergMarquardtSection, NetworkSection
from pisigma.robot import Robot

SECTION = NetworkSection(joints=("theta_1", "theta_2"), inputs=("x", "sin(theta_1)"), orders=(2,))


@pytest.fixture
def pairs(generator) -> TrainingPairs:
    q = torch.rand(40, 4, generator=generator, dtype=torch.float64)
    T = torch.eye(4, dtype=torch.float64).repeat(40, 1, 1)
    T[:, :3, 3] = torch.rand(40, 3, generator=generator, dtype=torch.float64)
    target = 0.01 * torch.rand(40, 4, generator=generator, dtype=torch.float64) + 0.1
    used, none = torch.ones(40, dtype=torch.bool), torch.zeros(40, dtype=torch.bool)
    return TrainingPairs(T, q, target, used, none, none, ())


def patterns_of(pairs: TrainingPairs, share: float = 0.25, groups: torch.Tensor | None = None, seed: int = 0):
    network = build_network(Robot.load("kiro3"), [SECTION], pairs)
    rows = torch.arange(len(pairs.used_rows)) if groups is None else groups
    generator = torch.Generator().manual_seed(seed)
    return network, build_patterns(network, pairs, share, rows, generator)[0]


def test_used_rows_are_scaled_to_their_range(pairs):
    network, patterns = patterns_of(pairs)
    ones = torch.ones(2, dtype=torch.float64)
    assert_close(patterns.x.amin(0), -ones, atol=1e-12)
    assert_close(patterns.x.amax(0), ones, atol=1e-12)
    assert_close(patterns.d.amin(0), 0 * ones, atol=1e-12)
    assert_close(patterns.d.amax(0), TARGET_RANGE / 40**0.5 * ones, atol=1e-12)
    net = network.networks[0]
    assert_close(net.fixed.prod(-1), 40**-0.5 * ones, rtol=1e-14)
    assert_close(net.output_offset + net.output_scale * patterns.d, pairs.target[:, :2], atol=1e-15)


def test_unused_rows_have_no_effect(pairs):
    used = pairs.used_rows.clone()
    used[:10] = False
    clean = dataclasses.replace(pairs, used_rows=used)
    T, target = pairs.T.clone(), pairs.target.clone()
    T[:10], target[:10] = 1e6, -1e6
    spoilt = dataclasses.replace(clean, T=T, target=target)
    (first, a), (second, b) = patterns_of(clean), patterns_of(spoilt)
    assert a.x.shape == (30, 2)
    for name, value in first.state_dict().items():
        assert_close(second.state_dict()[name], value, atol=0)
    for part in ("x", "d", "validation"):
        assert_close(getattr(b, part), getattr(a, part), atol=0)


def test_validation_rows_are_whole_groups_of_about_the_share(pairs):
    groups = torch.arange(40) // 4
    _, patterns = patterns_of(pairs, 0.25, groups)
    per_group = patterns.validation.reshape(10, 4)
    assert torch.equal(per_group.any(1), per_group.all(1))
    assert int(patterns.validation.sum()) == 12  # the first number of fours that is not below 10
    assert not torch.equal(patterns_of(pairs, 0.25, groups, seed=1)[1].validation, patterns.validation)
    assert torch.equal(patterns_of(pairs, 0.25, groups)[1].validation, patterns.validation)
    assert not patterns_of(pairs, 0.0)[1].validation.any()


def test_one_group_is_always_fitted(pairs):
    _, patterns = patterns_of(pairs, 0.5, torch.zeros(40, dtype=torch.int64))
    assert not patterns.validation.any()
    _, patterns = patterns_of(pairs, 0.5, (torch.arange(40) >= 20).long())
    assert int(patterns.validation.sum()) == 20


@pytest.mark.parametrize("rows", [1, 2])
def test_too_few_rows_are_rejected(pairs, rows):
    few = dataclasses.replace(pairs, used_rows=torch.arange(40) < rows)
    with refused(IdentificationError, value="x" if rows == 1 else 2):
        patterns_of(few, 0.0)


def test_as_many_rows_as_free_parameters_are_enough(pairs):
    five = dataclasses.replace(pairs, used_rows=torch.arange(40) < 5)
    assert patterns_of(five, 0.0)[1].x.shape == (5, 2)
    with refused(IdentificationError, expected="at least 5 rows", value=4):
        patterns_of(dataclasses.replace(pairs, used_rows=torch.arange(40) < 4), 0.0)


def test_a_constant_input_is_rejected(pairs):
    T = pairs.T.clone()
    T[:, 0, 3] = 0.3
    with refused(IdentificationError, value="x"):
        patterns_of(dataclasses.replace(pairs, T=T))


FITS = [
    GradientDescentSection(method="gradient_descent", learning_rate={"theta_1": 0.1, "theta_2": 0.1}, epochs=20),
    LevenbergMarquardtSection(method="levenberg_marquardt", epochs=30, starts=1),
]  # fmt: skip


@pytest.mark.parametrize("fit", FITS, ids=["gradient_descent", "levenberg_marquardt"])
def test_a_constant_target_is_learned_as_a_constant(pairs, fit):
    target = pairs.target.clone()
    target[:, 0] = 0.123
    constant = dataclasses.replace(pairs, target=target)
    network, patterns = patterns_of(constant)
    fit_networks(list(network.networks), [patterns], [SECTION.joints], fit)
    correction = network(constant.T, constant.q_nominal).detach()
    assert_close(correction[:, 0], torch.full((40,), 0.123, dtype=torch.float64), atol=1e-10)
