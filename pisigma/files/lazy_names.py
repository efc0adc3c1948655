"""Names of a package that are loaded on first use (PEP 562), so that its light modules need no others."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazily(package: str, names: Mapping[str, str]) -> Callable[[str], Any]:
    """Make the `__getattr__` of a package.

    Args:
        package: its name.
        names: that it gives, separated by spaces, by the module of the package that holds them.
    """

    def getattribute(name: str) -> Any:
        for module, those in names.items():
            if name in those.split():
                return getattr(import_module(f"{package}.{module}"), name)
        raise AttributeError(f"module '{package}' has no attribute '{name}'")

    return getattribute
