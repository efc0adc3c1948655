"""Stored results of the recipes: `training/results/NAME.json`."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pisigma.files.errors import Place, RecipeError

PAPERS = "papers"
RESULTS = "results"
"""Folders in the folder of the recipes."""

Result = dict[str, Any]


@dataclass(frozen=True)
class StoredResults:
    """Results by the name of their recipe.

    Attributes:
        folder: The folder of the recipes.
        by_name: Results of the recipes.
    """

    folder: Path
    by_name: dict[str, Result]

    def __getitem__(self, name: str) -> Result:
        """Return the result of a recipe.

        Raises:
            RecipeError: There is no result of this recipe.
        """
        if name not in self.by_name:
            raise RecipeError(
                "there is no such result",
                at=Place(self.folder / RESULTS / f"{name}.json"),
                remedy=f"create it with `python {self.folder / PAPERS} run {name}`",
            )
        return self.by_name[name]


def read_results(folder: Path) -> StoredResults:
    """Read all stored results.

    Args:
        folder: The folder of the recipes.

    Raises:
        RecipeError: A file does not contain a JSON object.
    """
    found = {}
    for path in sorted((folder / RESULTS).glob("*.json")):
        try:
            found[path.stem] = _object(path.read_text(encoding="utf-8"))
        except ValueError as problem:
            raise RecipeError(
                expected="one JSON object", value=str(problem), at=Place(path), remedy="create it again"
            ) from None
    return StoredResults(folder, found)


def result_text(result: Result) -> str:
    """Return a result as stored: lists of plain values on one line, everything else on separate lines."""
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
        raise ValueError("something else than an object")
    return found
