"""Measurements: data sets, CSV files, splits into training and held-out rows, sensors, cameras and jigs.

Names are loaded on first use, so that settings of cameras can be read without importing torch; `__init__.pyi`
declares them for type checkers.
"""

from pisigma.files.lazy_names import lazy_getattr

__getattr__ = lazy_getattr(
    __name__,
    {
        "dataset": "Measurements join",
        "fields": "Kind UnusableRow",
        "groups": "groups_of_equal_joints groups_to_keep_whole placements",
        "jig": "Jig",
        "splits": "holdout k_folds",
    },
)
