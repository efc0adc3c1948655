"""Small recipes for the training tests."""

from collections.abc import Callable
from pathlib import Path

import pytest

from pisigma.training.recipe import Recipe, read_recipe


@pytest.fixture
def write_recipe(repository: Path, tmp_path: Path) -> Callable[..., Path]:
    """Write a shipped recipe with replacements into a temporary folder and give its path."""

    def write(name: str, *replacements: tuple[str, str]) -> Path:
        text = (repository / "training" / f"{name}.yaml").read_text()
        for old, new in replacements:
            assert old in text, old
            text = text.replace(old, new)
        path = tmp_path / f"{name}.yaml"
        path.write_text(text)
        return path

    return write


@pytest.fixture
def small_recipe(write_recipe: Callable[..., Path]) -> Callable[..., Recipe]:
    """A shipped recipe with replacements, read."""
    return lambda name, *replacements: read_recipe(write_recipe(name, *replacements))
