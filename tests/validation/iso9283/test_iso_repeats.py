"""AP and RP of the poses of a session that were measured more than once."""

from dataclasses import replace

import torch
from testing.closeness import assert_close

from pisigma.measurement.dataset import Measurements
from pisigma.validation.iso9283.pose import position_accuracy, position_repeatability
from pisigma.validation.iso9283.repeats import repeated_poses

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
        assert_close(one.repeatability, float(position_repeatability(attained)))


def test_there_is_no_accuracy_without_the_command():
    assert [one.accuracy for one in repeated_poses(ROWS, None)] == [None, None]


def test_other_targets_are_other_poses_and_missing_positions_do_not_count():
    assert repeated_poses(replace(ROWS, target=("a", "a", "b", "a", "b", "c")), COMMANDED) == ()
    position = ATTAINED.clone()
    position[4] = torch.nan
    assert [one.rows for one in repeated_poses(replace(ROWS, position=position), COMMANDED)] == [3]
