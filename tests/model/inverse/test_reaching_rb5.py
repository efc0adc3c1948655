"""A simulated RB5 with every source of errors reaches the poses to which its hybrid commands it."""

import torch
from testing.closeness import assert_close
from testing.models import no_type_checker
from testing.rb5_with_all_errors import simulated_tracker

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot.kinematics.status import Status


def test_commanded_poses_are_reached_as_well_as_positions_are_predicted():
    simulated = simulated_tracker(0, 150)
    geometric = GeometricCalibrator(simulated.robot)
    with no_type_checker():
        result = HybridCalibrator(geometric, harmonics=(8, 24), products=False).fit(simulated.train)
        model = model_of_hybrid("rb5", simulated.robot, result, simulated.train)
        wanted = model.forward(simulated.test.q[:1000])  # of the target, which the model takes for the tool
        solution = CorrectedIK(model)(wanted)
    inside = solution.status == Status.REACHED
    assert float(inside.double().mean()) > 0.8
    errors = {}
    for name in ("q_nominal", "q"):
        q = getattr(solution, name)[inside]
        known = torch.isfinite(q).all(-1)
        off = simulated.pose(q[known])[:, :3, 3] - wanted[inside][known][:, :3, 3]
        errors[name] = float(off.square().sum(-1).mean().sqrt())
    held_out = float(result.errors_of(simulated.test)["position"].square().sum(-1).mean().sqrt())
    assert errors["q_nominal"] > 1e-3
    assert held_out < 0.07e-3
    assert_close(errors["q"], held_out, rtol=0.15)
