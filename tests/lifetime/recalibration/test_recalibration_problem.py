"""Unknowns of a recalibration: those of the model and of the rows, in the order of the sensors."""

import torch
from testing.aged import original_model, rows_after_change
from testing.closeness import assert_close

from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.lifetime.recalibration.recalibration_problem import _joined_space, recalibration_problem
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.sensor import UnknownGroup
from pisigma.measurement.sensors.socket import SOCKET_COLUMNS
from pisigma.model.model_posterior import ModelPosterior
from pisigma.robot import Robot


def test_owners_are_in_the_order_of_the_rows():
    robot = Robot.load("kiro3")
    before = ParameterSpace(
        robot, ("wall",), ("",), (UnknownGroup("socket", SOCKET_COLUMNS, ("a", "b"), ("wall",) * 2),)
    )
    rows = Measurements(
        q=torch.zeros(2, robot.dof).double(), socket=("c", "b"), frame=("floor",) * 2, target=("ball",) * 2
    )
    space = _joined_space(before, rows)
    assert (space.frames, space.targets) == (("wall", "floor"), ("", "ball"))
    (group,) = space.unknowns
    assert (group.owners, group.frames) == (("c", "b", "a"), ("floor", "floor", "wall"))


def test_the_prior_is_the_posterior_of_the_model():
    model, rows = original_model(), rows_after_change(10, 2)
    posterior = ModelPosterior.from_model(model)
    problem = recalibration_problem(model, posterior, rows, frozenset())
    parameters = len(posterior.space.parameters)
    back = torch.cat(
        [
            problem.coordinate_jacobian @ problem.covariance_root[:parameters],
            problem.covariance_root[parameters:],
        ]
    )
    assert_close(back, posterior.covariance_root, atol=1e-12)
    elsewhere = recalibration_problem(model, posterior, rows, {("base", "")})
    base = elsewhere.design.problem.space.indices_of("base")
    assert not elsewhere.covariance_root[base.start : base.stop].any()
    assert [group.name for group in elsewhere.groups if group.fixed_size] == ["base"]
    still = problem.with_fixed_arm()
    assert still.covariance_root.shape[1] == 0
    assert still.groups == ()
    assert_close(still.held_covariance_root, problem.covariance_root)
