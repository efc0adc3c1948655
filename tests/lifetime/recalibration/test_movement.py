"""Movements: their figures, and the forms in which histories and model folders store them."""

import re

import numpy as np
import pytest
from pydantic import TypeAdapter
from testing.closeness import assert_close

from pisigma.lifetime.recalibration.movement import HistoryMovement, Movement, SummaryMovement

JOINT = Movement("joint 3", 0.25, 1e-3, "deg", 0.999)


@pytest.mark.parametrize(
    ("movement", "figures"),
    [
        (Movement("joint 3", 0.25, 1e-6, "deg"), ["0.2500", "0.0001"]),
        (Movement("a_2", -1.2, 0.1, "mm"), ["-1.20", "0.20"]),
    ],
)
def test_an_uncertainty_is_never_shown_as_zero(movement, figures):
    assert re.findall(r"-?[0-9]+[.][0-9]+", movement.shift_text) == figures


def test_histories_of_earlier_versions_are_read():
    nested = '{"moved":{"what":"joint 3","shift":0.25,"deviation":0.001,"unit":"deg"},"probability":0.999}'
    stored = TypeAdapter(HistoryMovement)
    assert stored.validate_json(nested) == JOINT
    assert stored.validate_json(stored.dump_json(JOINT)) == JOINT


@pytest.mark.parametrize("probability", [None, 0.9])
def test_model_folders_store_the_json_of_a_movement(probability):
    movement = Movement("base", 1.5, 0.1, "mm", probability)
    stored = TypeAdapter(SummaryMovement)
    plain = stored.dump_python(movement)
    assert plain == movement.to_json()
    assert set(plain) == {"what", "shift_mm", "interval"} | ({"probability"} if probability else set())
    again = stored.validate_python(plain)
    assert (again.what, again.shift, again.unit, again.probability) == ("base", 1.5, "mm", probability)
    assert_close(again.sigma, movement.sigma, rtol=1e-12)


@pytest.mark.parametrize("size", [0.0, 0.5, 1.0, 2.0, 3.0, 5.0, 20.0])
@pytest.mark.parametrize("what", ["joint 3", "base", "tool left"])
def test_intervals_cover_true_shifts_and_chance_is_not_significant(what: str, size: float):
    draws = np.random.default_rng(1).normal(size=(20_000, 3 if what != "joint 3" else 1))
    draws[:, 0] += size
    shifts = draws[:, 0] if what == "joint 3" else np.linalg.norm(draws, axis=1)
    movements = [Movement(what, float(shift), 1.0, "mm") for shift in shifts]
    covered = np.mean([low <= size <= high for low, high in (one.interval for one in movements)])
    assert 0.935 < covered < 0.98
    if size == 0.0:
        assert np.mean([one.is_significant for one in movements]) < 0.0015
