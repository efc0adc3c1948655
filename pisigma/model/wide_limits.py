"""A model whose limits hold the rows that it was made of."""

from dataclasses import replace

from pisigma.measurement.dataset import Measurements
from pisigma.measurement.joint_range import with_limits_of_rows
from pisigma.model.calibrated_model import CalibratedModel


def with_wide_limits(model: CalibratedModel, rows: Measurements) -> CalibratedModel:
    """Return the model with joint limits that are wide enough for rows."""
    calibrated = None if model.calibrated is None else with_limits_of_rows(model.calibrated, rows)
    hybrid = model.hybrid
    if hybrid is not None:
        hybrid = replace(hybrid, robot=with_limits_of_rows(hybrid.robot, rows))
    robot = with_limits_of_rows(model.robot, rows)
    return replace(model, robot=robot, calibrated=calibrated, hybrid=hybrid)
