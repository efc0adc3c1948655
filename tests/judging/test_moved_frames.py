"""Models are judged in frames that were set up anew as in those that they were fitted in."""

from dataclasses import replace

import pytest
import torch
from testing.calibrated_ur5 import NOISE, calibrated_ur5, measured
from testing.closeness import assert_close
from testing.models import no_type_checker

from pisigma.errors import MeasurementError
from pisigma.judging.moved_frames import poses_in_fitted_frames
from pisigma.measurement.dataset import Measurements
from pisigma.model.row_poses import poses_of_rows
from pisigma.se3 import transform_from_xyzrpy
from pisigma.verification.verification import verify

pytestmark = pytest.mark.usefixtures("without_type_checker")

MOVED = transform_from_xyzrpy(torch.tensor([0.3, -0.2, 0.1, 0.5, 0.2, -0.3], dtype=torch.float64))


@pytest.fixture(scope="module")
def arm():
    """The geometric calibration of a simulated UR5, and new poses of it, with noise in the positions."""
    model, q, T = calibrated_ur5(60)
    with no_type_checker():
        return model, measured(q, T, True)


def from_elsewhere(rows: Measurements, turned: bool) -> Measurements:
    """The rows as a tracker sees them that was moved."""
    R, p = MOVED[:3, :3], MOVED[:3, 3]
    return replace(
        rows,
        position=rows.position @ R.T + p,
        rotation=R @ rows.rotation if turned else None,
        frame=("east",) * rows.rows,
    )


@pytest.mark.parametrize("turned", [False, True])
def test_a_moved_tracker_is_no_mix_up(arm, turned):
    model, rows = arm
    here = verify(model, rows if turned else replace(rows, rotation=None))
    there = verify(model, from_elsewhere(rows, turned), fit_frame=True)
    assert there.verdict == "better"
    assert there.setup_faults == ()
    assert [remark for remark in there.remarks if "fitted anew" in remark]
    for before, after in zip(here.comparison["models"], there.comparison["models"], strict=True):
        assert after["rms_mm"] < 1.3 * before["rms_mm"]
    assert there.comparison["models"][-1]["rms_mm"] > 0.8 * here.comparison["models"][-1]["rms_mm"]
    assert (
        verify(model, replace(from_elsewhere(rows, turned), frame=()), fit_frame=False).verdict == "mixed_up"
    )


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


def test_exact_rows_are_met_exactly(arm):
    model, rows = arm
    T = poses_of_rows(model, rows)
    exact = from_elsewhere(replace(rows, position=T[:, :3, 3].clone(), rotation=T[:, :3, :3].clone()), True)
    assert_close(poses_in_fitted_frames(model, exact)[:, :3, 3], exact.position, atol=1e-12)


def test_a_frame_needs_poses(arm):
    model, rows = arm
    few = replace(from_elsewhere(rows, False), frame=("east",) * 55 + ("west",) * 5)
    with pytest.raises(MeasurementError, match=r"frame 'west' holds 5 different joint vectors .* 12 or more"):
        verify(model, few, fit_frame=True)
    with pytest.raises(MeasurementError, match="no positions"):
        poses_in_fitted_frames(model, replace(rows, position=None))
