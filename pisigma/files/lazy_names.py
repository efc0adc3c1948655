"""Load names of a package on first use (PEP 562), so that its light modules can be imported alone."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_getattr(package: str, names_by_module: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a `__getattr__` function for a package.

    Args:
        package: name of the package.
        names_by_module: exported names, separated by spaces, keyed by the submodule that defines them.
    """

    def getattribute(name: str) -> Any:
        for module, those in names_by_module.items():
            if name in those.split():
                return getattr(import_module(f"{package}.{module}"), name)
        raise AttributeError(f"module '{package}' has no attribute '{name}'")

    return getattribute
