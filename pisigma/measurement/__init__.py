"""Data sets of measurements: their CSV form, and parting them into training and test; jigs."""

from pisigma.measurement.dataset import Kind, LeftOut, Measurements
from pisigma.measurement.groups import groups_of_equal_joints, groups_to_keep_whole, placements
from pisigma.measurement.jig import Jig
from pisigma.measurement.joining import join
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
