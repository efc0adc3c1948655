"""Significant parameter differences between two models."""

import itertools
import math
from dataclasses import replace

import pytest
from testing.closeness import assert_close
from testing.compared import COLLISION, after_collision, model_of

from pisigma.lifetime.comparison.model_pair import ModelPair
from pisigma.lifetime.comparison.parameter_differences import parameter_differences
from pisigma.lifetime.comparison.parameter_effects import ParameterEffects
from pisigma.lifetime.recalibration.movement import NORMAL_95
from pisigma.validation.held_out.reference_models import nominal_model


@pytest.mark.parametrize("forth", [True, False])
def test_only_the_moved_joint_differs_when_the_base_moved_as_well(forth):
    models = model_of(50), after_collision()
    differences = parameter_differences(ModelPair.from_models(*models[:: 1 if forth else -1], "fitted"))
    (joint,) = (one.shift for one in differences.significant_differences)
    assert joint.what == "joint 3"
    assert_close(joint.shift, 0.1 if forth else -0.1, atol=0.005)
    assert joint.interval[0] < (0.1 if forth else -0.1) < joint.interval[1]
    assert differences.remainder is not None
    assert not differences.remainder.significant
    base = [one for one in differences.frame_movements if one.what == "base"]
    assert_close(base[0].shift, math.hypot(300, 200, 100), atol=0.2)
    tool = [one for one in differences.frame_movements if one.what == "tool"]
    assert_close(tool[0].shift, 0.0, atol=0.1)


def test_fixed_frames_find_the_same_joint():
    models = model_of(50), model_of(61, COLLISION)
    differences = parameter_differences(ModelPair.from_models(*models, "fixed"))
    assert [one.shift.what for one in differences.significant_differences] == ["joint 3"]
    assert differences.frame_movements == ()


def test_models_of_disjoint_rows_differ_by_chance_only():
    """Six pairs at a simultaneous level of 1 %; of single shifts at most about 5 % lie outside their 95 % intervals."""
    models = [model_of(seed) for seed in (50, 51, 52, 53)]
    outside = tested = 0
    for pair in itertools.combinations(models, 2):
        differences = parameter_differences(ModelPair.from_models(*pair, "fitted"))
        assert differences.significant_differences == ()
        assert differences.remainder is not None
        assert not differences.remainder.significant
        for one in differences.parameters:
            if one.shift is not None and one.sigma is not None:
                tested += 1
                outside += abs(one.shift) > NORMAL_95 * one.sigma
    assert tested > 100
    assert outside <= 0.08 * tested


def test_parameters_equivalent_to_base_and_tool_have_no_shift():
    parameters = parameter_differences(ModelPair.from_models(model_of(50), model_of(51), "fitted")).parameters
    by_name = {one.name: one for one in parameters}
    for name in ("theta_1", "d_1", "theta_6", "d_6", "a_6", "alpha_6"):
        assert by_name[name].shift is None
    assert by_name["d_2"].equivalent_parameters == ("d_3", "d_4")  # along parallel axes


def test_a_nominal_robot_has_no_uncertainty():
    model = model_of(50)
    differences = parameter_differences(ModelPair.from_models(model, nominal_model(model, True), "fitted"))
    assert differences.significant_differences
    assert all(one.sigmas[1] == 0.0 for one in differences.parameters)


def test_a_displacement_that_is_explained_completely_is_due_to_chance():
    """The variance that is left is a rounding error."""
    model = model_of(50)
    effects = ParameterEffects(ModelPair.from_models(model, nominal_model(model, True), "fitted"))
    effects._M, effects._y = effects._W @ effects._W.t(), effects._W.sum(1, keepdim=True)
    assert effects.remainder_p_value(range(len(effects.standard_scores([])) - 12)) == 1.0


def test_a_model_without_posterior_is_compared_without_tests():
    first = model_of(50)
    differences = parameter_differences(
        ModelPair.from_models(first, replace(model_of(51), uncertainty=None), "fitted")
    )
    assert differences.remainder is None
    assert all(one.p_value is None and one.sigmas[1] is None for one in differences.parameters)
