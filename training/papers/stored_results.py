"""What the recipes gave, as stored: `training/results/NAME.json`, printed by `pisigma train NAME --json`."""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pisigma.errors import RecipeError
from pisigma.export.output_file import write_whole

RESULTS = "results"

Result = dict[str, Any]

_COMMAND = "from pisigma.cli.main import run; run()"


@dataclass(frozen=True)
class StoredResults:
    """Results by the names of their recipes.

    Attributes:
        folder: the folder of the recipes.
        by_name: what `pisigma train` printed.
    """

    folder: Path
    by_name: dict[str, Result]

    def __getitem__(self, name: str) -> Result:
        """The result of a recipe.

        Raises:
            RecipeError: there is none.
        """
        if name not in self.by_name:
            raise RecipeError(
                f"{self.folder / RESULTS / name}.json: there is no such result; make it with "
                f"`python -m pisigma.studies.papers {self.folder} --run {name}`."
            )
        return self.by_name[name]


def read_results(folder: Path) -> StoredResults:
    """Read all stored results.

    Args:
        folder: the folder of the recipes.

    Raises:
        RecipeError: a file is no JSON object.
    """
    found = {}
    for path in sorted((folder / RESULTS).glob("*.json")):
        try:
            found[path.stem] = _object(path.read_text(encoding="utf-8"))
        except ValueError as problem:
            raise RecipeError(f"{path}: one JSON object was wanted ({problem}); make it again.") from None
    return StoredResults(folder, found)


def run_recipe(folder: Path, name: str, data: Path | None) -> None:
    """Run `pisigma train` on a recipe and store what it prints, one value a line.

    Args:
        folder: the folder of the recipes.
        name: the recipe.
        data: measured data, where it asks for them.

    Raises:
        RecipeError: the command failed; it has said why on stderr.
    """
    command = [sys.executable, "-c", _COMMAND, "train", str(folder / f"{name}.yaml"), "--json"]
    command += ["--data", str(data)] if data else []
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise RecipeError(f"{folder / name}.yaml: `pisigma train` ended with status {done.returncode}.")
    (folder / RESULTS).mkdir(exist_ok=True)
    write_whole(folder / RESULTS / f"{name}.json", result_text(_object(done.stdout)))


def result_text(result: Result) -> str:
    """A result as it is stored: lists of plain values on one line, everything else on lines of its own."""
    return _text(result, "") + "\n"


def _text(value: Any, indent: str) -> str:
    inner = indent + " "
    if isinstance(value, dict) and value:
        lines = [f"{inner}{json.dumps(key)}: {_text(item, inner)}" for key, item in value.items()]
        return "{\n" + ",\n".join(lines) + f"\n{indent}}}"
    if isinstance(value, list) and any(isinstance(item, dict | list) for item in value):
        return "[\n" + ",\n".join(f"{inner}{_text(item, inner)}" for item in value) + f"\n{indent}]"
    return json.dumps(value, allow_nan=False)


def _object(text: str) -> Result:
    found = json.loads(text)
    if not isinstance(found, dict):
        raise ValueError("it holds no object")
    return found
