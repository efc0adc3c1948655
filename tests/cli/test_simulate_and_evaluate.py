"""`pisigma simulate` writes measurements, `pisigma evaluate` judges a model on them."""

import json
from dataclasses import replace

import pytest
import torch
from testing.closeness import assert_close
from testing.models import hand_made_model
from testing.screens import assert_screen

from pisigma.files.errors import MeasurementError, ModelError, OutputError, RecipeError
from pisigma.measurement.dataset import Measurements
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.robot import Robot
from pisigma.validation.held_out.pose_statistics import compare_with_nominal


@pytest.fixture(scope="module")
def held_out(run, trained, tmp_path_factory):
    """The held-out rows of the trained recipe, as a file."""
    path = tmp_path_factory.mktemp("data") / "held_out.csv"
    result = run("simulate", trained[0] / "kiro3.yaml", "--out", path, "--held-out", "--json")
    assert result.exit_code == 0
    printed = json.loads(result.stdout)
    assert printed["file"] == str(path)
    assert printed["rows"] == 200
    return path


def test_simulated_rows_are_those_of_the_training(run, trained, tmp_path):
    path = tmp_path / "training.csv"
    assert (
        run("simulate", trained[0] / "kiro3.yaml", "--out", path).stdout
        == f"100 measurements written to {path}.\n"
    )
    rows = Measurements.read_csv(path, Robot.load("kiro3"))
    assert rows.rows == load_model(trained[0] / "model").provenance.rows == 100


def test_rows_at_other_joint_values_have_other_noise(run, refuses, repository, tmp_path):
    recipe, robot = repository / "training" / "rb5_hybrid.yaml", Robot.load("rb5")
    for name, of in (("first", ()), ("again", ("--at", tmp_path / "first.csv"))):
        assert run("simulate", recipe, *of, "--out", tmp_path / f"{name}.csv").exit_code == 0
    first, again = (Measurements.read_csv(tmp_path / f"{name}.csv", robot) for name in ("first", "again"))
    assert_close(again.q, first.q, atol=1e-12)
    assert 1e-5 < float((again.position - first.position).abs().mean()) < 1e-4
    refuses(
        "simulate",
        recipe,
        "--at",
        tmp_path / "first.csv",
        "--held-out",
        "--out",
        tmp_path / "x.csv",
        error=RecipeError,
    )


def test_poses_before_and_after(run, trained, held_out):
    result = run("evaluate", trained[0] / "model", held_out, "--json")
    assert result.exit_code == 0
    printed = json.loads(result.stdout)
    assert (printed["rows"], printed["rows_not_predicted"], printed["trained_on"]) == (200, 0, False)
    assert printed["nominal"]["rms_mm"] > 10
    for name in ("rms_mm", "mean_mm", "p95_mm", "max_mm", "rms_deg", "max_deg"):
        assert printed["corrected"][name] < printed["nominal"][name] / 10
    model = load_model(trained[0] / "model")
    by_hand = compare_with_nominal(model, Measurements.read_csv(held_out, model.robot))
    for kind in ("nominal", "corrected"):
        assert printed[kind] == pytest.approx(getattr(by_hand, kind).figures.figures_by_name, rel=1e-12)


def without(path, target, *columns):
    """A copy of a file without some columns."""
    lines = [line.split(",") for line in path.read_text().splitlines()]
    kept = [index for index, name in enumerate(lines[0]) if name not in columns]
    target.write_text("\n".join(",".join(line[index] for index in kept) for line in lines) + "\n")
    return target


def with_column(path, target, name, values):
    """A copy of a file with one more column."""
    lines = path.read_text().splitlines()
    cells = [name, *(values[index % len(values)] for index in range(len(lines) - 1))]
    target.write_text("\n".join(f"{line},{cell}" for line, cell in zip(lines, cells, strict=True)) + "\n")
    return target


def test_positions_alone(run, trained, held_out, tmp_path):
    positions = without(held_out, tmp_path / "positions.csv", "qx", "qy", "qz", "qw")
    printed = json.loads(run("evaluate", trained[0] / "model", positions, "--json").stdout)
    whole = json.loads(run("evaluate", trained[0] / "model", held_out, "--json").stdout)
    assert set(printed["corrected"]) == {"rms_mm", "mean_mm", "p95_mm", "max_mm"}
    for name, value in printed["corrected"].items():
        assert_close(value, whole["corrected"][name], rtol=1e-9)
    table = run("evaluate", trained[0] / "model", positions).stdout
    assert "position, RMS" in table
    assert "orientation" not in table
    assert_screen(table)


def test_rows_of_the_set_train_are_not_judged(run, trained, held_out, tmp_path, refuses):
    mixed = with_column(held_out, tmp_path / "mixed.csv", "set", ["train", "test", "test", "test"])
    printed = json.loads(run("evaluate", trained[0] / "model", mixed, "--json").stdout)
    assert printed["rows"] == 150
    everything = with_column(held_out, tmp_path / "train.csv", "set", ["train"])
    refuses(
        "evaluate",
        trained[0] / "model",
        everything,
        error=MeasurementError,
        file="train.csv",
        column="set",
        value="train",
    )


def test_training_rows_are_recognised(run, trained, tmp_path):
    path = tmp_path / "training.csv"
    run("simulate", trained[0] / "kiro3.yaml", "--out", path)
    model = load_model(trained[0] / "model")
    if Measurements.read_csv(path, model.robot).content_hash() == model.provenance.data_sha256:
        assert json.loads(run("evaluate", trained[0] / "model", path, "--json").stdout)["trained_on"] is True


@pytest.mark.parametrize("name", ["frame", "target"])
def test_several_frames_or_targets_are_refused(refuses, trained, held_out, tmp_path, name):
    path = with_column(held_out, tmp_path / "mixed.csv", name, ["a", "b"])
    message = refuses("evaluate", trained[0] / "model", path, error=MeasurementError)
    assert all(word in message for word in ("line 3", name, "'a'", "'b'"))


def test_joints_of_another_robot_are_refused(refuses, models, trained, held_out):
    refuses(
        "evaluate",
        models / "kiro4",
        held_out,
        error=MeasurementError,
        file="held_out.csv",
        line=1,
        column="q4_deg",
        value=4,
    )
    refuses("evaluate", trained[0] / "no", held_out, error=ModelError)
    refuses(
        "evaluate", trained[0] / "model", held_out.parent / "no.csv", error=MeasurementError, file="no.csv"
    )


def test_rows_with_joint_values_only_are_refused(refuses, trained, held_out, tmp_path):
    joints = without(held_out, tmp_path / "joints.csv", "qx", "qy", "qz", "qw", "x_mm", "y_mm", "z_mm")
    refuses(
        "evaluate",
        trained[0] / "model",
        joints,
        error=MeasurementError,
        file="joints.csv",
        line=1,
        column="x_mm",
    )


def test_simulating_what_is_measured_is_refused(refuses, repository, trained, tmp_path):
    text = (trained[0] / "kiro3.yaml").read_text()
    start, end = text.index("data:\n"), text.index("singular_rows:")
    (tmp_path / "measured.yaml").write_text(f"{text[:start]}data: {{kind: measured}}\n{text[end:]}")
    for option in ([], ["--held-out"]):
        refuses(
            "simulate",
            tmp_path / "measured.yaml",
            "--out",
            tmp_path / "data.csv",
            *option,
            error=RecipeError,
            value="kiro3",
        )
    assert not (tmp_path / "data.csv").exists()


def test_an_out_that_cannot_be_written(refuses, trained, tmp_path):
    for out in (tmp_path, tmp_path / "nothing" / "data.csv"):
        refuses("simulate", trained[0] / "kiro3.yaml", "--out", out, error=OutputError, file=out)


def test_rows_that_the_model_does_not_predict_are_left_out_of_both(run, held_out, tmp_path):
    """A correction steeper than the joints gives no prediction; nominal figures leave such rows out too."""
    model = hand_made_model("kiro3")
    model.network.networks[0].output_scale.fill_(3.0)
    save_model(replace(model, name="steep"), tmp_path)
    printed = json.loads(run("evaluate", tmp_path, held_out, "--json").stdout)
    lost = printed["rows_not_predicted"]
    assert 0 < lost < 200
    rows = Measurements.read_csv(held_out, model.robot)
    predicted = torch.isfinite(model.forward(rows.q)).flatten(1).all(-1)
    assert int((~predicted).sum()) == lost
    kept = compare_with_nominal(
        replace(model, network=None), rows.select(predicted)
    ).nominal.figures.figures_by_name
    assert printed["nominal"] == pytest.approx(kept, rel=1e-9)
    assert f"Warning: {lost} rows" in run("evaluate", tmp_path, held_out).stdout
