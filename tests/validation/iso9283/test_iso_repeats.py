"""AP and RP of the poses of a session that were measured more than once."""

from dataclasses import replace

import torch
from testing.closeness import assert_close

from pisigma.measurement.dataset import Measurements
from pisigma.validation.iso9283.pose import position_accuracy, position_repeatability
from pisigma.validation.iso9283.repeats import MIN_CYCLES, pooled_scatter, repeated_poses

GENERATOR = torch.Generator().manual_seed(3)
Q = torch.randn(3, 6, generator=GENERATOR, dtype=torch.float64)
POSE = torch.tensor([0, 1, 0, 2, 1, 0])
COMMANDED = torch.randn(3, 3, generator=GENERATOR, dtype=torch.float64)[POSE]
ATTAINED = COMMANDED + 1e-4 * torch.randn(6, 3, generator=GENERATOR, dtype=torch.float64)
ROWS = Measurements(q=Q[POSE], position=ATTAINED)


def test_poses_that_were_measured_more_than_once_have_figures():
    found = repeated_poses(ROWS, COMMANDED)
    assert [one.rows for one in found] == [3, 2]
    for one, number in zip(found, (0, 1), strict=True):
        attained, commanded = ATTAINED[number == POSE], COMMANDED[number == POSE][0]
        assert_close(one.accuracy, float(position_accuracy(attained, commanded).length))
        assert one.repeatability is None
    s, freedom = pooled_scatter(found)
    assert freedom == 9
    parts = [ATTAINED[number == POSE] - ATTAINED[number == POSE].mean(0) for number in (0, 1)]
    assert_close(s, float((torch.cat(parts).square().sum() / 9).sqrt()), rtol=1e-9)


def test_the_repeatability_needs_ten_cycles():
    attained = 1e-4 * torch.randn(MIN_CYCLES, 3, generator=GENERATOR, dtype=torch.float64)
    (found,) = repeated_poses(Measurements(q=Q[:1].expand(MIN_CYCLES, -1), position=attained), None)
    assert_close(found.repeatability, float(position_repeatability(attained)))
    (fewer,) = repeated_poses(Measurements(q=Q[:1].expand(MIN_CYCLES - 1, -1), position=attained[1:]), None)
    assert fewer.repeatability is None


def test_scatter_is_unbiased_with_two_cycles():
    q = torch.arange(2_000.0, dtype=torch.float64).repeat_interleave(2)[:, None].expand(-1, 6)
    attained = 1e-4 * torch.randn(4_000, 3, generator=GENERATOR, dtype=torch.float64)
    s, freedom = pooled_scatter(repeated_poses(Measurements(q=q, position=attained), None))
    assert freedom == 6_000
    assert_close(s, 1e-4, rtol=0.03)
    assert pooled_scatter(()) is None


def test_poses_that_were_commanded_half_a_milliradian_apart_are_not_repeats():
    q = Q[:1] + 5e-4 * torch.arange(MIN_CYCLES, dtype=torch.float64)[:, None]
    assert repeated_poses(Measurements(q=q, position=ATTAINED[:1].expand(MIN_CYCLES, -1)), None) == ()


def test_there_is_no_accuracy_without_the_command():
    assert [one.accuracy for one in repeated_poses(ROWS, None)] == [None, None]


def test_other_targets_are_other_poses_and_missing_positions_do_not_count():
    assert repeated_poses(replace(ROWS, target=("a", "a", "b", "a", "b", "c")), COMMANDED) == ()
    position = ATTAINED.clone()
    position[4] = torch.nan
    assert [one.rows for one in repeated_poses(replace(ROWS, position=position), COMMANDED)] == [3]
