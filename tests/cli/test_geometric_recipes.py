"""`pisigma train` and `simulate` with recipes of geometric calibrations."""

import json

import pytest
from testing.screens import assert_screen

import pisigma
from pisigma.files.errors import RecipeError
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot

RECIPES = {"rb5_redundancy": (28, 20, 6), "panda_redundancy": (35, 24, 5)}


@pytest.mark.parametrize("name", RECIPES)
def test_the_papers_protocol(run, repository, tmp_path, name):
    recipe = repository / "training" / f"{name}.yaml"
    printed = json.loads(run("train", recipe, "--out", tmp_path / "model", "--json").stdout)
    left, rank, sets = RECIPES[name]
    paper = printed["paper"]
    assert (printed["pairwise_parameters"], printed["rank"]) == (left, rank)
    assert (paper["pairwise_parameters"], paper["rank"], len(paper["redundant_sets"])) == (left, rank, sets)
    assert sorted(printed["redundant_sets"]) == sorted(paper["redundant_sets"])
    assert set(printed["no_effect"]) == set(paper["no_effect"])
    assert printed["iterations"] <= 10
    assert 2 < len(printed["rmse_mm"]) <= printed["iterations"] + 1  # steps that were not taken have none
    assert printed["rmse_mm"][-1] <= 1e-12 < printed["rmse_mm"][0]
    assert printed["held_out"]["rows"] == 2000
    assert printed["held_out"]["geometric"]["rms_mm"] < 1e-10
    card = (tmp_path / "model" / "README.md").read_text()
    assert "2000" in card
    assert pisigma.load(tmp_path / "model").model.provenance.recipe == name


def test_sets_are_distinguished_in_the_table(run, repository, tmp_path):
    recipe = repository / "training" / "rb5_redundancy.yaml"
    text = run("train", recipe, "--out", tmp_path / "model", "--verbose").stdout
    assert_screen(text, "redundancy and convergence", verbose=True)
    lines = text.splitlines()
    for members in ("{a_6, a_EE}", "{d_2, d_3, d_4}", "{theta_4, -beta_4}"):
        assert sum(line.count(members) == 2 for line in lines) == 1  # ours and the paper's side by side


def test_options_that_a_geometric_recipe_has_no_use_for(refuses, repository, tmp_path):
    recipe = repository / "training" / "rb5_redundancy.yaml"
    for option in (("--data", "poses.csv"), ("--resume",)):
        refuses("train", recipe, "--out", tmp_path / "model", *option, error=RecipeError, option=option[0])


def test_geometric_recipes_write_their_measurements(run, repository, tmp_path):
    recipe = repository / "training" / "rb5_redundancy.yaml"
    for option, rows in (((), 40), (("--held-out",), 2000)):
        printed = json.loads(
            run("simulate", recipe, "--out", tmp_path / "rows.csv", "--json", *option).stdout
        )
        assert printed["rows"] == rows
        read = Measurements.read_csv(tmp_path / "rows.csv", Robot.load("rb5"))
        assert read.rows == rows
        assert read.kinds == {"position"}
