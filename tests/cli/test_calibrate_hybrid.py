"""`pisigma calibrate` with the hybrid (the default), and `train` with recipes for hybrids."""

import json
from dataclasses import replace

import pytest
import torch
from testing.closeness import assert_close
from testing.hybrid import hybrid_of
from testing.models import no_type_checker
from testing.screens import assert_screen
from testing.simulated_arm import simulate

import pisigma
from pisigma.cli.screen import print_result
from pisigma.files.errors import IdentificationError, MeasurementError, RecipeError
from pisigma.measurement.dataset import Measurements
from pisigma.model.folder.model_folder import load_model
from pisigma.reporting.calibration_text import calibration_text
from pisigma.reporting.verdict import rounded_text
from pisigma.validation.held_out.calibration_summary import CalibrationSummary

POSITION = {"rms_mm", "mean_mm", "p95_mm", "max_mm"}
FIGURES = {"joint_corrections.png", "predicted_spread.png", "residuals.png", "correlation.png"}
FIGURES |= {"held_out_errors.png"}
TRIAL = {"name", "unknowns", "log_evidence", "left_out", "seconds", "kept"}


def write(path, measurements, split=None):
    with no_type_checker():
        replace(measurements, split=split).write_csv(path, revolute=[True] * measurements.dof)
    return path


@pytest.fixture(scope="module")
def rows():
    with no_type_checker():
        return hybrid_of("rb5", 200).measurements


@pytest.fixture(scope="module")
def data(rows, tmp_path_factory):
    return write(tmp_path_factory.mktemp("data") / "rows.csv", rows)


@pytest.fixture(scope="module")
def calibrated(run, data, tmp_path_factory):
    """The folder of a calibration and what it printed."""
    folder = tmp_path_factory.mktemp("calibrated") / "arm"
    result = run("calibrate", "rb5", data, "--out", folder, "--folds", 3, "--json")
    assert result.exit_code == 0, result.output
    assert result.stdout.count("\n") == 1
    return folder, json.loads(result.stdout)


def test_json_has_the_agreed_shape(calibrated):
    _, printed = calibrated
    validation = printed["cross_validation"]
    assert (validation["folds"], validation["rows"]) == (3, 200)
    assert set(validation["nominal"]) == set(validation["geometric"]) == set(validation["hybrid"]) == POSITION
    assert validation["hybrid"]["rms_mm"] < 0.6 * validation["geometric"]["rms_mm"]
    assert 0.88 <= validation["coverage"] <= 1.0
    hybrid = printed["hybrid"]
    assert [feature["name"] for feature in hybrid["learned"]["features"]][:2] == ["gravity", "series"]
    assert all(set(trial) == TRIAL for trial in hybrid["trials"])
    assert hybrid["trials"][0]["name"] == "geometry"
    assert hybrid["learned"]["orders"] == []
    assert [row["name"] for row in printed["parameters"]][:2] == ["theta_1", "d_1"]


def test_the_card_and_the_figures_are_there(calibrated):
    folder, printed = calibrated
    assert {entry.name for entry in folder.glob("*.png")} == FIGURES
    card = (folder / "README.md").read_text()
    assert card.startswith("# arm\n\nHybrid calibration of robot rb5 (")
    assert "`pisigma calibrate rb5 rows.csv --out arm --folds 3`" in card
    assert "200 rows of" in card
    assert "| error | unit | nominal | geometric | hybrid |" in card
    assert printed["hybrid"]["verdict"] in card
    for trial in printed["hybrid"]["trials"]:
        assert f"| {trial['name']} | {trial['unknowns']} |" in card
    for name in FIGURES:
        assert f"]({name})" in card
    assert "`model.yaml`" in card


def test_the_folder_loads_and_predicts_what_was_measured(run, calibrated, rows, data):
    folder, printed = calibrated
    model = load_model(folder)
    assert model.kind == "hybrid_calibration"
    assert model.metrics["hybrid"]["verdict"] == printed["hybrid"]["verdict"]
    with no_type_checker():
        ik = pisigma.load(folder)
        error = (ik.model.forward(rows.q)[:, :3, 3] - rows.position).norm(dim=-1)
    assert float(error.square().mean().sqrt()) < 1e-3 * printed["cross_validation"]["geometric"]["rms_mm"]


def test_people_read_the_verdict_and_what_was_tried_on_demand(capsys, calibrated):
    folder, printed = calibrated
    summary = CalibrationSummary.read(load_model(folder))
    figures = printed["cross_validation"]
    words = (
        f"{rounded_text(figures['hybrid']['rms_mm'], 200)} mm",
        f"{100 * figures['coverage']:.0f} %",
        "200 rows",
    )
    print_result(calibration_text(summary, folder, 1.0), verbose=False)
    text = capsys.readouterr().out
    assert_screen(text, *words)
    head = next(line for line in text.splitlines() if line.startswith("error "))
    assert head.split() == ["error", "nominal", "geometric", "hybrid"]
    assert "gravity + series 8" not in text
    print_result(calibration_text(summary, folder, 1.0), verbose=True)
    assert_screen(capsys.readouterr().out, *words, "gravity + series 8", verbose=True)


def test_fewer_training_rows(run, refuses, data, tmp_path):
    command = ("calibrate", "rb5", data, "--out")
    few = json.loads(
        run(*command, tmp_path / "50", "--set", "hold_out=0.3", "--set", "train_rows=50", "--json").stdout
    )
    assert few["rows"] == 50
    figures = few["cross_validation"]
    assert figures["rows"] == 60
    assert figures["hybrid"]["rms_mm"] < 1.05 * figures["geometric"]["rms_mm"]
    assert "--set train_rows=50" in (tmp_path / "50" / "README.md").read_text()
    assert "50 rows of" in (tmp_path / "50" / "README.md").read_text()
    for count in (150, 0):
        words = (*command, tmp_path / "arm", "--folds", 3, "--set", f"train_rows={count}")
        refuses(*words, error=MeasurementError, file="rows.csv", value=count)
    assert not (tmp_path / "arm").exists()


def test_the_geometric_model_is_there_still(run, refuses, data, calibrated, tmp_path):
    command = ("calibrate", "rb5", data, "--out", tmp_path / "arm", "--folds", 3, "--json", "--model")
    printed = json.loads(run(*command, "geometric").stdout)
    assert "hybrid" not in printed
    assert set(printed["cross_validation"]) == {"folds", "rows", "nominal", "geometric"}
    ours, theirs = (found["cross_validation"]["geometric"]["rms_mm"] for found in (printed, calibrated[1]))
    assert_close(ours, theirs, rtol=1e-9)
    assert load_model(tmp_path / "arm").kind == "geometric_calibration"
    assert not (tmp_path / "arm" / "joint_corrections.png").exists()
    refuses(
        "calibrate",
        "rb5",
        data,
        "--out",
        tmp_path / "other",
        "--model",
        "hybird",
        error=IdentificationError,
        option="model",
        value="hybird",
    )


def test_nothing_to_learn_is_reported_and_the_geometry_is_kept(run, tmp_path):
    with no_type_checker():
        rows = simulate("kiro4", rows=60, noise=5e-5).measurements
    path = write(tmp_path / "rows.csv", rows)
    result = run("calibrate", "kiro4", path, "--out", tmp_path / "arm", "--folds", 2, "--json")
    printed = json.loads(result.stdout)
    assert printed["hybrid"]["learned"] is None

    found = printed["cross_validation"]
    assert found["hybrid"] == found["geometric"]
    assert not (tmp_path / "arm" / "joint_corrections.png").exists()
    assert printed["hybrid"]["verdict"] in " ".join((tmp_path / "arm" / "README.md").read_text().split())


def test_rows_of_the_test_set_are_judged_with_all_three(run, rows, tmp_path):
    path = write(
        tmp_path / "sets.csv", rows, tuple("test" if k % 4 == 0 else "train" for k in range(rows.rows))
    )
    command = ("calibrate", "rb5", path, "--out", tmp_path / "arm", "--folds", 0, "--json")
    printed = json.loads(run(*command).stdout)
    assert "cross_validation" not in printed
    test = printed["test"]
    assert (printed["rows"], test["rows"]) == (150, 50)
    assert test["hybrid"]["rms_mm"] < 0.6 * test["geometric"]["rms_mm"]
    assert 0.8 <= test["coverage"] <= 1.0
    judged = json.loads(run("evaluate", tmp_path / "arm", path, "--json").stdout)
    assert_close(judged["corrected"]["rms_mm"], test["hybrid"]["rms_mm"], rtol=1e-6)


def test_balls_in_sockets_of_a_real_panda(run, shared_data, tmp_path):
    panda = shared_data / "panda_sockets" / "panda_3.csv"
    command = ("calibrate", "panda", panda, "--out", tmp_path / "arm", "--split", "placement", "--folds", 2)
    result = run(*command, "--set", "socket_distance=*/0,*/1,50", "--json")
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)["cross_validation"]
    assert (figures["folds"], figures["rows"], figures["sockets_held_out"]) == (2, 387, 12)
    assert figures["hybrid"]["rms_mm"] < 0.9 * figures["geometric"]["rms_mm"]
    assert figures["socket_distance"]["hybrid"]["mean_mm"] < 0.1


def test_a_real_ur5(run, shared_data, tmp_path):
    command = ("calibrate", "ur5", shared_data / "ur5" / "grid.csv", "--out", tmp_path / "arm")
    result = run(*command, "--set", "hold_out=0.3", "--set", "train_rows=200", "--json")
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)["cross_validation"]
    assert figures["rows"] == 300
    assert figures["hybrid"]["rms_mm"] < 0.95 * figures["geometric"]["rms_mm"] < 0.12
    assert 0.9 <= figures["coverage"] <= 0.99


@pytest.fixture(scope="module")
def trained_hybrid(run, repository, tmp_path_factory):
    """The folder of a small RB5 recipe and what it printed."""
    folder = tmp_path_factory.mktemp("hybrid")
    text = (repository / "training" / "rb5_hybrid.yaml").read_text()
    for old, new in (
        ("count: 5000", "count: 200"),
        ("repeats: 5", "repeats: 2"),
        ("[30, 50, 75, 100]", "[60]"),
    ):
        assert old in text
        text = text.replace(old, new)
    (folder / "small.yaml").write_text(text + "hybrid: {harmonics: [8], products: false}\n")
    result = run("train", folder / "small.yaml", "--out", folder / "model", "--json")
    assert result.exit_code == 0, result.output
    return folder, json.loads(result.stdout)


def test_a_simulated_recipe_is_judged_on_true_positions_of_every_repeat(trained_hybrid):
    folder, printed = trained_hybrid
    held_out = printed["held_out"]
    assert (held_out["folds"], held_out["rows"]) == (2, 400)
    for name in ("nominal", "geometric", "hybrid"):
        own = held_out["rms_mm_of_simulations"][name]
        assert len(own) == 2
        assert_close(held_out["mean_rms_mm"][name], sum(own) / 2, rtol=1e-9)
    assert held_out["mean_rms_mm"]["hybrid"] < 0.07 < 0.2 < held_out["mean_rms_mm"]["geometric"]
    assert 0.9 <= held_out["coverage"] <= 1.0
    assert printed["seconds"] > printed["fit_seconds"] > 0
    assert [point["rows"] for point in printed["learning_curve"]] == [60, 150]
    assert all(point["held_out"] == 400 for point in printed["learning_curve"])
    card = (folder / "model" / "README.md").read_text()
    assert all(words in card for words in ("400", "2 simulations"))
    assert "## Learning curve" in card
    assert (folder / "model" / "learning_curve.png").exists()
    assert load_model(folder / "model").provenance.recipe == "rb5_hybrid"


def test_simulated_rows_of_a_hybrid_recipe(run, refuses, trained_hybrid, tmp_path):
    recipe = trained_hybrid[0] / "small.yaml"
    for option, count in (((), 150), (("--held-out",), 200)):
        command = ("simulate", recipe, "--out", tmp_path / "rows.csv", "--json", *option)
        assert json.loads(run(*command).stdout)["rows"] == count
    read = Measurements.read_csv(tmp_path / "rows.csv", pisigma.Robot.load("rb5"))
    assert read.kinds == {"position"}
    assert bool(torch.isfinite(read.q).all())
    refuses(
        "train",
        recipe,
        "--out",
        tmp_path / "model",
        "--resume",
        error=RecipeError,
        option="--resume",
        value="hybrid_calibration",
    )


def test_a_measured_recipe_is_cross_validated(run, repository, data, tmp_path):
    text = (repository / "training" / "ur5_hybrid.yaml").read_text().replace("robot: ur5", "robot: rb5")
    text = text.replace("folds: 5", "folds: 2").replace("[30, 50, 100, 300]", "[60]")
    (tmp_path / "measured.yaml").write_text(text + "hybrid: {harmonics: [8], products: false}\n")
    result = run("train", tmp_path / "measured.yaml", "--data", data, "--out", tmp_path / "model")
    assert result.exit_code == 0, result.output
    assert_screen(result.stdout, "2-fold", "200 rows", "learning curve")
    card = (tmp_path / "model" / "README.md").read_text()
    assert "2-fold cross-validation: each of 200 rows" in card
    page = run("report", tmp_path / "model", "--out", tmp_path / "page.html", "--json")
    assert json.loads(page.stdout)["rows"]["origin"] == "held_out"
    assert "--data rows.csv" in card
