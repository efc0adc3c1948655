"""Fixtures for commands: run them in this process, and models to run them on."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from testing.hybrid import few_choices, few_robots
from testing.models import hand_made_model, no_type_checker, small_recipe_text
from testing.refusals import assert_fields, problem_of
from typer.main import get_command

from pisigma.cli import progress
from pisigma.cli.main import app
from pisigma.files.errors import PisigmaError
from pisigma.model.folder.model_folder import save_model

Run = Callable[..., Result]
COMMAND = get_command(app)
"""Made once, which takes as long as many a command."""


def _run(*arguments: object) -> Result:
    with no_type_checker():
        result = CliRunner().invoke(COMMAND, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


@pytest.fixture(scope="module", autouse=True)
def quick(blank_pictures: None) -> Iterator[None]:
    """Commands write blank figures and try few features; figures of `trained`, made before, are drawn."""
    with few_choices(), few_robots():
        yield


@pytest.fixture(scope="session", autouse=True)
def without_progress() -> Iterator[None]:
    """Say nothing of progress, however slow the machine is."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(progress, "QUIET_S", 1e9)
        yield


@pytest.fixture(scope="session")
def run() -> Run:
    """Run a command in this process and return its exit code, stdout and stderr."""
    return _run


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], Result]:
    """A folder with kiro3.yaml and model/, as `pisigma train --json` made it, and what that printed."""
    folder = tmp_path_factory.mktemp("trained")
    (folder / "kiro3.yaml").write_text(small_recipe_text("kiro3"))
    result = _run("train", folder / "kiro3.yaml", "--out", folder / "model", "--json")
    assert result.exit_code == 0, result.output
    return folder, json.loads(result.stdout), result


@pytest.fixture(scope="session")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the hand-made models kiro3, kiro4 and ur10."""
    folder = tmp_path_factory.mktemp("models")
    for name in ("kiro3", "kiro4", "ur10"):
        (folder / name).mkdir()
        save_model(hand_made_model(name), folder / name)
    return folder


@pytest.fixture
def refuses(run: Run) -> Callable[..., str]:
    """Run a command that must end with status 2 and one line on stderr, and return that line.

    `error` and fields are those of `testing.refusals.refused`.
    """

    def check(
        *arguments: object, stdout: str | None = "", error: type[PisigmaError] | None = None, **fields: object
    ) -> str:
        result = run(*arguments)
        assert result.exit_code == 2, result.output
        assert stdout is None or result.stdout == stdout
        lines = result.stderr.strip().splitlines()
        assert len(lines) == 1, result.stderr
        assert lines[0].startswith("pisigma: ")
        assert "Traceback" not in result.stderr
        if error is not None or fields:
            problem = problem_of(result)
            assert isinstance(problem, error or PisigmaError), repr(problem)
            assert_fields(problem, **fields)
        return lines[0].removeprefix("pisigma: ")

    return check
