"""Movements: their figures, and the forms in which histories and model folders store them."""

import re

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
    assert re.findall(r"-?[0-9]+[.][0-9]+", movement.size) == figures


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
