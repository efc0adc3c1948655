"""Recipes of the hybrid calibrator: mistakes are refused, and repeats use other random numbers."""

import dataclasses

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.files.errors import RecipeError
from pisigma.robot import Robot
from pisigma.workflow.recipes.data import load_data, simulate, with_other_seeds
from pisigma.workflow.recipes.reader import read_recipe
from pisigma.workflow.recipes.recipe import HybridRecipe, MeasuredData, SimulatedData

RB5 = "rb5_hybrid"
SMALL = (("count: 5000", "count: 40"), ("repeats: 5", "repeats: 2"))
HYBRID = "repeats: 5\n"


@pytest.mark.parametrize("name", ["ur5_hybrid", "ur10_hybrid", RB5])
def test_shipped_recipes_parse_and_state_their_kind(repository, name):
    recipe = read_recipe(repository / "training" / f"{name}.yaml")
    assert isinstance(recipe, HybridRecipe)
    assert recipe.name == name
    assert recipe.description
    assert recipe.not_validated
    assert recipe.learning_curve is not None
    calibrator = recipe.calibrator(Robot.load(recipe.robot))
    defaults = {one.name: one.default for one in dataclasses.fields(HybridCalibrator) if one.name != "robot"}
    assert {name: getattr(calibrator, name) for name in defaults} == defaults


def test_every_error_source_is_on(repository):
    data = read_recipe(repository / "training" / f"{RB5}.yaml").data
    assert isinstance(data, SimulatedData)
    kinds = {source.kind for source in data.errors}
    assert kinds == {"geometric", "geometric_random", "transmission", "joint_compliance", "encoder"}
    assert (data.training.poses.count, data.held_out.poses.count) == (150, 5000)  # type: ignore[union-attr]
    assert data.training.noise is not None
    assert data.training.noise.position_mm == 0.03
    assert data.held_out.noise is None


@pytest.mark.parametrize(
    ("old", "new", "key", "named"),
    [
        (HYBRID, "hybrid: {features: [gravty]}\n", "hybrid", "'gravity'"),
        (HYBRID, "hybrid: {harmonics: []}\n", "hybrid", "harmonics"),
        (HYBRID, "hybrid: {products: 3}\n", "hybrid.products", ""),
        (HYBRID, "hybrid: {product: true}\n", "hybrid.product", "'products'"),
        (HYBRID, "repeats: 0\n", "repeats", ""),
        (HYBRID, "repeats: 1000000000\n", "repeats", "100"),
        ("count: 5000", "count: 1000000000", "data.held_out.poses.count", "100000"),
        ("rows: [30, 50, 75, 100]", "rows: []", "learning_curve.rows", ""),
        ("rows: [30, 50, 75, 100]", "rows: [0]", "learning_curve.rows.0", ""),
        ("joint: theta_1", "joint: theta_9", "data.errors", "theta_9"),
        ("count: 150, seed: 100", "count: 150, seed: 100, range_deg: {q: [0, 1]}", "data.training.poses", ""),
        ("kind: hybrid_calibration", "kind: hybrid_calibratio", "kind", "'hybrid_calibration'"),
        ("kind: simulated", "kind: simulatd", "data.kind", "'simulated'"),
    ],
)
def test_mistakes_are_refused_with_place(write_recipe, old, new, key, named):
    path = write_recipe(RB5, (old, new))
    with refused(RecipeError, file=path, column=key) as caught:
        read_recipe(path)
    assert caught.value.line >= 1
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


def test_repeats_are_other_robots_other_poses_and_other_noise(write_recipe):
    recipe = read_recipe(write_recipe(RB5, *SMALL))
    rows, parts = load_data(recipe).splits()
    assert rows.rows == 2 * (150 + 40)
    assert [(len(train), len(test)) for train, test in parts] == [(150, 40)] * 2
    assert sorted(torch.cat([part for both in parts for part in both]).tolist()) == list(range(rows.rows))
    data = simulate(recipe)
    assert len(data.simulations) == 1
    first, held_out = data.training, data.held_out
    (train, test), (other, _) = parts
    assert_close(rows.q[train], first.q, atol=0.0)
    assert_close(rows.position[train], first.position, atol=0.0)
    assert_close(rows.position[test], held_out.position, atol=0.0)
    assert float((rows.q[other] - first.q).abs().min()) > 0
    again = with_other_seeds(recipe.data, 0)
    assert again == recipe.data
    seeds = [source.seed for source in with_other_seeds(recipe.data, 3).errors if hasattr(source, "seed")]
    assert seeds == [3]


def test_measured_recipes_need_a_file_and_simulated_ones_refuse_it(write_recipe, tmp_path):
    recipe = read_recipe(write_recipe("ur5_hybrid"))
    assert isinstance(recipe.data, MeasuredData)
    with refused(RecipeError, option="", value=recipe.name):
        load_data(recipe)
    with refused(RecipeError, expected="a recipe that simulates its data", value=recipe.name):
        simulate(recipe)
    with refused(RecipeError, option="--data", value=RB5):
        load_data(read_recipe(write_recipe(RB5)), tmp_path / "rows.csv")
