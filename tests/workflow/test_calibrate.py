"""Calibrating by a call: settings, and the typed result that writes itself as a model folder."""

from dataclasses import replace

import pytest
from testing.models import no_type_checker
from testing.simulated_arm import simulate

import pisigma
from pisigma.files.errors import IdentificationError, MeasurementError
from pisigma.measurement.sensors.socket import matching_sockets
from pisigma.model.folder.model_folder import load_model
from pisigma.validation.held_out.calibration_summary import CalibrationSummary
from pisigma.workflow.calibrate import calibrator_of
from pisigma.workflow.settings.calibration import CalibrationSettings, socket_distances

SOCKETS = ("left/0", "left/1", "right/0", "right/1", "right/0", "lonely/0", "")


@pytest.fixture(scope="module")
def measurements():
    return replace(simulate("kiro4", rows=40, noise=5e-5).measurements, source="folder/rows.csv")


@pytest.fixture(scope="module")
def calibration(measurements):
    with no_type_checker():
        settings = CalibrationSettings(model="geometric", folds=2, repeats=1)
        return pisigma.calibrate("kiro4", measurements, settings)


def test_a_calibration_says_everything(calibration):
    printed = calibration.to_json()
    assert printed["seconds"] > 0
    assert printed["rows"] == 40
    assert (
        printed["cross_validation"]["geometric"]["rms_mm"] < printed["cross_validation"]["nominal"]["rms_mm"]
    )
    assert list(printed["warnings"]) == list(calibration.warnings)
    assert calibration.test is None
    assert calibration.held_out.q.shape == (40, 6)
    assert calibration.model.metrics == {name: printed[name] for name in printed if name != "seconds"}


def test_it_writes_a_folder_that_says_the_same(calibration, tmp_path):
    written = calibration.save(tmp_path / "arm")
    model = load_model(tmp_path / "arm")
    assert (model.name, model.metrics) == ("arm", written.metrics)
    assert CalibrationSummary.read(model) == calibration.summary
    call = (
        "pisigma.calibrate('kiro4', 'rows.csv', CalibrationSettings(model='geometric', folds=2, repeats=1))"
    )
    assert f"Made by `{call}`, on 40 rows" in (tmp_path / "arm" / "README.md").read_text()
    calibration.save(tmp_path / "arm", command="pisigma calibrate kiro4 rows.csv", overwrite=True)
    assert CalibrationSummary.read(load_model(tmp_path / "arm")).command == "pisigma calibrate kiro4 rows.csv"


def test_a_file_gives_the_same(calibration, measurements, tmp_path):
    with no_type_checker():
        robot = pisigma.Robot.load("kiro4")
        measurements.write_csv(tmp_path / "rows.csv", robot)
        again = pisigma.calibrate(robot, tmp_path / "rows.csv", calibration.settings)
    assert again.summary.rank == calibration.summary.rank
    assert again.summary.command == calibration.summary.command


def test_metrics_of_an_earlier_version_are_refused(calibration):
    metrics = calibration.model.metrics | {"unseen": []}
    with pytest.raises(pisigma.PisigmaError, match=r"\(unseen: .*run `pisigma upgrade`"):
        CalibrationSummary.read(replace(calibration.model, metrics=metrics))
    assert CalibrationSummary.read(replace(calibration.model, metrics={})) is None


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"model": "hybird"}, "model 'hybird' is unknown; did you mean 'hybrid'?"),
        ({"split": "tim"}, "split 'tim' is unknown; did you mean 'time'?"),
        ({"hold_out": 0.2, "folds": 5}, "folds 5 and hold-out 0.2 exclude each other"),
        ({"folds": 0, "repeats": 2}, "repeats 2: only folds can be repeated"),
        ({"prior_length": 0.0}, "both 0 for none, got 0 mm and 1 mrad"),
        ({"prior_angle": float("nan")}, "got 1 mm and nan mrad"),
        ({"seed": -1}, "got -1 and the usual"),
        ({"repeats": 10**9}, "at most 1,000 repeats were wanted, got 0 and 1000000000"),
    ],
)
@pytest.mark.usefixtures("without_type_checker")
def test_settings_at_fault(settings, complaint):
    with pytest.raises((IdentificationError, MeasurementError), match=complaint):
        CalibrationSettings(**settings)


def distances(*stated: str) -> dict[tuple[str, str], float]:
    """Known distances of the calibrator, as the command line states them."""
    settings = CalibrationSettings(model="geometric", socket_distances=socket_distances(stated))
    matching = matching_sockets(settings.socket_distances, SOCKETS)
    return calibrator_of(settings, pisigma.Robot.load("panda"), matching).socket_distances


def test_known_distances_between_sockets():
    assert distances() == {}
    assert distances("left/0, right/1, 120") == {("left/0", "right/1"): 0.12}
    # a star stands for the same text in both
    assert distances("*/0,*/1,50") == {("left/0", "left/1"): 0.05, ("right/0", "right/1"): 0.05}
    # all stated ones count
    assert distances("left/0,left/1,50", "right/0,right/1,60") == {
        ("left/0", "left/1"): 0.05,
        ("right/0", "right/1"): 0.06,
    }


def test_a_pair_of_sockets_has_one_distance():
    with pytest.raises(IdentificationError, match="one distance of the sockets left/0 and left/1"):
        distances("left/0,left/1,50", "left/0,left/1,60")


@pytest.mark.parametrize(
    "stated", ["", "left/0,left/1", "left/0,left/1,far", "a,b,-1", "a,b,0", "a,b,inf", "a,b,1,2"]
)
def test_another_form_is_refused(stated):
    with pytest.raises(IdentificationError, match="socket distance as A,B,MM"):
        distances(stated)


def test_unknown_names_are_refused_with_those_there_are():
    with pytest.raises(IdentificationError, match=r"'up/0' and 'up/1'; there are left/0, left/1, right/0"):
        distances("up/0,up/1,50")
