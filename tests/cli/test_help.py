"""Short help of every command, and help that shows every option."""

import json
import subprocess
import sys

import pytest
from typer.main import get_command

from pisigma.cli.help import RARELY_USED
from pisigma.cli.main import app

MAX_LINES, MAX_OPTIONS = 50, 20
APP = get_command(app)
COMMANDS = {
    **{name: one for name, one in APP.commands.items() if not hasattr(one, "commands")},
    **{f"fleet {name}": one for name, one in APP.commands["fleet"].commands.items()},
}


@pytest.fixture
def help_of(run, monkeypatch):
    """Give what prints the help of a command at 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")

    def text(name: str, option: str) -> str:
        result = run(*name.split(), option)
        assert result.exit_code == 0, result.output
        return result.stdout

    return text


def options_of(name: str) -> list[str]:
    return [one.opts[0] for one in COMMANDS[name].params if one.param_type_name == "option"]


@pytest.mark.parametrize("name", COMMANDS)
def test_short_help_fits_a_screen_and_points_to_the_whole(help_of, name):
    text = help_of(name, "--help")
    assert len(text.splitlines()) <= MAX_LINES
    count = len(options_of(name)) + 1  # with --help itself
    last = text.strip().splitlines()[-1]
    assert "--help-all" in last
    assert str(count) in last.split()


@pytest.mark.parametrize("name", COMMANDS)
def test_whole_help_lists_every_option_and_every_key(help_of, name):
    lines = help_of(name, "--help-all").splitlines()
    listed = [word.strip(",") for line in lines if line.startswith("  -") for word in line.split()]
    assert set(options_of(name)) | {"--help"} <= set(listed)
    assert set(COMMANDS[name].keys) <= {line.split("=")[0].strip() for line in lines if "=" in line}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_has_at_most_20_options_and_short_help_shows_them(help_of, name):
    assert len(options_of(name)) + 1 <= MAX_OPTIONS  # with --help itself
    lines = help_of(name, "--help").splitlines()
    shown = {word.strip(",") for line in lines if line.startswith("  -") for word in line.split()[:4]}
    hidden = set(RARELY_USED.get(name, ()))
    assert hidden <= set(options_of(name))
    assert hidden.isdisjoint(shown)
    assert set(options_of(name)) - hidden <= shown


@pytest.mark.parametrize(
    ("option", "spelling"),
    [
        ("--seed", "--set seed=VALUE"),
        ("--prior-mm", "--set prior_mm=VALUE"),
        ("--no-robust", "--set robust=false"),
    ],
)
def test_an_option_that_is_a_key_is_answered_with_its_key(run, option, spelling):
    result = run("calibrate", "ur5", "rows.csv", "--json", option, "1")
    assert result.exit_code == 2
    fields = json.loads(result.stdout)["error"]
    assert fields["option"] == option
    assert spelling in fields["message"]


def test_help_imports_nothing_heavy():
    heavy = "{'torch', 'numpy', 'scipy', 'rich', 'jinja2'}"
    code = f"import sys, pisigma.cli.main; print({heavy} & set(sys.modules) or 'none')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "none"


def test_a_key_at_fault_is_json_too(run):
    result = run("calibrate", "ur5", "rows.csv", "--out", "m", "--set", "seed=x", "--json")
    assert result.exit_code == 2
    fields = json.loads(result.stdout)["error"]
    assert fields["class"] == "SettingError"
    assert (fields["option"], fields["value"], fields["expected"]) == ("seed", "x", "an integer")


@pytest.mark.parametrize(
    ("words", "error", "option"),
    [
        (("calibrate", "--json", "--fold", "2"), "NoSuchOption", "--fold"),
        (("plan", "ur5", "--json", "--count", "many"), "BadParameter", "--count"),
        (("ik", "model", "--json"), "BadParameter", None),
    ],
)
def test_usage_errors_are_json_too(run, words, error, option):
    result = run(*words)
    assert result.exit_code == 2
    fields = json.loads(result.stdout)["error"]
    assert fields["class"] == error
    assert fields.get("option") == option
    assert run(*(word for word in words if word != "--json")).stdout == ""
