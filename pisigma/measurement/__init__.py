"""Data sets of measurements: their CSV form, their splits into training and test rows; jigs."""

from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.fields import Kind, LeftOut
from pisigma.measurement.groups import groups_of_equal_joints, groups_to_keep_whole, placements
from pisigma.measurement.jig import Jig
from pisigma.measurement.splits import holdout, k_folds

__all__ = [
    "Jig",
    "Kind",
    "LeftOut",
    "Measurements",
    "groups_of_equal_joints",
    "groups_to_keep_whole",
    "holdout",
    "join",
    "k_folds",
    "placements",
]
