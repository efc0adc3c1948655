"""The report of touched jigs: its figures are defined as in the paper, and it agrees with card and pictures."""

import json

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.models import no_type_checker
from testing.refusals import refused

import pisigma
from jig_accuracy import Bench, deviation, measure_accuracy, rms
from jig_recipe import JIGS, JigCalibration, calibrate_on, nominal_calibration, read_jig_recipe
from jig_report import FIGURES, run_jigs, seed_figures
from jig_run import run_jigs_recipe
from jig_tables import all_tables
from pisigma.files.errors import RecipeError
from pisigma.robot.se3 import rotation_from_zyx

PICTURES = ("touches.png", "errors.png", "straight_lines.png", "seeds.png")


@pytest.fixture(scope="module")
def recipe(repository):
    return read_jig_recipe(repository / "training" / JIGS)


@pytest.fixture(scope="module")
def trained(repository, tmp_path_factory):
    """Folder and report of a small version of the shipped recipe."""
    folder = tmp_path_factory.mktemp("jigs")
    text = (repository / "training" / JIGS).read_text(encoding="utf-8")
    for old, new in (
        ("touches: {count: 96", "touches: {count: 48"),
        ("candidates: {count: 1000", "candidates: {count: 150"),
        ("touches: 192", "touches: 96"),
        ("count: 2000", "count: 200"),
        ("seeds: 50", "seeds: 2"),
    ):
        assert old in text
        text = text.replace(old, new)
    (folder / "jigs.yaml").write_text(text, encoding="utf-8")
    with no_type_checker():
        report = run_jigs_recipe(folder / "jigs.yaml", folder / "model")
    return folder / "model", json.loads(json.dumps(report, allow_nan=False))


def test_rms_and_deviation_are_those_of_the_papers_tables(recipe):
    for table in recipe.paper["absolute_error_mm"].values():
        errors = torch.tensor([table[axis] for axis in "xyz"], dtype=torch.float64).T.contiguous()
        assert_close(rms(errors), table["rms"], atol=0.0052)
        assert_close(deviation(errors), table["deviation"], atol=0.0052)
    table, published = recipe.paper["table_8_mm"], recipe.paper["absolute_error_mm"]
    for key, one in (("mean", "rms"), ("deviation", "deviation")):
        alone = [published[name][one] for name in ("jig_1", "jig_2")]
        both = [published[f"both_seen_from_{name}"][one] for name in ("jig_1", "jig_2")]
        assert_close(np.mean(alone), table["one_jig"][key], atol=1e-9)
        assert_close(np.mean(both), table["both"][key], atol=1e-9)


def test_the_true_parameters_have_no_error(recipe):
    bench = Bench.from_recipe(recipe)
    bases = {placement.name: placement.true_base.to_si() for placement in recipe.placements}
    accuracy = measure_accuracy(bench, JigCalibration(bench.true_robot.true_geometry, bases))
    assert_close(accuracy.points, torch.zeros(4, 3), atol=1e-12)
    assert_close(accuracy.workspace, torch.zeros(len(bench.workspace)), atol=1e-12)
    for errors in accuracy.seen_from.values():
        assert_close(errors, torch.zeros(4, 3), atol=1e-12)


def test_an_error_of_a_jigs_base_is_seen_from_that_jig_only(recipe):
    bench = Bench.from_recipe(recipe)
    bases = {placement.name: placement.true_base.to_si() for placement in recipe.placements}
    bases["jig_2"] = bases["jig_2"] + np.array([1e-3, 0, -2e-3, 0, 0, 0])
    accuracy = measure_accuracy(bench, JigCalibration(bench.true_robot.true_geometry, bases))
    assert_close(accuracy.points, torch.zeros(4, 3), atol=1e-12)
    assert_close(accuracy.seen_from["jig_1"], torch.zeros(4, 3), atol=1e-12)
    assert_close(accuracy.seen_from["jig_2"], torch.tensor([[-1e-3, 0, 2e-3]] * 4), atol=1e-9)


def test_errors_in_the_robot_and_jig_frames_differ_by_a_rotation_where_the_base_is_right(recipe):
    bench = Bench.from_recipe(recipe)
    bases = {placement.name: placement.true_base.to_si() for placement in recipe.placements}
    accuracy = measure_accuracy(bench, JigCalibration(nominal_calibration(recipe).arm, bases))
    assert rms(accuracy.points) > 1e-3
    for placement in recipe.placements:
        R = rotation_from_zyx(torch.from_numpy(placement.true_base.to_si()[3:]))
        assert_close(accuracy.seen_from[placement.name], accuracy.points @ R.mT, atol=1e-12)


def test_ratios_are_averages_over_averages():
    setups = ("jig_1", "jig_2", "both", "default", "planned", "random")
    values = {setup: {name: np.array([1.0, 3.0]) * (place + 1) for name in FIGURES}
              for place, setup in enumerate(setups)}  # fmt: skip
    found = seed_figures(values, ("jig_1", "jig_2"))
    assert found["count"] == 2
    assert_close(found["averages"]["both"]["rms_mm"], 6000.0)
    assert_close(found["spreads"]["both"]["rms_mm"], 3000.0)
    assert_close(found["ratios"]["both_over_single"]["rms"], 2.0)
    assert_close(found["ratios"]["planned_over_random"]["mean"], 5 / 6)
    assert found["share_of_seeds_won_by_both"] == 0


def test_the_default_is_no_worse_than_the_true_models_parameters_by_least_squares(recipe):
    """Over all 50 seeds the ratios are 0.98 and 0.99; for a single seed either can be better."""
    bench, found = Bench.from_recipe(recipe), {"paper": [], "default": []}
    with no_type_checker():
        for seed in range(8):
            measurements = recipe.measure(recipe.draw_touches(seed), seed)
            for free, figures in found.items():
                accuracy = measure_accuracy(bench, calibrate_on(recipe, measurements, recipe.frames, free))
                figures.append(
                    [float(accuracy.points.norm(dim=-1).mean()), float(accuracy.workspace.median())]
                )
    points, workspace = np.mean(found["default"], axis=0) / np.mean(found["paper"], axis=0)
    assert points <= 1.0
    assert workspace <= 1.0


def test_one_jig_alone_is_refused(recipe):
    with refused(RecipeError, option="placements", value=1):
        run_jigs(recipe.model_copy(update={"placements": recipe.placements[:1]}))


def test_the_command_reports_the_papers_tables(trained):
    _, report = trained
    assert {name: report["parameters_estimated"][name] for name in ("jig_1", "jig_2", "both")} == {
        "jig_1": 17,
        "jig_2": 17,
        "both": 23,
    }
    assert len(report["parameters"]) == 23
    true = {row["name"]: row["true"] for row in report["parameters"]}
    assert_close(true["d_4"], 392.8, atol=1e-9)
    nominal, both = (report["accuracy"][name]["robot_frame"]["rms_mm"] for name in ("nominal", "both"))
    assert both < nominal
    assert report["planning"]["touches"] == sum(
        count for axes in report["planning"]["per_jig"].values() for count in axes.values()
    )
    assert report["seeds"]["count"] == 2
    tables = all_tables(report)
    assert len(tables) == 5
    for table in tables:
        assert table.rows
        assert all(len(row) == len(table.columns) for row in table.rows)


def test_the_model_has_a_card_with_its_pictures(trained):
    folder, report = trained
    card = (folder / "README.md").read_text(encoding="utf-8")
    for picture in PICTURES:
        assert (folder / picture).stat().st_size > 10_000
        assert f"]({picture})" in card
    for sentence in report["definitions"]:
        assert sentence in card


def test_the_model_has_both_jigs_and_reaches_their_test_points(trained, recipe):
    solve, true_robot = pisigma.load(trained[0]), recipe.true_robot()
    assert sorted(solve.model.bases) == ["jig_1", "jig_2"]
    bases = {p.name: p.true_T_jig_base for p in recipe.placements}
    T_jig_base = bases["jig_1"]
    wanted = torch.stack([T_jig_base @ point.T_base_tool for point in recipe.test_points])
    with no_type_checker():
        reached = T_jig_base @ true_robot.forward(torch.as_tensor(solve(wanted).q))
    assert float((reached - wanted)[:, :3, 3].norm(dim=-1).max()) < 2e-3
