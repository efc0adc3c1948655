"""Data sets of measurements: their CSV form, their splits into training and test rows; jigs.

Names are loaded on first use, so that settings of cameras are read without torch; `__init__.pyi` tells them to type
checkers.
"""

from importlib import import_module
from typing import Any

_NAMES = {
    "dataset": "Measurements join",
    "fields": "Kind LeftOut",
    "groups": "groups_of_equal_joints groups_to_keep_whole placements",
    "jig": "Jig",
    "splits": "holdout k_folds",
}


def __getattr__(name: str) -> Any:
    """Import a name when it is first asked for."""
    for module, names in _NAMES.items():
        if name in names.split():
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
