"""`pisigma train`: from a recipe to a model folder, a report for people and one for programs."""

import json

import pytest
from testing.models import small_recipe_text
from testing.screens import assert_screen

from pisigma.files.errors import MeasurementError, OutputError, PisigmaError, RecipeError, UnknownRobotError
from pisigma.model.folder.model_folder import load_model

STATISTICS = {"average_deg", "deviation_deg", "maximum_deg"}


def test_json_has_the_agreed_shape(trained):
    folder, printed, result = trained
    assert printed["model"] == str(folder / "model")
    assert printed["seconds"] > 0
    assert [joint["name"] for joint in printed["joints"]] == ["theta_1", "theta_2"]
    for joint in printed["joints"]:
        assert set(joint) == {"name", "training", "held_out", "paper"}
        for part in ("training", "held_out", "paper"):
            assert set(joint[part]) == {"before", "after"}
            for figures in joint[part].values():
                assert set(figures) == STATISTICS
    assert result.stdout.count("\n") == 1


def test_the_folder_is_whole(trained):
    folder, printed, _ = trained
    files = {entry.name for entry in (folder / "model").iterdir()}
    assert files == {
        "README.md",
        "energy.csv",
        "energy.png",
        "errors_over_workspace.png",
        "compiled.npz",
        "model.safetensors",
        "model.yaml",
    }
    model = load_model(folder / "model")
    assert model.metrics["joints"] == printed["joints"]
    assert not list(folder.glob(".*"))


def test_tables_fit_in_80_columns_and_the_next_free_name_is_taken(run, trained, tmp_path, monkeypatch):
    folder, _, _ = trained
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "kiro3").mkdir(parents=True)
    (tmp_path / "runs" / "kiro3" / "mine.txt").write_text("not a model")
    result = run("train", folder / "kiro3.yaml", "--logs", "logs")
    assert result.exit_code == 0
    words = ("theta_1", "theta_2", "training", "held-out", "paper", "average", "maximum", "deg", "100 rows")
    assert_screen(result.stdout, *words, "runs/kiro3-2")
    card = (tmp_path / "runs" / "kiro3-2" / "README.md").read_text()
    assert "Trained on 100 simulated rows, none left out." in card
    assert load_model(tmp_path / "runs" / "kiro3-2").name == "kiro3"
    assert (tmp_path / "logs" / "metrics.csv").read_text().splitlines()[0].count("energy_") == 2
    assert not list((tmp_path / "runs").glob(".*"))


def test_a_model_is_replaced_and_other_folders_are_not(refuses, trained, tmp_path):
    folder, _, _ = trained
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    for name in ("folder", "file"):
        refuses("train", folder / "kiro3.yaml", "--out", tmp_path / name, error=OutputError, file=name)
    refuses("train", folder / "kiro3.yaml", "--out", tmp_path / "file" / "model", error=OutputError)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "folder"]


@pytest.mark.parametrize(
    ("old", "new", "error", "word"),
    [
        ("epochs: 40", "epoch: 40", RecipeError, "'epochs'"),
        ("robot: kiro3", "robot: kiro33", UnknownRobotError, "'kiro3'"),
        ("sin(theta_1)", "sin(theta_7)", RecipeError, "sin(theta_7)"),
        ("epochs: 40", "epochs: many", RecipeError, "many"),
        ("name: kiro3", "name: [", RecipeError, "line"),
    ],
)
def test_recipes_at_fault(refuses, tmp_path, old, new, error, word):
    text = small_recipe_text("kiro3")
    assert old in text
    (tmp_path / "recipe.yaml").write_text(text.replace(old, new, 1))
    assert word in refuses("train", tmp_path / "recipe.yaml", "--out", tmp_path / "model", error=error)
    assert not (tmp_path / "model").exists()


def test_unexpected_and_missing_data_are_refused(refuses, trained, tmp_path):
    folder, _, _ = trained
    unused = ("train", folder / "kiro3.yaml", "--data", "x.csv", "--out", tmp_path / "model")
    refuses(*unused, error=RecipeError, option="--data")
    text = small_recipe_text("kiro3")
    start, end = text.index("data:\n"), text.index("singular_rows:")
    (tmp_path / "measured.yaml").write_text(f"{text[:start]}data: {{kind: measured}}\n{text[end:]}")
    arguments = ("train", tmp_path / "measured.yaml", "--out", tmp_path / "model")
    assert "--data" in refuses(*arguments, error=RecipeError)
    refuses(*arguments, "--data", tmp_path / "no.csv", error=MeasurementError, file="no.csv")
    refuses("train", tmp_path / "no.yaml", "--out", tmp_path / "model", error=RecipeError, file="no.yaml")


def test_resume_without_anything_to_resume(refuses, trained, tmp_path):
    folder, _, _ = trained
    refuses("train", folder / "kiro3.yaml", "--out", tmp_path / "model", "--resume", error=PisigmaError)


def test_printed_figures_are_those_of_the_model(trained):
    folder, printed, _ = trained
    text = (folder / "model" / "README.md").read_text()
    for joint in printed["joints"]:
        assert (
            f"| {joint['name']} | deg | training | {joint['training']['before']['average_deg']:.4f} |" in text
        )
    assert json.dumps(printed, allow_nan=False)
