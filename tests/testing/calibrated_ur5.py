"""The geometric calibration of a simulated UR5, and new measurements of it."""

import numpy as np
import torch
from testing.hybrid import joints_in
from testing.models import no_type_checker
from testing.simulated_arm import simulate
from testing.stored import stored

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.geometric_model import model_of_calibration
from pisigma.robot.kinematics.forward import forward_kinematics

NOISE = 5e-5
"""Standard deviation of a measured coordinate [m]."""


def measured(q: torch.Tensor, T: torch.Tensor, turned: bool) -> Measurements:
    """Return measurements of poses T `(rows, 4, 4)`, or of their positions only, with noise in the positions."""
    noise = NOISE * torch.from_numpy(np.random.default_rng(4).normal(size=(len(q), 3)))
    return Measurements(q=q, position=T[:, :3, 3] + noise, rotation=T[:, :3, :3].clone() if turned else None)


@stored
def calibrated_ur5(rows: int) -> tuple[CalibratedModel, torch.Tensor, torch.Tensor]:
    """Return the model, new joint values `(rows, 6)` [rad] and their true poses `(rows, 4, 4)`."""
    with no_type_checker():
        found = simulate("ur5", rows=90, noise=NOISE, turn_noise=1e-4)
        result = GeometricCalibrator(found.nominal).fit(found.measurements)
        model = model_of_calibration("ur5", found.nominal, result, found.measurements)
        q = joints_in(found.true, rows, seed=3)
        return model, q, forward_kinematics(found.true, q)
