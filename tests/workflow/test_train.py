"""`pisigma.train`: from recipes of every kind to results, which are written as model folders."""

import json
from dataclasses import replace

import pytest
import torch
from testing.models import no_type_checker, shipped_training, small_recipe_text, trained_run
from testing.refusals import refused

import pisigma
from pisigma.files.errors import MeasurementError, RecipeError
from pisigma.validation.held_out.pose_statistics import compare_with_nominal
from pisigma.validation.held_out.training_summary import ComparisonFigures, summarise_training
from pisigma.workflow.recipes.data import load_data, simulate
from pisigma.workflow.recipes.reader import recipe_hash
from pisigma.workflow.recipes.recipe import MeasuredData, SingularRows
from pisigma.workflow.settings.training import TrainSettings
from pisigma.workflow.train import InverseTraining, cross_validate, train_networks


def test_a_recipe_of_inverse_calibration_in_two_lines(tmp_path):
    path = tmp_path / "kiro3.yaml"
    path.write_text(small_recipe_text("kiro3"))
    with no_type_checker():
        training = pisigma.train(path)
        model = training.save(tmp_path / "arm")
    assert isinstance(training, InverseTraining)
    assert (training.validation, training.test, training.warnings) == (None, None, ())
    assert (training.model.name, model.name) == ("kiro3", "arm")
    assert model.provenance.recipe_sha256 == recipe_hash(path)
    printed = json.loads(json.dumps(training.to_json(), allow_nan=False))
    assert printed.pop("seconds") > 0
    assert printed | {"command": "pisigma.train('kiro3')"} == model.metrics
    T = model.forward(model.starts[:3].double())
    assert bool(torch.isfinite(pisigma.load(tmp_path / "arm")(T).q).all())


def test_a_recipe_of_geometric_calibration(tmp_path):
    calibration = shipped_training("rb5_redundancy")
    assert isinstance(calibration, pisigma.Calibration)
    assert calibration.summary.pairwise_parameters == 28
    assert calibration.summary.held_out.geometric.rms_mm < 1e-9
    assert calibration.model.provenance.recipe == "rb5_redundancy"
    assert calibration.to_json()["redundant_sets"][0] == ["a_6", "a_EE"]
    with no_type_checker():
        assert calibration.save(tmp_path / "rb5").name == "rb5"


@pytest.mark.parametrize(
    ("recipe", "settings", "data", "option"),
    [
        ("rb5_redundancy", TrainSettings(resume=True), None, "--resume"),
        ("rb5_redundancy", TrainSettings(), "x.csv", "--data"),
        ("rb5_hybrid", TrainSettings(resume=True), None, "--resume"),
    ],
)
def test_options_that_a_recipe_does_not_use_are_refused(repository, recipe, settings, data, option):
    with refused(RecipeError, option=option):
        pisigma.train(repository / "training" / f"{recipe}.yaml", data, settings)


def test_rows_that_are_left_out_are_a_warning():
    recipe, run = trained_run("kiro4")
    singular = SingularRows(rule="leave_out", below=0.06)
    data, fit = MeasuredData(kind="measured", folds=5, seed=0), recipe.fit.model_copy(update={"epochs": 8})
    measured = recipe.model_copy(update={"data": data, "singular_rows": singular, "fit": fit})
    with no_type_checker():
        training = pisigma.train(measured, run.measurements)
    assert training.validation.folds == 5
    assert training.summary.verdict == training.validation.verdict
    left_out = training.summary.rows.left_out
    assert 0 < left_out < 50
    (warning,) = training.warnings
    assert str(left_out) in warning


def test_no_jobs_are_refused():
    with refused(RecipeError, option="jobs", value=0):
        TrainSettings(jobs=0)


def test_rows_of_two_frames_are_refused():
    recipe, run = trained_run("kiro3")
    measured = recipe.model_copy(update={"data": MeasuredData(kind="measured")})
    rows = replace(run.measurements, frame=("left",) * 50 + ("right",) * 50)
    with refused(MeasurementError, option="frame", value="right"):
        train_networks(measured, load_data(measured, rows))


def test_the_correction_improves_held_out_rows():
    recipe, run = trained_run("kiro4")
    measured = recipe.model_copy(update={"data": MeasuredData(kind="measured", folds=3, seed=1)})
    steps: list[str] = []
    with no_type_checker():
        result = cross_validate(measured, load_data(measured, run.measurements), steps.append)
    assert steps == [f"cross-validation: fold {fold} of 3" for fold in (1, 2, 3)]
    assert (result.folds, result.rows_not_predicted) == (3, 0)
    assert result.corrected.rms_mm < result.nominal.rms_mm / 3
    assert result.nominal.rms_deg > 0


def test_a_simulated_recipe_has_held_out_rows_of_its_own():
    recipe, _ = trained_run("kiro3")
    with refused(RecipeError, value=recipe.name):
        cross_validate(recipe, simulate(recipe))


def test_rows_of_the_test_set_do_not_change_the_model():
    recipe, run = trained_run("kiro3")
    data, fit = MeasuredData(kind="measured", folds=2, seed=0), recipe.fit.model_copy(update={"epochs": 8})
    measured = recipe.model_copy(update={"data": data, "fit": fit})
    everything = run.measurements
    split = tuple("test" if row % 4 == 0 else "train" for row in range(everything.rows))
    position = everything.position.clone()
    position[::4] += 0.5
    marked = replace(everything, split=split)
    training, test = marked.split_sets()
    with no_type_checker():
        models = [
            train_networks(measured, load_data(measured, data)).model
            for data in (marked, replace(marked, position=position), training)
        ]
        run = train_networks(measured, load_data(measured, marked))
        summary = summarise_training(
            run,
            {},
            None,
            ComparisonFigures.from_comparison(compare_with_nominal(run.model, test), rows=test.rows),
        )
    states = [model.network.state_dict() for model in models]
    for name, values in states[0].items():
        assert all(torch.equal(values, other[name]) for other in states[1:])
    assert len({model.provenance.data_sha256 for model in models}) == 1
    assert (summary.rows.kept_aside, summary.test.rows) == (25, 25)
    assert summary.rows.used + summary.rows.left_out == 75
    assert summary.test.corrected.rms_mm < summary.test.nominal.rms_mm
