"""The methods, one file each, with a `METHOD`."""

import importlib
import pkgutil

from shared_benchmark.rows import Method

NAMES = tuple(sorted(item.name for item in pkgutil.iter_modules(__path__) if not item.name.startswith("_")))
"""Names of all methods."""


def method_of(name: str) -> Method:
    """Return a method by its name."""
    method: Method = importlib.import_module(f"shared_benchmark.methods.{name}").METHOD
    return method
