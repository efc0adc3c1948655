"""`pisigma.calibrate`: settings, and the result, which is written as a model folder."""

import math
from dataclasses import replace

import pytest
from testing.models import no_type_checker
from testing.refusals import refused
from testing.simulated_arm import simulate

import pisigma
from pisigma.files.errors import IdentificationError, MeasurementError
from pisigma.measurement.sensors.socket import expand_socket_names
from pisigma.model.folder.model_folder import load_model
from pisigma.validation.held_out.calibration_summary import CalibrationSummary
from pisigma.workflow.calibrate import calibrator_of
from pisigma.workflow.settings.calibration import CalibrationSettings, parse_socket_distances

SOCKETS = ("left/0", "left/1", "right/0", "right/1", "right/0", "lonely/0", "")


@pytest.fixture(scope="module")
def measurements():
    return replace(simulate("kiro4", rows=40, noise=5e-5).measurements, source="folder/rows.csv")


@pytest.fixture(scope="module")
def calibration(measurements):
    with no_type_checker():
        settings = CalibrationSettings(model="geometric", folds=2, repeats=1)
        return pisigma.calibrate("kiro4", measurements, settings)


def test_a_calibration_has_all_figures(calibration):
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


def test_its_model_folder_has_the_same_figures(calibration, tmp_path):
    written = calibration.save(tmp_path / "arm")
    model = load_model(tmp_path / "arm")
    assert (model.name, model.metrics) == ("arm", written.metrics)
    assert CalibrationSummary.read(model) == calibration.summary
    call = (
        "pisigma.calibrate('kiro4', 'rows.csv', CalibrationSettings(model='geometric', folds=2, repeats=1))"
    )
    assert f"`{call}`" in (tmp_path / "arm" / "README.md").read_text()
    calibration.save(tmp_path / "arm", command="pisigma calibrate kiro4 rows.csv", overwrite=True)
    assert CalibrationSummary.read(load_model(tmp_path / "arm")).command == "pisigma calibrate kiro4 rows.csv"


def test_a_file_gives_the_same_calibration(calibration, measurements, tmp_path):
    with no_type_checker():
        robot = pisigma.Robot.load("kiro4")
        measurements.write_csv(tmp_path / "rows.csv", robot)
        again = pisigma.calibrate(robot, tmp_path / "rows.csv", calibration.settings)
    assert again.summary.rank == calibration.summary.rank
    assert again.summary.command == calibration.summary.command


def test_metrics_of_an_earlier_version_are_refused(calibration):
    metrics = calibration.model.metrics | {"unseen": []}
    with pytest.raises(pisigma.PisigmaError) as caught:
        CalibrationSummary.read(replace(calibration.model, metrics=metrics))
    assert "unseen" in str(caught.value)
    assert "`pisigma upgrade`" in str(caught.value)
    assert CalibrationSummary.read(replace(calibration.model, metrics={})) is None


@pytest.mark.parametrize(
    ("settings", "error", "option", "value"),
    [
        ({"model": "hybird"}, IdentificationError, "model", "hybird"),
        ({"split": "tim"}, MeasurementError, "split", "tim"),
        ({"hold_out": 0.2, "folds": 5}, MeasurementError, "hold_out", 0.2),
        ({"folds": 0, "repeats": 2}, MeasurementError, "repeats", 2),
        ({"prior_length": 0.0}, IdentificationError, "prior_length and prior_angle", (0.0, 1e-3)),
        ({"prior_angle": -1.0}, IdentificationError, "prior_length and prior_angle", (1e-3, -1.0)),
        ({"prior_angle": math.inf}, IdentificationError, "prior_length and prior_angle", (1e-3, math.inf)),
        ({"model": "geometric", "gravity": (0, 0, -1)}, IdentificationError, "gravity", (0, 0, -1)),
        ({"jobs": 0}, MeasurementError, "jobs", 0),
        ({"seed": -1}, MeasurementError, "seed", -1),
        ({"repeats": 10**9}, MeasurementError, "repeats", 10**9),
    ],
)
@pytest.mark.usefixtures("without_type_checker")
def test_settings_out_of_range_are_refused(settings, error, option, value):
    with refused(error, option=option, value=value):
        CalibrationSettings(**settings)


def test_a_prior_that_is_not_a_number_is_refused():
    with refused(IdentificationError, option="prior_length and prior_angle"):
        CalibrationSettings(prior_angle=math.nan)


def distances(*stated: str) -> dict[tuple[str, str], float]:
    """Known distances of the calibrator, as the command line states them."""
    settings = CalibrationSettings(model="geometric", socket_distances=parse_socket_distances(stated))
    matching = expand_socket_names(settings.socket_distances, SOCKETS)
    return calibrator_of(settings, pisigma.Robot.load("panda"), matching).socket_distances


@pytest.mark.parametrize("others", [False, True])
def test_distances_of_one_plate_share_their_error(others):
    """Further entries with one distance each do not make the shared error smaller."""
    plate = {("*/0", "*/1"): 0.05}
    single = {("left/0", "right/1"): 0.4} if others else {}
    settings = CalibrationSettings(socket_distances=plate | single, socket_sigma=1e-4)
    matching = expand_socket_names(settings.socket_distances, SOCKETS)
    calibrator = calibrator_of(settings, pisigma.Robot.load("panda"), matching).geometric_calibrator
    assert calibrator.socket_sigma / len(expand_socket_names(plate, SOCKETS)) ** 0.5 == pytest.approx(1e-4)


def test_known_distances_between_sockets():
    assert distances() == {}
    assert distances("left/0, right/1, 120") == {("left/0", "right/1"): 0.12}
    # an asterisk stands for the same text in both names
    assert distances("*/0,*/1,50") == {("left/0", "left/1"): 0.05, ("right/0", "right/1"): 0.05}
    # all stated distances are used
    assert distances("left/0,left/1,50", "right/0,right/1,60") == {
        ("left/0", "left/1"): 0.05,
        ("right/0", "right/1"): 0.06,
    }


def test_a_pair_of_sockets_has_one_distance():
    with refused(IdentificationError, option="socket_distance", value="left/0,left/1,60"):
        distances("left/0,left/1,50", "left/0,left/1,60")


@pytest.mark.parametrize(
    "stated", ["", "left/0,left/1", "left/0,left/1,far", "a,b,-1", "a,b,0", "a,b,inf", "a,b,1,2"]
)
def test_distances_in_another_form_are_refused(stated):
    with refused(IdentificationError, option="socket_distance", value=stated):
        distances(stated)


def test_unknown_sockets_are_refused_with_the_existing_ones():
    with pytest.raises(IdentificationError) as caught:
        distances("up/0,up/1,50")
    assert all(name in str(caught.value) for name in ("up/0", "up/1", "left/0", "left/1", "right/0"))
