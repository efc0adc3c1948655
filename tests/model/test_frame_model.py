"""Models with fitted frames: their uncertainty follows from that of the arm, in several frames and with weights."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.hybrid import hybrid_of, joints_in
from testing.models import no_type_checker

from pisigma.calibration.frames.arm_uncertainty import ArmUncertainty
from pisigma.calibration.frames.frame_fit import fit_frames
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, corrected_joints, poses_of_rows
from pisigma.model.frame_model import frames_of_model
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.robot.se3 import transform_from_xyz_zyx
from pisigma.validation.gate import check_rows_of_frames

TOOL = np.array([0.03, -0.02, 0.1, 0.0, 0.0, 0.0])
"""Position of a new target on the flange."""


@functools.cache
def hybrid() -> CalibratedModel:
    """Return a hybrid calibration in the frames "wall" and "floor" with the targets "A" and "B"."""
    arm = hybrid_of("rb5", 200, frames=True)
    with no_type_checker():
        return model_of_hybrid("arm", arm.true.nominal, arm.result, arm.measurements)


def new_target(model: CalibratedModel, rows: int = 6) -> Measurements:
    """Return positions in the frame "floor" of a new target that the model predicts exactly."""
    q = joints_in(model.robot, rows, 3)
    flange = Measurements(q=q, frame=("floor",) * rows, target=("A",) * rows)
    tool = transform_from_xyz_zyx(torch.from_numpy(np.stack([model.hybrid_tools["A"], TOOL])))
    T = poses_of_rows(model, flange) @ torch.linalg.inv(tool[0]) @ tool[1]
    return replace(flange, position=T[:, :3, 3], target=("C",) * rows)


def known_along(model: CalibratedModel, name: str, size: float) -> CalibratedModel:
    """Return the model with an uncertain parameter, or with uncertain weights that are known relative to each other."""
    known = model.uncertainty
    assert known is not None
    root = torch.zeros(len(known.dense_root), 1, dtype=torch.float64)
    weights = slice(len(known.space.parameters), None)
    root[weights if name == "weights" else known.space.index(name)] = size
    return replace(model, uncertainty=replace(known, covariance_root=CovarianceRoot(root)))


@pytest.mark.parametrize("name", ["base_floor_x", "base_wall_x", "theta_3", "weights"])
def test_fitted_tool_is_uncertain_by_what_the_fit_depends_on(name):
    model, rows = hybrid(), new_target(hybrid())
    found = frames_of_model(known_along(model, name, 1e-3), rows, "tool")
    assert_close(found.fit.estimates, TOOL[:3], atol=1e-6)
    assert found.model.hybrid is not None
    if name == "base_wall_x":
        assert_close(np.array(found.variance_due_to_arm), np.zeros(3))
    elif name == "weights":
        assert max(found.variance_due_to_arm) > 0
    else:
        bases = {one: base.copy() for one, base in model.hybrid_bases.items()}
        robot = model.hybrid.robot
        if name == "theta_3":
            dh = robot.dh.copy()
            dh[model.robot.joint_rows[2], 0] += 1e-3
            robot = robot.with_geometry(dh)
        else:
            bases["floor"][0] += 1e-3
        moved = fit_frames(robot, replace(rows, q=corrected_joints(model.hybrid, rows)), "tool", bases)
        change = moved.estimates - found.fit.estimates
        assert_close(np.sqrt(found.variance_due_to_arm), np.abs(change), rtol=0.02, atol=1e-6)


def test_weights_count_for_the_causes_of_a_misfit():
    model, rows = hybrid(), new_target(hybrid())
    known = known_along(model, "weights", 1e-3).uncertainty
    assert known is not None
    assert model.hybrid is not None
    fit = fit_frames(model.hybrid.robot, rows, "tool", model.hybrid_bases)
    assert bool(
        ArmUncertainty(known, rows).value_covariance_root(fit.solved, fit.used_rows, fit.frame_indices).any()
    )


def test_direction_that_is_held_is_uncertain_in_the_model():
    model = hybrid()
    q = new_target(model).q[:1].repeat(6, 1)
    q[:, -1] = torch.linspace(-1, 1, 6)
    rows = Measurements(q=q, frame=("floor",) * 6, target=("C",) * 6, socket=("needle",) * 6)
    found = frames_of_model(model, rows, "tool")
    assert found.fit.undetermined_indices
    assert found.model.uncertainty is not None
    deviation = found.model.uncertainty.sigma(rows)
    assert float(deviation.norm(dim=1).min()) > 0.05


def test_large_uncertainty_is_rounded(monkeypatch):
    monkeypatch.setattr("pisigma.calibration.hybrid.uncertainty.MAX_EXACT_ENTRIES", 0)
    found = frames_of_model(hybrid(), new_target(hybrid()), "tool")
    assert found.model.uncertainty is not None
    assert found.model.uncertainty.covariance_root.rounded is not None


@pytest.mark.parametrize("factor", [1.0, 1.02])
def test_scale_of_the_rows_is_checked_by_the_model_whose_arm_was_used(factor):
    model, rows = hybrid(), new_target(hybrid(), 10)
    assert rows.position is not None
    some = replace(rows, position=factor * rows.position)
    findings = check_rows_of_frames(some, model, frames_of_model(model, some, "hand-eye"))
    assert [one.kind for one in findings] == ([] if factor == 1.0 else ["scale"])
