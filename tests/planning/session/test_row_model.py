"""Prediction of every row from the others."""

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.measured_plans import NOISE, measured_plan, with_offset

from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.planning.session.row_judgement import RowModel

PLAN = measured_plan()
ROWS = PLAN.rows(14)
EVERY = torch.ones(14, dtype=torch.bool)


def leave_one_out(rows, kept=EVERY):
    return RowModel.from_rows(PLAN.stored.arm.robot, rows, NOISE, kept).leave_one_out()


@pytest.fixture(scope="module")
def of_right_rows():
    return leave_one_out(ROWS)


def test_correct_rows_have_usual_probabilities(of_right_rows):
    assert float(of_right_rows.p_value.min()) > 5e-3
    assert 1.0 <= of_right_rows.error_scale < 1.5
    assert float(of_right_rows.length_error.max()) < 3e-3
    assert bool(of_right_rows.angle_error.isnan().all())
    assert_close(of_right_rows.position_error.norm(dim=1), of_right_rows.length_error, rtol=1e-12)


def test_a_held_out_row_is_predicted_as_if_it_had_not_been_measured(of_right_rows):
    kept = torch.arange(14) != 6
    without = leave_one_out(ROWS, kept)
    assert_close(without.position_error[6], of_right_rows.position_error[6], atol=2e-5)


def test_the_prediction_does_not_depend_on_a_row_that_is_not_kept():
    kept = torch.arange(14) != 6
    away = with_offset(ROWS, 6, (0.3, -0.5, 0.2))
    there, here = leave_one_out(away, kept), leave_one_out(ROWS, kept)
    assert_close(there.position_error[6] - here.position_error[6], [0.3, -0.5, 0.2], atol=1e-5)
    assert_close(there.position_error[kept], here.position_error[kept], atol=1e-6)
    assert float(there.p_value[6]) < 1e-12


def test_three_positions_cannot_be_predicted_from_each_other():
    assert bool(leave_one_out(ROWS.select(torch.arange(3)), EVERY[:3]).p_value.isnan().all())


def test_two_positions_are_too_few():
    with pytest.raises(IdentificationError, match="measure more"):
        leave_one_out(ROWS.select(torch.arange(2)), EVERY[:2])


def test_the_scale_of_a_robot_with_larger_errors_than_its_class():
    assert ROWS.position is not None
    noise = torch.from_numpy(np.random.default_rng(0).normal(size=(14, 3))) * 5e-3
    assert leave_one_out(Measurements(q=ROWS.q, position=ROWS.position + noise)).error_scale > 3
