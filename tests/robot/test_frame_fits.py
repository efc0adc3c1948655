"""Fitted base and tool transforms: exact data restore them, and perturbations fit worse."""

import pytest
import torch
from testing.closeness import assert_close

from pisigma.measurement.dataset import Measurements
from pisigma.robot.frame_fits import (
    MeasuredPoses,
    best_base,
    best_base_and_tool,
    best_tool,
    smallest_error,
)
from pisigma.robot.se3 import rotation_from_vector, transform, transform_from_xyz_zyx

BASE = transform_from_xyz_zyx(torch.tensor([0.3, -0.2, 0.1, 0.5, 0.2, -0.3], dtype=torch.float64))
TOOL = transform_from_xyz_zyx(torch.tensor([0.03, -0.02, 0.05, 0.2, 0.1, 0.0], dtype=torch.float64))
LEVER = 0.2


@pytest.fixture
def T(generator):
    """Tool poses in a cube."""
    turns = 2 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    places = torch.rand(40, 3, generator=generator, dtype=torch.float64)
    return transform(rotation_from_vector(turns), places)


def measured_as(T, turned: bool) -> MeasuredPoses:
    rotation = T[:, :3, :3].contiguous() if turned else None
    rows = Measurements(
        q=torch.zeros(len(T), 1).double(), position=T[:, :3, 3].contiguous(), rotation=rotation
    )
    return MeasuredPoses.from_tensors(rows.position, rows.rotation, LEVER)


@pytest.mark.parametrize("turned", [False, True])
def test_exact_data_restore_the_transforms(T, turned):
    tool = TOOL.clone() if turned else transform(torch.eye(3).double(), TOOL[:3, 3])
    assert_close(best_base(T, measured_as(BASE @ T, turned)), BASE, atol=1e-12)
    assert_close(best_tool(T, measured_as(T @ tool, turned)), tool, atol=1e-12)
    for few in (T, T[:6]):
        base, behind = best_base_and_tool(few, measured_as(BASE @ few @ tool, turned))
        assert_close(base, BASE, atol=1e-9)
        assert_close(behind, tool, atol=1e-9)


@pytest.mark.parametrize("turned", [False, True])
def test_perturbed_transforms_fit_worse(T, generator, turned):
    spoilt = BASE @ T
    spoilt[:, :3, 3] += 0.05 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    rows = measured_as(spoilt, turned)
    for fit, behind in ((best_base, False), (best_tool, True)):
        X = fit(T, rows)
        least = rows.squared_errors(T @ X if behind else X @ T).sum()
        steps = 1e-3 * torch.eye(6, dtype=torch.float64)
        for step in torch.cat([steps, -steps]):
            if behind and not turned and bool(step[3:].any()):
                continue  # a turn of the tool shows in no position
            near = X @ transform(rotation_from_vector(step[3:]), step[:3])
            assert float(rows.squared_errors(T @ near if behind else near @ T).sum()) > float(least)


@pytest.mark.parametrize("turned", [False, True])
def test_weights_select_rows(T, generator, turned):
    spoilt = BASE @ T @ TOOL
    spoilt[:, :3, 3] += 0.05 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    rows, chosen = measured_as(spoilt, turned), torch.rand(5, 40, generator=generator) < 0.4
    for fit in (best_base, best_tool):
        weighted = fit(T.expand(5, 40, 4, 4), rows, chosen.double())
        assert_close(weighted, torch.stack([fit(T[some], rows.select(some)) for some in chosen]), atol=1e-12)


@pytest.mark.parametrize("turned", [False, True])
def test_no_base_and_tool_leave_smaller_errors(T, generator, turned):
    spoilt = BASE @ T @ TOOL
    spoilt[:, :3, 3] += 0.05 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    rows = measured_as(spoilt, turned)
    base, tool = best_base_and_tool(T, rows)
    fitted = float(rows.squared_errors(base @ T @ tool).mean().sqrt())
    assert 0.5 * fitted < float(smallest_error(T, rows)) < fitted
    assert float(smallest_error(T[:13], rows.select(torch.arange(13)))) == 0.0


def test_batches_equal_single_ones(T):
    batch = torch.stack([T, BASE @ T, T @ TOOL])
    rows = measured_as(T, True)
    for fit in (best_base, best_tool):
        assert_close(fit(batch, rows), torch.stack([fit(one, rows) for one in batch]), atol=1e-12)
    assert_close(rows.squared_errors(batch)[0], torch.zeros(40), atol=1e-15)
