"""Recipes of the geometric calibrator: mistakes are refused when read, with file, line and key."""

import pytest
from testing.refusals import refused

from pisigma.files.errors import RecipeError, UnknownRobotError
from pisigma.workflow.recipes.reader import read_recipe
from pisigma.workflow.recipes.recipe import GeometricRecipe, InverseRecipe

RB5 = "rb5_redundancy"
ERRORS = "errors:\n"
GEOMETRIC = "errors:\n  - {kind: geometric, rows: {theta_9: {a_mm: 1.0}}}\n"


@pytest.mark.parametrize(
    ("old", "new", "key", "named"),
    [
        ("kind: geometric_c", "kind: geometric_", "kind", "'geometric_calibration'"),
        ("calibration: {base", "calibration: {bse", "calibration.bse", "'base'"),
        ("elimination: pairwise", "elimination: pairs", "calibration.elimination", "'pairs'"),
        ("kind: geometric_random", "kind: geometric_randm", "errors.0.kind", "'geometric_random'"),
        (ERRORS, GEOMETRIC, "errors", "theta_9"),
        (
            "count: 40, seed: 1",
            "count: 40, seed: 1, range_deg: {theta_7: [0, 1]}",
            "measurements.poses",
            "theta_7",
        ),
        (
            "count: 2000, seed: 2",
            "count: 2000, seed: 2, range_deg: {theta_7: [0, 1]}",
            "held_out.poses",
            "theta_7",
        ),
        ("prior: null", "prior: null, free: [a_2, a_9]", "calibration.free", "a_9"),
        ("prior: null", "prior: null, free: offsets", "calibration.free", ""),
        ("prior: null", "prior: {length_mm: 0}", "calibration.prior.length_mm", "0"),
        ("name: rb5_redundancy", "name: ../up", "name", "pattern"),
        ("robot: rb5\n", "", "robot", ""),
    ],
)
def test_mistakes_are_refused_with_place(write_recipe, old, new, key, named):
    path = write_recipe(RB5, (old, new))
    with refused(RecipeError, file=path) as caught:
        read_recipe(path)
    assert caught.value.line >= 1
    assert caught.value.column.startswith(key)
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_robots_and_frames(write_recipe):
    path = write_recipe(RB5, ("robot: rb5\n", "robot: rb55\n"))
    with refused(UnknownRobotError, file=path, column="robot") as caught:
        read_recipe(path)
    assert {"'rb55'", "'rb5'?"} <= set(str(caught.value).split())
    path = write_recipe(RB5, ("held_out:\n", "held_out:\n  frame: other\n"))
    with refused(RecipeError, file=path, column="held_out.frame", value="other"):
        read_recipe(path)


def test_a_kind_need_not_be_stated_where_it_is_inverse_calibration(write_recipe):
    assert isinstance(read_recipe(write_recipe("kiro3_paper")), InverseRecipe)
    assert isinstance(read_recipe(write_recipe(RB5)), GeometricRecipe)
    path = write_recipe("kiro3_paper", ("name: kiro3_paper", "kind: inverse_calibratio\nname: kiro3_paper"))
    with refused(RecipeError, file=path, line=1, column="kind"):
        read_recipe(path)
