"""Rows that state their standard deviations, and those that do not, mean the same to every model."""

import math
from dataclasses import replace

import pytest
import torch
from testing.cell_rows import measured
from testing.closeness import assert_close
from testing.models import no_type_checker
from testing.refusals import refused

from pisigma.calibration.hybrid.noise import CalibrationNoise
from pisigma.files.errors import MeasurementError
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.validation.checks.check import RowsUnderModel
from pisigma.workflow.calibrate import calibrate
from pisigma.workflow.monitor import monitor
from pisigma.workflow.recalibrate import recalibrate
from pisigma.workflow.settings.calibration import CalibrationSettings
from pisigma.workflow.settings.monitoring import MonitorSettings

SIGMA = 3e-5
KINDS = {"stated": SIGMA, "unstated": None}
MOVED_DEG = 0.24


def rows_with(sigma, *arguments, **options):
    rows = measured(*arguments, **options)
    return rows if sigma is None else replace(rows, sigma_position=torch.full((rows.rows,), sigma).double())


@pytest.fixture(scope="module")
def models():
    with no_type_checker():
        settings = CalibrationSettings(folds=0)
        return {
            kind: calibrate("ur10", rows_with(sigma, 60, 1), settings).model for kind, sigma in KINDS.items()
        }


def as_written_before(model, folder):
    """A model as folders of earlier versions hold it: without the medians of stated standard deviations."""
    save_model(model, folder)
    path = folder / "model.yaml"
    assert "stated_noise" in path.read_text()
    loaded = load_model(folder)
    assert loaded.uncertainty.noise == model.uncertainty.noise
    older = replace(loaded.uncertainty, noise=CalibrationNoise(loaded.uncertainty.noise.value, None))
    return replace(loaded, uncertainty=older)


@pytest.mark.parametrize(("of_model", "of_rows"), [("stated", "unstated"), ("unstated", "stated")])
def test_a_move_is_found_whatever_states_its_noise(models, of_model, of_rows):
    rows = rows_with(KINDS[of_rows], 12, 3, zero=MOVED_DEG)
    with no_type_checker():
        session = (
            monitor(models[of_model], [rows], MonitorSettings(history=False)).sessions_of_call[-1].session
        )
        recalibrated = recalibrate(models[of_model], rows)
    assert [one.what for one in session.movements] == ["joint 3"]
    assert all(session.zero_is_observable)
    assert_close(session.movements[0].shift, MOVED_DEG, atol=0.005)
    assert [one.what for one in recalibrated.movements] == ["joint 3"]
    assert recalibrated.summary.kept_candidate == "recalibrated"
    found = recalibrated.model.uncertainty.noise
    assert found.is_factor("position") == (of_rows == "stated")
    assert_close(found.standard_deviation("position"), SIGMA, rtol=0.5)


@pytest.mark.parametrize("of_rows", KINDS)
@pytest.mark.parametrize("of_model", KINDS)
def test_nothing_is_found_where_nothing_moved(models, of_model, of_rows):
    rows = rows_with(KINDS[of_rows], 12, 5)
    with no_type_checker():
        session = (
            monitor(models[of_model], [rows], MonitorSettings(history=False)).sessions_of_call[-1].session
        )
    assert session.verdict == "unchanged"
    assert all(session.zero_is_observable)


@pytest.mark.parametrize("of_model", KINDS)
def test_checks_of_rows_use_the_stated_noise_of_any_source(models, of_model):
    with no_type_checker():
        usual = [
            RowsUnderModel.from_rows(models[of_model], rows_with(sigma, 12, 3), (), (), None).predicted_sigma
            for sigma in KINDS.values()
        ]
    assert_close(usual[0], usual[1], rtol=0.1)
    assert float(usual[0].max()) < 1e-3


def test_rows_without_standard_deviations_are_refused_where_an_older_folder_has_only_a_factor(
    models, tmp_path
):
    older = as_written_before(models["stated"], tmp_path)
    stated = rows_with(SIGMA, 12, 3, zero=MOVED_DEG)
    with no_type_checker():
        session = monitor(older, [stated], MonitorSettings(history=False)).sessions_of_call[-1].session
        assert [one.what for one in session.movements] == ["joint 3"]
        for judge in (
            lambda rows: monitor(older, [rows], MonitorSettings(history=False)),
            lambda rows: recalibrate(older, rows),
        ):
            with refused(MeasurementError, value="none"):
                judge(rows_with(None, 12, 3))


def test_an_older_folder_with_a_standard_deviation_takes_rows_of_both_kinds(models, tmp_path):
    older = as_written_before(models["unstated"], tmp_path)
    for sigma in KINDS.values():
        rows = rows_with(sigma, 12, 3, zero=MOVED_DEG)
        with no_type_checker():
            session = monitor(older, [rows], MonitorSettings(history=False)).sessions_of_call[-1].session
        assert [one.what for one in session.movements] == ["joint 3"]


@pytest.mark.parametrize("value", [0.02, 0.3, 1.0, 4.0])
def test_no_factor_is_taken_for_metres(value):
    older = CalibrationNoise({"position": value}, None)
    assert older.is_factor("position")
    assert math.isnan(older.standard_deviation("position"))


def test_a_coarse_instrument_of_a_new_folder_has_its_own_standard_deviation():
    noise = CalibrationNoise({"position": 0.02})
    assert not noise.is_factor("position")
    assert noise.standard_deviation("position") == 0.02


def test_other_rows_replace_the_noise_of_their_sensors_only():
    before = CalibrationNoise({"position": 1.0, "rotation": 2.0}, {"position": 3e-5, "rotation": 1e-4})
    after = before.updated(CalibrationNoise({"position": 4e-5}))
    assert after == CalibrationNoise({"position": 4e-5, "rotation": 2.0}, {"rotation": 1e-4})
    older = CalibrationNoise({"position": 1.0, "rotation": 2.0}, None)
    assert older.updated(CalibrationNoise({"position": 4e-5})).median_stated_sigma is None
    assert older.updated(CalibrationNoise({"position": 4e-5, "rotation": 1e-4})).median_stated_sigma == {}
