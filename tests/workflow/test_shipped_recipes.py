"""Every shipped recipe parses, and trains to its stated figures."""

import json
from pathlib import Path

import pytest
import torch
import yaml
from testing.closeness import assert_close
from testing.models import no_type_checker, shipped_training

import pisigma
from pisigma.validation.held_out.training_summary import TrainingRun
from pisigma.workflow.recipes.data import load_data
from pisigma.workflow.recipes.reader import read_recipe
from pisigma.workflow.recipes.recipe import GeometricRecipe, InverseRecipe, SimulatedData
from pisigma.workflow.train import train_networks

FOLDER = Path(__file__).parents[2] / "training"
INVERSE = sorted(p.stem for p in FOLDER.glob("*.yaml") if "network" in yaml.safe_load(p.read_text()))
SIGNS = {
    "kiro3_paper": {"theta_1": {-1, 1}, "theta_2": {1}},
    "kiro4_paper": {"theta_2": {-1, 1}, "theta_3": {-1, 1}},
}
STATISTICS = ("average_deg", "deviation_deg", "maximum_deg")


def read(name: str) -> InverseRecipe:
    return read_recipe(FOLDER / f"{name}.yaml")


def trained(name: str, seed: int | None = None) -> tuple[TrainingRun, list[dict]]:
    """Return the training of a shipped recipe, and the figures of its joints."""
    training = shipped_training(name) if seed is None else shipped_training(name, seed)
    return training.run, training.to_json()["joints"]


GEOMETRIC = sorted(
    p.stem
    for p in FOLDER.glob("*.yaml")
    if yaml.safe_load(p.read_text()).get("kind") == "geometric_calibration"
)


def test_the_recipes_of_geometric_calibration_are_there():
    assert {"rb5_redundancy", "panda_redundancy"} <= set(GEOMETRIC)
    assert not set(INVERSE) & set(GEOMETRIC)


@pytest.mark.parametrize("name", GEOMETRIC)
def test_a_geometric_recipe_parses_and_states_its_kind(name):
    recipe = read_recipe(FOLDER / f"{name}.yaml")
    assert isinstance(recipe, GeometricRecipe)
    assert recipe.name == name
    assert recipe.description
    assert recipe.not_validated
    assert recipe.held_out.poses.count >= 2000
    assert recipe.held_out.poses.seed != recipe.measurements.poses.seed


def test_the_recipes_of_inverse_calibration_are_there():
    wanted = {"kiro3", "kiro4", "kiro3_paper", "kiro4_paper", "kiro3_physical", "ur10_inverse"}
    assert wanted <= set(INVERSE)


@pytest.mark.parametrize("name", INVERSE)
def test_the_recipe_parses_and_states_its_kind(name):
    recipe = read(name)
    assert recipe.name == name
    assert recipe.description
    assert recipe.not_validated
    if isinstance(recipe.data, SimulatedData):
        assert recipe.data.held_out.poses.count >= 2000


@pytest.mark.parametrize("name", ["kiro3_paper", "kiro4_paper"])
def test_the_papers_network_agrees_with_the_paper(name):
    recipe = read(name)
    assert (recipe.fit.method, recipe.fit.epochs) == ("gradient_descent", 3000)
    assert {group.orders for group in recipe.network} == {(3,)}
    run, reports = trained(name)
    assert [report["name"] for report in reports] == list(recipe.paper)
    for index, report in enumerate(reports):
        before, after, paper = report["training"]["before"], report["training"]["after"], report["paper"]
        for key in STATISTICS:
            assert_close(before[key], paper["before"][key], rtol=0.02)
        assert after["average_deg"] <= paper["after"]["average_deg"]
        signs = set(run.training.before[:, index].sign().int().tolist())
        expected = SIGNS[name].get(report["name"])
        assert signs == expected if expected else len(signs) == 1
    assert run.history.energies.shape == (3000, len(reports))


@pytest.mark.parametrize(("name", "seed"), [("kiro3", None), ("kiro3", 3), ("kiro4", 3)])
def test_the_default_is_ten_times_better_than_the_paper_on_new_poses(name, seed):
    recipe = read(name)
    run, reports = trained(name, seed)
    for report in reports:
        assert report["held_out"]["after"]["average_deg"] <= report["paper"]["after"]["average_deg"] / 10
    assert len(run.held_out.before) == 2000
    assert len(run.history.energies) < recipe.fit.epochs  # it ended because it had converged


def test_the_physical_robot_is_corrected_too():
    for report in trained("kiro3_physical")[1]:
        for key in STATISTICS:
            assert_close(report["training"]["before"][key], report["paper"]["before"][key], rtol=0.02)
        assert report["held_out"]["after"]["average_deg"] < report["held_out"]["before"]["average_deg"] / 20


def test_a_seed_gives_the_same_model_bit_for_bit_and_another_does_not():
    recipe = read("kiro3")
    recipe = recipe.model_copy(update={"fit": recipe.fit.model_copy(update={"epochs": 10})})
    rows, states = load_data(recipe), []
    for seed in (3, 3, 4):
        seeded = recipe.model_copy(update={"fit": recipe.fit.model_copy(update={"seed": seed})})
        with no_type_checker():
            states.append(train_networks(seeded, rows).model.network.state_dict())
    first, again, other = states
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert any(not torch.equal(first[name], other[name]) for name in first)


def test_mini_batches_learn_and_the_stored_result_is_of_more_epochs():
    recipe = read("kiro3_mini_batches")
    assert recipe.fit.epochs == 300
    short = recipe.model_copy(update={"fit": recipe.fit.model_copy(update={"epochs": 40})})
    with no_type_checker():
        reports = pisigma.train(short).to_json()["joints"]
    stored = json.loads((FOLDER / "results" / "kiro3_mini_batches.json").read_text())["joints"]
    for report, whole in zip(reports, stored, strict=True):
        assert report["training"]["before"] == pytest.approx(whole["training"]["before"])
        before, after, later = (
            report["held_out"]["before"],
            report["held_out"]["after"],
            whole["held_out"]["after"],
        )
        assert later["average_deg"] < after["average_deg"] < before["average_deg"] / 8
        assert later["average_deg"] < before["average_deg"] / 30
