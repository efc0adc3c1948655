"""Motors of an SO-101 in LeRobot, and data sets that LeRobot wrote."""

from pathlib import Path

import numpy as np
import torch

from pisigma.measurement.foreign.lerobot_motors import Motor
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot import Robot

ZEROS = np.array([0.0, 12.0, -7.0, 5.5, 0.0])
"""[deg] Errors of the zeros; those of the first and the last joint cannot be distinguished from base and tool."""
MOTORS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
NAMES = tuple(f"{name}.pos" for name in MOTORS)
RANGES = ((745, 3340), (838, 3237), (902, 3100), (860, 3221), (0, 4095), (2036, 3500))
SO101 = {
    name: Motor(n, 0, 10 * n, low, high)
    for n, (name, (low, high)) in enumerate(zip(MOTORS, RANGES, strict=True), 1)
}
DATA_SETS = Path(__file__).parents[1] / "deployment" / "lerobot" / "data_sets"
"""Written by LeRobot 0.3.3 (v2.1) and 0.4.4 (v3.0): two episodes of six frames in degrees."""


def so101_model() -> CalibratedModel:
    """Return a model of an SO-101 with wrong zeros and no other error."""
    nominal = Robot.load("so101")
    dh = nominal.dh.copy()
    dh[:, 0] += np.deg2rad(ZEROS)
    low, high = nominal.limits.T
    starts = torch.from_numpy(np.random.default_rng(0).uniform(low, high, (300, 5)))
    calibrated = nominal.with_geometry(dh=dh)
    return CalibratedModel("so101", "test", nominal, None, None, (), starts, calibrated=calibrated)
