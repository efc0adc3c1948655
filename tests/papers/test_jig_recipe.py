"""The recipe of touched jigs: it parses, and identifies the parameters of the paper."""

import math

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from jig_recipe import (
    JIGS,
    JigRecipe,
    calibrate_on,
    nominal_calibration,
    read_jig_recipe,
)
from pisigma.files.errors import IdentificationError, RecipeError
from pisigma.robot.se3 import wrap_to_pi
from pisigma.simulation.touch_candidates import JigPlacement
from pisigma.workflow.recipes.reader import read_recipe


@pytest.fixture(scope="module")
def recipe(repository) -> JigRecipe:
    return read_jig_recipe(repository / "training" / JIGS)


def small(recipe: JigRecipe, **changes: object) -> JigRecipe:
    touches = recipe.touches.model_copy(update={"count": 48})
    return recipe.model_copy(update={"touches": touches} | changes)


def test_the_product_does_not_train_it(repository):
    with refused(RecipeError, file=JIGS.name, column="kind"):
        read_recipe(repository / "training" / JIGS)


def test_the_true_robot_has_the_papers_values(recipe):
    published, robot = recipe.paper["parameters"]["both"], recipe.true_robot().true_geometry
    columns = {"theta": 0, "d": 1, "a": 2}
    for name in recipe.paper_parameters:
        column, row = name.split("_")
        value = robot.dh[int(row) - 1, columns[column]]
        value = math.degrees(value) if column == "theta" else 1e3 * value
        assert_close(value, published[name], atol=1e-9)
    tool = [published[f"tool_{axis}"] for axis in "xyz"]
    assert_close(1e3 * robot.tool[:3], tool, atol=1e-9)
    for placement in recipe.placements:
        base = placement.true_base.to_si()
        for place, name in enumerate(("x", "y", "z", "roll", "pitch", "yaw")):
            stated = 1e3 * base[place] if place < 3 else math.degrees(base[place])
            assert_close(stated, published[f"base_{placement.name}_{name}"], atol=1e-9)


def test_without_noise_the_papers_parameters_come_back(recipe):
    exact = recipe.noise.model_copy(update={"sensor_mm": 0.0, "repeatability_mm": 0.0})
    stated = small(recipe, noise=exact)
    measurements = stated.measure(stated.draw_touches(0), 0)
    assert measurements.rows == 96
    for frames, count in ((("jig_1",), 17), (("jig_2",), 17), (("jig_1", "jig_2"), 23)):
        found = calibrate_on(stated, measurements, frames)
        assert len(found.result.free_parameters) == count
        assert list(found.bases) == list(frames)
        true = stated.true_robot().true_geometry
        assert_close(found.arm.dh, true.dh, atol=1e-9)
        assert_close(found.arm.tool, true.tool, atol=1e-9)
        for placement in stated.placements:
            if placement.name in frames:
                difference = torch.from_numpy(found.bases[placement.name] - placement.true_base.to_si())
                difference[3:] = wrap_to_pi(difference[3:])
                assert_close(difference, torch.zeros(6), atol=1e-9)


def test_a_third_jig_adds_six_unknowns(recipe):
    exact = recipe.noise.model_copy(update={"sensor_mm": 0.0, "repeatability_mm": 0.0})
    believed, true = {"x_mm": 700, "y_mm": 250, "roll_deg": 180}, {"x_mm": 705, "y_mm": 247, "roll_deg": 181}
    third = JigPlacement(name="jig_3", base=believed, true_base=true)
    stated = small(recipe, noise=exact, placements=(*recipe.placements, third))
    found = calibrate_on(stated, stated.measure(stated.draw_touches(0), 0), stated.frames)
    assert len(found.result.free_parameters) == 29
    assert_close(found.arm.dh, stated.true_robot().true_geometry.dh, atol=1e-9)
    difference = torch.from_numpy(found.bases["jig_3"] - third.true_base.to_si())
    difference[3:] = wrap_to_pi(difference[3:])
    assert_close(difference, torch.zeros(6), atol=1e-9)


def test_seeds_draw_other_touches_and_noise(recipe):
    stated = small(recipe)
    first, again, other = (stated.draw_touches(seed) for seed in (0, 0, 1))
    assert torch.equal(first.q, again.q)
    assert not torch.equal(first.q, other.q)
    touched = [stated.measure(first, seed) for seed in (0, 0, 1)]
    assert_close(touched[0].q, touched[1].q)
    assert float((touched[0].q - touched[2].q).abs().max()) > 1e-6


def test_the_nominal_calibration_is_what_the_operator_believes(recipe):
    nominal = nominal_calibration(recipe)
    assert nominal.result is None
    assert_close(nominal.bases["jig_1"], recipe.placements[0].base.to_si())
    assert_close(nominal.arm.dh, recipe.true_robot().nominal.dh)


def test_the_workspace_is_within_reach(recipe):
    q, robot = recipe.workspace_joints(), recipe.true_robot().nominal
    limits = torch.from_numpy(robot.limits)
    assert 1000 < len(q) <= recipe.workspace.count
    assert bool(((q >= limits[:, 0]) & (q <= limits[:, 1])).all())


def test_touches_on_no_jig_are_refused(recipe):
    stated = small(recipe)
    measurements = stated.measure(stated.draw_touches(0), 0)
    with refused(IdentificationError, option="frames", value="touches on jig_1, jig_2"):
        calibrate_on(stated, measurements, ("jig_3",))


@pytest.mark.parametrize(
    ("old", "new", "key", "named"),
    [
        ("name: jig_2\n", "name: jig_1\n", None, "'jig_1'"),
        ("seeds: 50", "seeds: 0", "seeds", ""),
        ("paper_parameters:", "papers_parameters:", "papers_parameters", "'paper_parameters'"),
    ],
)
def test_recipes_with_mistakes_are_refused(repository, tmp_path, old, new, key, named):
    text = (repository / "training" / JIGS).read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "jigs.yaml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with refused(RecipeError, file=path, column=key) as caught:
        read_jig_recipe(path)
    assert named in str(caught.value)
