"""Load plug-ins: modules outside the package that register sensors, features, exports, error sources or closed forms.

A plug-in is a program that runs with the user's permissions. Therefore only installed packages (entry points of the
group `pisigma.plugins`) and the command line (`--plugin FILE`) can name one, never a model, a recipe, a manifest or a
cell, which may come from someone else.
"""

import contextlib
import hashlib
import os
import sys
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

from pisigma.files.errors import Place, PluginError

_ENTRY_POINTS = "pisigma.plugins"
"""Entry point group of plug-in packages."""


@dataclass(frozen=True)
class Plugins:
    """The plug-ins that a process has loaded and that its workers also load.

    Attributes:
        files: absolute paths in the order of loading.
        includes_installed: whether the entry points of installed packages were loaded.
    """

    files: tuple[str, ...] = ()
    includes_installed: bool = False

    def load(self) -> None:
        """Load the plug-ins that this process has not loaded yet.

        Raises:
            PluginError: a file or an entry point cannot be loaded.
        """
        if self.includes_installed:
            load_installed()
        load_files(self.files)


_loaded = Plugins()


def loaded_plugins() -> Plugins:
    """Return the plug-ins that this process has loaded."""
    return _loaded


def load_installed() -> None:
    """Import the plug-in modules that installed packages declare as entry points, once per process.

    Raises:
        PluginError: a module cannot be imported.
    """
    global _loaded
    if _loaded.includes_installed:
        return
    from importlib.metadata import entry_points  # imported here, because it takes 0.1 s

    for point in entry_points(group=_ENTRY_POINTS):
        origin = f"plug-in '{point.name}'" + (f" of {point.dist.name}" if point.dist else "")
        with _as_plugin(origin, "repair or uninstall the package"):
            point.load()
    _loaded = Plugins(_loaded.files, True)


def load_files(files: Iterable[str | os.PathLike[str]]) -> None:
    """Run Python files as modules, each once per process.

    Raises:
        PluginError: a file is missing, is not a Python file, or cannot be run.
    """
    global _loaded
    for file in files:
        path = Path(file).resolve()
        if str(path) in _loaded.files:
            continue
        if path.suffix != ".py" or not path.is_file():
            raise PluginError(
                expected="a Python file (.py)", value=str(file), option="--plugin", remedy="check the path"
            )
        with _as_plugin("the plug-in", "correct the file", file):
            _run(path)
        _loaded = Plugins((*_loaded.files, str(path)), _loaded.includes_installed)


def _run(path: Path) -> None:
    """Run a file as a module with a unique name, under which other processes unpickle its objects."""
    name = f"pisigma_plugin_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    spec = spec_from_file_location(name, path, loader=SourceFileLoader(name, str(path)))
    assert spec is not None
    assert spec.loader is not None
    # registered before it runs, because dataclasses look up their module
    sys.modules[name] = module_from_spec(spec)
    try:
        spec.loader.exec_module(sys.modules[name])
    except BaseException:
        del sys.modules[name]
        raise


@contextlib.contextmanager
def _as_plugin(origin: str, remedy: str, file: str | os.PathLike[str] | None = None) -> Iterator[None]:
    """Raise any exception as a `PluginError`, and redirect the plug-in's output to stderr: stdout is for results."""
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    except (Exception, SystemExit) as problem:  # SystemExit would end the command as if it had succeeded
        frames = traceback.extract_tb(problem.__traceback__)
        line = f", line {frames[-1].lineno} of {Path(frames[-1].filename).name}" if frames else ""
        raise PluginError(
            f"{origin} cannot be loaded: {type(problem).__name__}: {problem}{line}",
            value=type(problem).__name__,
            at=None if file is None else Place(file),
            remedy=remedy,
        ) from problem
