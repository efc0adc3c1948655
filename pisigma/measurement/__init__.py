"""Data sets of measurements: their CSV form, and parting them into training and test."""

from pisigma.measurement.dataset import LeftOut, Measurements
from pisigma.measurement.splits import groups_of_equal_joints, holdout, k_folds

__all__ = [
    "LeftOut",
    "Measurements",
    "groups_of_equal_joints",
    "holdout",
    "k_folds",
]
