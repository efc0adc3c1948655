"""Rigid transforms that fit best: exact data give them back, nothing near fits better; rows judged in fitted frames."""

from dataclasses import replace

import pytest
import torch
from testing.calibrated_ur5 import NOISE, calibrated_ur5, measured
from testing.closeness import assert_close
from testing.models import no_type_checker

from pisigma.errors import MeasurementError
from pisigma.judging.frames.frame_fits import (
    MeasuredPoses,
    best_base,
    best_base_and_tool,
    best_tool,
    poses_in_fitted_frames,
)
from pisigma.measurement.dataset import Measurements
from pisigma.model.row_poses import poses_of_rows
from pisigma.se3 import rotation_from_vector, transform, transform_from_xyzrpy

BASE = transform_from_xyzrpy(torch.tensor([0.3, -0.2, 0.1, 0.5, 0.2, -0.3], dtype=torch.float64))
TOOL = transform_from_xyzrpy(torch.tensor([0.03, -0.02, 0.05, 0.2, 0.1, 0.0], dtype=torch.float64))
LEVER = 0.2


@pytest.fixture
def T(generator):
    """Poses of a tool all over a cube."""
    turns = 2 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    places = torch.rand(40, 3, generator=generator, dtype=torch.float64)
    return transform(rotation_from_vector(turns), places)


def measured_as(T, turned: bool) -> MeasuredPoses:
    rotation = T[:, :3, :3].contiguous() if turned else None
    rows = Measurements(
        q=torch.zeros(len(T), 1).double(), position=T[:, :3, 3].contiguous(), rotation=rotation
    )
    return MeasuredPoses.of(rows, LEVER)


@pytest.mark.parametrize("turned", [False, True])
def test_exact_data_give_the_transforms_back(T, turned):
    tool = TOOL.clone() if turned else transform(torch.eye(3).double(), TOOL[:3, 3])
    assert_close(best_base(T, measured_as(BASE @ T, turned)), BASE, atol=1e-12)
    assert_close(best_tool(T, measured_as(T @ tool, turned)), tool, atol=1e-12)
    base, behind = best_base_and_tool(T, measured_as(BASE @ T @ tool, turned))
    assert_close(base, BASE, atol=1e-9)
    assert_close(behind, tool, atol=1e-9)


@pytest.mark.parametrize("turned", [False, True])
def test_nothing_near_fits_better(T, generator, turned):
    spoilt = BASE @ T
    spoilt[:, :3, 3] += 0.05 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    rows = measured_as(spoilt, turned)
    for fit, behind in ((best_base, False), (best_tool, True)):
        X = fit(T, rows)
        least = rows.squares(T @ X if behind else X @ T).sum()
        steps = 1e-3 * torch.eye(6, dtype=torch.float64)
        for step in torch.cat([steps, -steps]):
            if behind and not turned and bool(step[3:].any()):
                continue  # a turn of the tool shows in no position
            near = X @ transform(rotation_from_vector(step[3:]), step[:3])
            assert float(rows.squares(T @ near if behind else near @ T).sum()) > float(least)


def test_batches_equal_single_ones(T):
    batch = torch.stack([T, BASE @ T, T @ TOOL])
    rows = measured_as(T, True)
    for fit in (best_base, best_tool):
        assert_close(fit(batch, rows), torch.stack([fit(one, rows) for one in batch]), atol=1e-12)
    assert_close(rows.squares(batch)[0], torch.zeros(40), atol=1e-15)


@pytest.fixture(scope="module")
def arm():
    """The geometric calibration of a simulated UR5, and new poses of it, with noise in the positions."""
    model, q, T = calibrated_ur5(60)
    with no_type_checker():
        return model, measured(q, T, True)


def from_elsewhere(rows: Measurements, turned: bool) -> Measurements:
    """The rows as a tracker that was moved measures them."""
    R, p = BASE[:3, :3], BASE[:3, 3]
    return replace(
        rows,
        position=rows.position @ R.T + p,
        rotation=R @ rows.rotation if turned else None,
        frame=("east",) * rows.rows,
    )


@pytest.mark.usefixtures("without_type_checker")
def test_every_frame_is_fitted_for_itself_and_to_other_rows(arm):
    model, rows = arm
    rows = replace(from_elsewhere(rows, True), frame=("east",) * 30 + ("west",) * 30)
    rows.position[30:] += 0.2
    T = poses_in_fitted_frames(model, rows)
    assert float((T[:, :3, 3] - rows.position).norm(dim=-1).square().mean().sqrt()) < 4 * NOISE
    pulled = replace(rows, position=rows.position.clone())
    pulled.position[7] += 0.05
    changed = (poses_in_fitted_frames(model, pulled) - T).abs().amax((1, 2)) > 1e-9
    assert not bool(changed[7])  # it has no part in the frame it is judged in
    assert bool(changed[:30].any())
    assert not bool(changed[30:].any())


@pytest.mark.usefixtures("without_type_checker")
def test_exact_rows_are_met_exactly(arm):
    model, rows = arm
    T = poses_of_rows(model, rows)
    exact = from_elsewhere(replace(rows, position=T[:, :3, 3].clone(), rotation=T[:, :3, :3].clone()), True)
    assert_close(poses_in_fitted_frames(model, exact)[:, :3, 3], exact.position, atol=1e-12)


@pytest.mark.usefixtures("without_type_checker")
def test_a_frame_needs_poses(arm):
    model, rows = arm
    few = replace(from_elsewhere(rows, False), frame=("east",) * 55 + ("west",) * 5)
    with pytest.raises(MeasurementError, match=r"frame 'west' holds 5 different joint vectors .* 12 or more"):
        poses_in_fitted_frames(model, few)
    with pytest.raises(MeasurementError, match="no positions"):
        poses_in_fitted_frames(model, replace(rows, position=None))
