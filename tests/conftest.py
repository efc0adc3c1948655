"""Fixtures for all tests, and the folders of test support and of the papers on the import path."""

import gc
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

# One thread: the tests' arrays are small, and threads that wait for each other on a busy machine cost minutes.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Processes that tests start share their bytecode, whatever this one was told: else each compiles all of pisigma.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# A defect shows where it is, instead of one line for users.
os.environ.setdefault("PISIGMA_TRACEBACK", "1")

import pytest
import torch

if TYPE_CHECKING:
    import playwright.sync_api

sys.path.insert(0, str(Path(__file__).parent))
sys.path.append(str(Path(__file__).parent.parent / "training" / "papers"))

import testing.bytecode
import testing.type_checker  # noqa: F401  its place is before pisigma's, which it shall check
from testing.models import no_type_checker
from testing.pictures import no_pictures
from testing.stored import FOLDER

from pisigma.workflow.recipes.reader import read_recipe
from pisigma.workflow.recipes.recipe import InverseRecipe

REPOSITORY = Path(__file__).parent.parent

CHROMIUM = (
    "--headless --no-sandbox --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader"
)
"""Options of a browser that fetches nothing by itself and draws in three dimensions without a graphics card."""


def pytest_configure(config: pytest.Config) -> None:
    """Do not look for garbage while tests are collected, which takes a fifth of that time; see `testing.stored`."""
    gc.disable()
    if getattr(config.option, "numprocesses", None):  # not in the workers, which inherit the folder
        folder = tempfile.TemporaryDirectory(prefix="pisigma-tests-")
        config.add_cleanup(folder.cleanup)
        os.environ[FOLDER] = folder.name


def pytest_collection_finish() -> None:
    """Leave torch and the tests out of garbage collections, which take some per cent of the time."""
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
    gc.enable()


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the checkout."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of measured robots, which are not part of the project."""
    folder = Path(os.environ.get("PISIGMA_DATA", REPOSITORY / ".." / "shared" / "data")).resolve()
    if not folder.is_dir():
        pytest.skip(f"measured data not found in {folder}; set PISIGMA_DATA to its folder")
    return folder


@pytest.fixture(scope="module")
def browser() -> Iterator["playwright.sync_api.Browser"]:
    """Headless Chromium."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("no chromium on the path")
    with sync_api.sync_playwright() as running:
        started = running.chromium.launch(executable_path=path, args=CHROMIUM.split())
        yield started
        started.close()


@pytest.fixture
def generator() -> torch.Generator:
    """A seeded source of randomness."""
    return torch.Generator().manual_seed(0)


@pytest.fixture
def without_type_checker() -> Iterator[None]:
    """Call pisigma as users do, whom no type checker stops before our own complaints."""
    with no_type_checker():
        yield


@pytest.fixture(scope="module")
def blank_pictures() -> Iterator[None]:
    """Write blank figures where they are not what is tested."""
    with no_pictures():
        yield


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
def small_recipe(write_recipe: Callable[..., Path]) -> Callable[..., InverseRecipe]:
    """A shipped recipe with replacements, read."""
    return lambda name, *replacements: read_recipe(write_recipe(name, *replacements))
