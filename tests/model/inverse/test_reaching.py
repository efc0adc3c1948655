"""The purpose of pisigma: with corrected joint values the simulated true robot comes closer to the desired pose."""

import pytest
from testing.closeness import assert_close
from testing.models import trained_run

from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot import Robot
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import pose_error
from pisigma.simulation.true_robot import TrueRobot


@pytest.mark.parametrize("name", ["kiro3", "kiro4"])
def test_tool_errors_fall_to_a_tenth(name):
    recipe, run = trained_run(name)
    truth = TrueRobot(Robot.load(recipe.robot), recipe.data.errors)
    T = run.held_out.T
    solution = CorrectedIK(run.model)(T)
    errors = {}
    for key, q in (("nominal", solution.q_nominal), ("corrected", solution.q)):
        error = pose_error(T, truth.forward(q))
        errors[key] = (error[:, :3].norm(dim=-1).mean(), error[:, 3:].norm(dim=-1).mean())
    for before, after in zip(errors["nominal"], errors["corrected"], strict=True):
        assert float(after) < float(before) / 10
    inside = solution.status == Status.REACHED
    assert float(inside.double().mean()) > 0.5
    assert set(solution.status.tolist()) <= {int(Status.REACHED), int(Status.OUTSIDE_DOMAIN)}


@pytest.mark.parametrize("name", ["kiro3", "kiro4"])
def test_forward_of_a_trained_model_is_undone(name):
    _, run = trained_run(name)
    q = run.measurements.q
    T = run.model.forward(q)
    assert_close(CorrectedIK(run.model)(T, near=q).q, q, atol=1e-9)
    assert_close(pose_error(run.measurements.T, T)[:, :3], 0.0, atol=1e-3)
