"""The type checker of the tests stops what the annotations exclude."""

from dataclasses import dataclass

import pytest
import torch
from beartype.roar import BeartypeCallHintParamViolation, BeartypeCallHintReturnViolation
from jaxtyping import Float64
from testing.models import no_type_checker
from testing.type_checker import type_checked
from torch import Tensor

from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics


@type_checked
def doubled(x: Float64[Tensor, " n"], y: Float64[Tensor, " n"]) -> Float64[Tensor, " n"]:
    return torch.cat([x, y]) if len(x) > 2 else x + y


@type_checked
def paired(x: Float64[Tensor, "*batch n"], y: Float64[Tensor, "*batch m"]) -> Float64[Tensor, "*batch n"]:
    return x + y.sum(-1, keepdim=True)


@type_checked
@dataclass(frozen=True)
class Pair:
    name: str
    value: Float64[Tensor, " 2"]


def test_arguments_results_and_fields_are_checked():
    two, three = torch.zeros(2).double(), torch.zeros(3).double()
    assert len(doubled(two, two)) == 2
    assert Pair("a", two).value is two
    for wrong in (lambda: doubled(two, three), lambda: doubled(two.float(), two), lambda: Pair("a", three)):
        with pytest.raises(BeartypeCallHintParamViolation):
            wrong()
    with pytest.raises(BeartypeCallHintReturnViolation):
        doubled(three, three)
    with no_type_checker():
        assert len(doubled(three, three)) == 6


def test_axes_have_one_size_though_shapes_are_remembered():
    few, many = torch.zeros(4, 2).double(), torch.zeros(5, 2).double()
    for x, y in ((few, few), (many, many), (few, torch.zeros(4, 3).double())):
        assert paired(x, y).shape == x.shape
    for x, y in ((few, many), (few, few[0]), (few[0], few)):
        with pytest.raises(BeartypeCallHintParamViolation):
            paired(x, y)


def test_pisigma_is_checked():
    with pytest.raises(BeartypeCallHintParamViolation):
        forward_kinematics(Robot.load("ur5"), [0.0] * 6)
