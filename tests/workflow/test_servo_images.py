"""Later images of an arm of servos: every command takes the scatter of the joints into account."""

import numpy as np
import pytest
from testing.phone_arm import SERVO, phone_rows, rows_of_phone

import pisigma

JOINT, MOVED = 2, np.deg2rad(3)


@pytest.fixture(scope="module")
def arm():
    rows, true, later = phone_rows(0, 40)
    model = pisigma.calibrate("so101", rows, pisigma.CalibrationSettings(folds=0)).model
    dh = true.dh.copy()
    dh[JOINT, 0] += MOVED
    unchanged = rows_of_phone(true, later[:12], np.random.default_rng(7), 7)
    moved = rows_of_phone(true.with_geometry(dh), later[20:32], np.random.default_rng(8), 8)
    return model, rows, unchanged, moved


@pytest.mark.parametrize("name", ["evaluate", "verify", "monitor", "recalibrate"])
def test_images_of_an_unchanged_arm_are_believed(arm, name):
    model, _, unchanged, _ = arm
    result = getattr(pisigma, name)(model, [unchanged] if name == "monitor" else unchanged).to_json()
    assert not result.get("diagnostics")
    assert not result.get("untrusted")
    assert not result.get("action")
    assert not result.get("moved")


@pytest.mark.parametrize("name", ["verify", "monitor", "recalibrate"])
def test_a_moved_zero_is_named_in_images(arm, name):
    model, _, _, moved = arm
    result = getattr(pisigma, name)(model, [moved] if name == "monitor" else moved)
    values = result.to_json()
    assert not values.get("diagnostics")
    session = values["sessions"][0] if name == "monitor" else values
    assert [one["what"] for one in session["moved"]] == [f"joint {JOINT + 1}"]
    if name == "recalibrate":
        assert result.movements[0].shift == pytest.approx(np.rad2deg(MOVED), abs=0.6)


def test_a_model_stores_the_scatter_of_its_joints(arm):
    assert arm[0].uncertainty.noise.value["joint"] == pytest.approx(SERVO, rel=0.2)


def test_rows_of_a_model_are_those_of_the_file(arm):
    """The weights that a calibration computes must not make its rows look like others."""
    model, rows, _, _ = arm
    assert model.provenance.data_sha256 == rows.content_hash()
    assert pisigma.evaluate(model, rows).model_descriptions["so101"].trained_on
