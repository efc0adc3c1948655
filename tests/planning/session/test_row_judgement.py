"""Judgement of rows: which of them count."""

import numpy as np
import torch
from testing.measured_plans import NOISE, measured_plan, with_offset

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.measurement.dataset import Measurements
from pisigma.planning.session.row_judgement import judge_rows

PLAN = measured_plan()
ROBOT = PLAN.stored.arm.robot


def counting(rows: Measurements, trusted: int) -> list[int]:
    """Rows that count, given the number of trusted ones."""
    mask = torch.arange(rows.rows) < trusted
    return judge_rows(ROBOT, rows, NOISE, mask).used_rows.nonzero()[:, 0].tolist()


def swapped(rows: Measurements, one: int, other: int) -> Measurements:
    order = list(range(rows.rows))
    order[one], order[other] = other, one
    assert rows.position is not None
    return Measurements(q=rows.q, position=rows.position[order], line=rows.line)


def test_correct_rows_count():
    for count in (2, 14):
        assert counting(PLAN.rows(count), count - 1) == list(range(count))


def test_rows_of_a_robot_with_poor_repeatability_count():
    rows = PLAN.rows(16)
    assert rows.position is not None
    noise = torch.from_numpy(np.random.default_rng(1).normal(size=(16, 3))) * 2e-4
    rows = Measurements(q=rows.q, position=rows.position + noise)
    assert counting(rows, 15) == list(range(16))


def test_a_new_row_that_is_5_mm_off_does_not_count():
    rows = with_offset(PLAN.rows(15), 14, (0.003, -0.004, 0.0))
    assert counting(rows, 14) == list(range(14))


def test_a_swapped_point_among_the_first_rows_is_found():
    rows = swapped(PLAN.rows(20), 1, 19).select(torch.arange(6))
    assert counting(rows, 5) == [0, 2, 3, 4, 5]


def test_base_and_tool_of_every_set_of_rows_are_guessed_once(monkeypatch):
    guessed, build = [], GeometricCalibrator.build

    def noted(calibrator, rows):
        guessed.append(rows.line)
        return build(calibrator, rows)

    monkeypatch.setattr(GeometricCalibrator, "build", noted)
    assert counting(with_offset(PLAN.rows(6), 1, (0.02, 0.0, 0.0)), 5) == [0, 2, 3, 4, 5]
    assert len(set(guessed)) == len(guessed) == 7


def test_a_row_that_was_called_wrong_can_be_used_again():
    rows = PLAN.rows(15)
    mask = (torch.arange(15) < 14) & (torch.arange(15) != 4)
    assert judge_rows(ROBOT, rows, NOISE, mask).used_rows.all()


def test_a_trusted_row_that_later_rows_contradict_stops_counting():
    rows = with_offset(PLAN.rows(16), 3, (0.0, 0.004, 0.003))
    assert counting(rows, 15) == [row for row in range(16) if row != 3]
