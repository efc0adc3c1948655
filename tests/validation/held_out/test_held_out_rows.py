"""Held-out rows in a model folder: written, read, and refused where they were changed."""

import csv
import io
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.coupled import coupled_robot
from testing.models import hand_made_model
from testing.refusals import refused
from testing.report import bare_summary

from pisigma.files.errors import ModelError
from pisigma.files.model_files import HELD_OUT_CSV
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.faults import RowPlace
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.validation.held_out.calibration_validation import CalibrationValidation
from pisigma.validation.held_out.held_out_rows import HeldOutRows, read_held_out
from pisigma.validation.held_out.judged_rows import judged_rows_of_folder
from pisigma.validation.held_out.pose_statistics import ErrorsWithPredictedSigma, PoseErrors
from pisigma.validation.report.dependence import dependences
from pisigma.validation.report.error_map import largest_errors, map_of_rows

ROWS = 20


def _validation(rows: int, turned: bool, spread: bool) -> CalibrationValidation:
    rng = np.random.default_rng(3)
    models = {}
    for name in ("nominal", "geometric", "hybrid"):
        position = torch.from_numpy(rng.uniform(1e-5, 1e-3, rows))
        position[-1] = torch.nan
        models[name] = PoseErrors(position, torch.from_numpy(rng.uniform(0, 1e-3, rows)) if turned else None)
    error = torch.from_numpy(rng.normal(0, 1e-4, (rows, 3)))
    found = ErrorsWithPredictedSigma(error, error.abs()) if spread else None
    return CalibrationValidation(5, models, found)


def _kept(
    model: CalibratedModel, validation: CalibrationValidation, measured: Measurements
) -> tuple[str, CalibratedModel]:
    """The file of held-out rows, and the model whose metrics hold its hash."""
    held_out = HeldOutRows.from_validation(validation, measured)
    text = held_out.to_csv(model.robot)
    metrics = bare_summary(held_out_rows=held_out.compute_hashes(text)).to_json()
    return text, replace(model, kind="geometric_calibration", metrics=metrics)


@pytest.fixture
def measured() -> Measurements:
    q = hand_made_model("kiro3").starts[:ROWS]
    names = tuple(("wall", 'a "b", <i>', "", "line\nbreak")[k % 4] for k in range(ROWS))
    return Measurements(q=q, position=torch.rand(ROWS, 3).double(), frame=names, target=names[::-1])


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("spread", [False, True])
def test_rows_come_back(measured, tmp_path, turned, spread):
    model = hand_made_model("kiro3")
    validation = _validation(ROWS, turned, spread)
    text, keeping = _kept(model, validation, measured)
    (tmp_path / HELD_OUT_CSV).write_text(text, encoding="utf-8", newline="\n")
    found = read_held_out(tmp_path, keeping)
    assert found is not None
    assert found.data_sha256 == measured.content_hash()
    assert (found.frame, found.target) == (measured.frame, measured.target)
    assert_close(found.q, measured.q, atol=1e-14, rtol=1e-9)
    assert list(found.errors_by_model) == list(validation.errors_by_model)
    for name, errors in validation.errors_by_model.items():
        known = torch.isfinite(errors.position)
        assert torch.equal(torch.isfinite(found.errors_by_model[name].position), known)
        assert_close(found.errors_by_model[name].position[known], errors.position[known], rtol=6e-5)
        assert (found.errors_by_model[name].rotation is not None) == turned
        if turned:
            assert_close(found.errors_by_model[name].rotation, errors.rotation, rtol=6e-5)
    if spread:
        assert_close(found.residual, validation.spread.error, rtol=6e-5)
    else:
        assert bool(torch.isnan(found.residual).all())


def test_rows_of_a_report_are_named_by_file_and_line(measured, tmp_path):
    line, origin = tuple(range(3, 3 + 2 * ROWS, 2)), ("/a/first.csv", "/a/second.csv") * (ROWS // 2)
    text, model = _kept(
        hand_made_model("kiro3"),
        _validation(ROWS, False, False),
        replace(measured, line=line, origin=origin),
    )
    (tmp_path / HELD_OUT_CSV).write_text(text, encoding="utf-8", newline="\n")
    rows = judged_rows_of_folder(model, read_held_out(tmp_path, model))
    shown = map_of_rows(model, rows)
    assert shown.row.tolist() == list(line)
    assert shown.row_numbering == ("first.csv, line", "second.csv, line") * (ROWS // 2)
    worst = largest_errors(rows).row
    assert rows.measurements.place_of(worst) == RowPlace(origin[worst][3:], line[worst])


def test_joint_values_of_a_report_are_those_of_the_controller(tmp_path):
    model = hand_made_model("kiro4", robot=coupled_robot())
    q = model.starts[:ROWS]
    text, model = _kept(model, _validation(ROWS, False, False), Measurements(q=q))
    (tmp_path / HELD_OUT_CSV).write_text(text, encoding="utf-8", newline="\n")
    rows = judged_rows_of_folder(model, read_held_out(tmp_path, model))
    assert_close(rows.measurements.q, q, rtol=1e-9)
    shown = np.rad2deg(model.robot.to_controller(q.numpy()))
    assert_close(map_of_rows(model, rows).controller_values, shown, atol=1e-7)
    third = dependences(rows, model.robot)[2]
    assert_close(third.values, shown[:-1, 2], atol=1e-7)  # the last row has no error
    assert "q3_dh_deg" in text.splitlines()[0].split(",")


def test_columns_bear_their_units(measured):
    text, _ = _kept(hand_made_model("kiro3"), _validation(ROWS, True, True), measured)
    head = next(csv.reader(io.StringIO(text)))
    assert head[:6] == ["q1_deg", "q2_deg", "q3_mm", "q4_deg", "frame", "target"]
    assert head[6:8] == ["nominal_mm", "nominal_deg"]
    assert head[-3:] == ["residual_x_mm", "residual_y_mm", "residual_z_mm"]


def test_a_folder_without_held_out_rows_has_none(tmp_path):
    assert read_held_out(tmp_path, hand_made_model("kiro3")) is None


def test_a_changed_or_missing_file_is_refused(measured, tmp_path):
    text, model = _kept(hand_made_model("kiro3"), _validation(ROWS, False, False), measured)
    with pytest.raises(ModelError):
        read_held_out(tmp_path, model)
    (tmp_path / HELD_OUT_CSV).write_text(text.replace("wall", "hall", 1), encoding="utf-8")
    with refused(ModelError, file=tmp_path / HELD_OUT_CSV):
        read_held_out(tmp_path, model)
