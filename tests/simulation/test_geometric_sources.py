"""Errors of geometry, given and random."""

import math

import numpy as np
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import RecipeError
from pisigma.robot import Robot
from pisigma.simulation.errors.geometric import GeometricDeviation, RandomGeometricDeviation

UR10 = Robot.load("ur10")


def test_given_errors_are_in_their_columns():
    source = GeometricDeviation(
        kind="geometric",
        rows={
            "theta_2": {"theta_deg": 1, "d_mm": 2, "a_mm": 3, "alpha_deg": 4, "beta_deg": 5},
            "theta_6": {"a_mm": -1},
        },
        base={"x_mm": 1, "yaw_deg": 2},
        tool={"z_mm": 3, "roll_deg": 4},
    )
    change = source.parameter_errors(UR10, "here")
    dh = np.zeros((6, 5))
    dh[1] = [math.radians(1), 0.002, 0.003, math.radians(4), math.radians(5)]
    dh[5, 2] = -0.001
    assert_close(change.dh, dh, atol=1e-17)
    assert_close(change.base, [0.001, 0, 0, 0, 0, math.radians(2)], atol=1e-17)
    assert_close(change.tool, [0, 0, 0.003, math.radians(4), 0, 0], atol=1e-17)


def test_unknown_row_is_refused_with_the_nearest_name():
    source = GeometricDeviation(kind="geometric", rows={"tetha_2": {"a_mm": 1}})
    with refused(RecipeError, option="errors[3]", value="tetha_2") as caught:
        source.parameter_errors(UR10, "errors[3]")
    assert "'theta_2'" in caught.value.remedy


def drawn(**fields):
    settings = {"distribution": "uniform", "seed": 1, "length_mm": 1, "angle_deg": 1} | fields
    return RandomGeometricDeviation(kind="geometric_random", **settings).parameter_errors(UR10, "here")


def test_uniform_errors_are_within_their_bounds():
    values = np.stack([drawn(seed=seed).dh for seed in range(200)])
    scaled = values / np.array([math.radians(1), 1e-3, 1e-3, math.radians(1), math.radians(1)])
    assert abs(scaled).max() <= 1.0
    assert (abs(scaled).max((0, 1)) > 0.99).all()
    assert_close(scaled.mean((0, 1)), 0.0, atol=5 / math.sqrt(3 * 1200))
    assert_close(scaled.std((0, 1)), 1 / math.sqrt(3), rtol=0.05)


def test_normal_errors_have_their_standard_deviation():
    values = np.stack([drawn(seed=seed, distribution="normal").dh for seed in range(200)])
    expected = [math.radians(1), 1e-3, 1e-3, math.radians(1), math.radians(1)]
    assert_close(values.std((0, 1)), expected, rtol=0.1)
    assert abs(values[..., 1]).max() > 2e-3


def test_seeds_repeat_and_differ():
    assert_close(drawn(seed=7).dh, drawn(seed=7).dh)
    assert abs(drawn(seed=7).dh - drawn(seed=8).dh).min() > 0


def test_sizes_do_not_change_other_errors():
    alone, all_of_it = drawn(), drawn(base_length_mm=5, base_angle_deg=2, tool_length_mm=3, tool_angle_deg=4)
    assert_close(alone.dh, all_of_it.dh)
    assert_close(alone.base, 0.0)
    assert_close(alone.tool, 0.0)
    without_base = drawn(tool_length_mm=3, tool_angle_deg=4)
    assert_close(without_base.tool, all_of_it.tool)


def test_base_and_tool_have_separate_sizes():
    sizes = {"base_length_mm": 5, "base_angle_deg": 2, "tool_length_mm": 3, "tool_angle_deg": 4}
    changes = [drawn(seed=seed, **sizes) for seed in range(200)]
    for frame, length, angle in (("base", 5e-3, 2), ("tool", 3e-3, 4)):
        largest = np.stack([abs(getattr(change, frame)) for change in changes]).max(0)
        assert_close(largest, np.repeat([length, math.radians(angle)], 3), rtol=0.05)
