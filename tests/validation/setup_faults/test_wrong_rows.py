"""Single rows that are far off are named and left out; rows that are all off alike are not."""

from dataclasses import replace

import pytest
import torch
from testing.simulated_arm import simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.model.geometric_model import model_of_calibration
from pisigma.robot.se3 import rotation_from_vector
from pisigma.validation.checks.wrong_rows import without_wrong_rows

pytestmark = pytest.mark.usefixtures("without_type_checker")
WRONG = 7


@pytest.fixture(scope="module")
def arm():
    return simulate("ur5", rows=40, noise=3e-5, turn_noise=1e-4)


@pytest.fixture(scope="module")
def model(arm):
    result = GeometricCalibrator(arm.nominal).fit(arm.measurements)
    return model_of_calibration("arm", arm.nominal, result, arm.measurements)


def spoilt(rows, shift=0.0, turn=0.0, wrong=(WRONG,)):
    position, rotation, numbers = rows.position.clone(), rows.rotation.clone(), list(wrong)
    position[numbers, 0] += shift
    rotation[numbers] = (
        rotation_from_vector(torch.tensor([0.0, 0.6, 0.8]).double() * turn) @ rotation[numbers]
    )
    return replace(rows, position=position, rotation=rotation)


@pytest.mark.parametrize("fitted", [(), ("base",), ("base", "tool")])
@pytest.mark.parametrize(("shift", "turn"), [(0.0, 2.83), (0.05, 0.0)])
def test_a_row_that_is_far_off_is_named(arm, model, shift, turn, fitted):
    found = without_wrong_rows([model], spoilt(arm.measurements, shift, turn), fitted)
    assert found.rows.rows == arm.measurements.rows - 1
    assert (found.wrong_row_indices, len(found.warnings)) == ((WRONG,), 1)


def test_rows_of_usual_errors_and_many_wrong_ones_are_all_judged(arm, model):
    many = spoilt(arm.measurements, 0.05, wrong=range(0, 40, 4))  # a quarter
    for rows in (arm.measurements, spoilt(arm.measurements, 5e-4, 2e-3), many):
        found = without_wrong_rows([model], rows)
        assert (found.rows.rows, found.warnings) == (40, ())


@pytest.mark.parametrize(("shift", "turn"), [(0.0, 2.83), (0.05, 0.0)])
def test_one_of_few_rows_is_named_if_nothing_is_fitted(arm, model, shift, turn):
    rows = spoilt(arm.measurements, shift, turn).select(torch.arange(2, 10))
    found = without_wrong_rows([model], rows)
    assert found.wrong_row_indices == (WRONG - 2,)
    assert without_wrong_rows([model], rows, ("base", "tool")).wrong_row_indices == ()
    assert without_wrong_rows([model], rows.select(torch.arange(3, 8))).wrong_row_indices == ()
