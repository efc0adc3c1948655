"""README, training/README.md and the pages on results and commands agree with models, recipes and commands."""

import re

import pytest

from pisigma.cli.main import app
from pisigma.model.folder.model_folder import load_model
from pisigma.reporting.tables import number_text


def _results(repository) -> dict[tuple[str, str], list[str]]:
    """Rows of the table of joint errors, by robot and joint."""
    text = (repository / "docs" / "explanation" / "results.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| KIRO-([34]) (theta_\d) \| (.+) \|$", text, flags=re.MULTILINE)
    return {(f"kiro{number}", joint): cells.split(" | ") for number, joint, cells in rows}


@pytest.mark.parametrize(("model", "joints"), [("kiro3", 2), ("kiro4", 6)])
def test_the_results_table_is_that_of_the_models(repository, model, joints):
    reports = load_model(repository / "models" / model).metrics["joints"]
    table = _results(repository)
    assert len(reports) == joints
    for report in reports:
        before, paper, _, fresh = table[model, report["name"]]
        assert before == number_text(report["training"]["before"]["average_deg"])
        assert paper == number_text(report["paper"]["after"]["average_deg"])
        assert fresh == number_text(report["held_out"]["after"]["average_deg"])


def test_training_readme_names_every_recipe(repository):
    text = (repository / "training" / "README.md").read_text(encoding="utf-8")
    for recipe in sorted((repository / "training").glob("*.yaml")):
        assert f"pisigma train training/{recipe.name}" in text


def test_the_table_of_commands_is_complete(repository):
    text = (repository / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
    known = {command.name for command in app.registered_commands} | {
        one.typer_instance.info.name for one in app.registered_groups
    }
    used = set(re.findall(r"^\| `pisigma (\w+)", text, flags=re.MULTILINE))
    assert used == known


def test_both_set_up_commands_are_there_and_short_enough(repository):
    text = (repository / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 120
    for mark in ("main command", "test command"):
        block = text.split(f"<!-- {mark} -->", 1)[1].split("```", 2)[1]
        commands = block.removeprefix("bash\n").strip().splitlines()
        assert len(commands) == 1
        assert commands[0].startswith("python3 -m venv .venv && ")
