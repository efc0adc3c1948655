"""What the recipes gave, as stored: `training/results/NAME.json`."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pisigma.files.errors import RecipeError

PAPERS = "papers"
RESULTS = "results"
"""Folders within that of the recipes."""

Result = dict[str, Any]


@dataclass(frozen=True)
class StoredResults:
    """Results by the names of their recipes.

    Attributes:
        folder: the folder of the recipes.
        by_name: what the recipes gave.
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
                f"`python {self.folder / PAPERS} run {name}`."
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
