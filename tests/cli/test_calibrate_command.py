"""`pisigma calibrate` with geometric calibrations, and `evaluate` of what it writes."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from testing.closeness import assert_close
from testing.models import no_type_checker
from testing.refusals import problem_of
from testing.screens import assert_screen
from testing.simulated_arm import simulate

import pisigma
from pisigma.cli.screen import print_result
from pisigma.files.errors import (
    AcceptanceError,
    IdentificationError,
    MeasurementError,
    SettingError,
    UnknownRobotError,
)
from pisigma.model.folder.model_folder import load_model
from pisigma.reporting.calibration_text import calibration_text
from pisigma.reporting.verdict import rounded_text
from pisigma.robot.kinematics.status import Status
from pisigma.validation.held_out.calibration_summary import CalibrationSummary, ScaleFigures

POSITION = {"rms_mm", "mean_mm", "p95_mm", "max_mm"}
POSE = POSITION | {name.replace("mm", "deg") for name in POSITION}
FILES = {"README.md", "compiled.npz", "correlation.png", "model.safetensors", "model.yaml", "parameters.csv"}
FILES |= {"held_out_errors.png", "residuals.png"}
FILES |= {"correlation.csv", "held_out.csv"}


def write(path, measurements, split=None):
    """Write rows, with a column `set` where one is given, and give the path."""
    with no_type_checker():
        replace(measurements, split=split).write_csv(path, revolute=[True] * measurements.dof)
    return path


@pytest.fixture(scope="module")
def poses():
    with no_type_checker():
        return simulate("kiro4", rows=60, noise=5e-5, turn_noise=1e-4)


@pytest.fixture(scope="module")
def data(poses, tmp_path_factory):
    return write(tmp_path_factory.mktemp("data") / "poses.csv", poses.measurements)


@pytest.fixture(scope="module")
def calibrated(run, data, tmp_path_factory):
    """The folder of a calibration and what it printed."""
    folder = tmp_path_factory.mktemp("calibrated") / "arm"
    result = run(
        "calibrate",
        "kiro4",
        data,
        "--out",
        folder,
        "--model",
        "geometric",
        "--folds",
        3,
        "--set",
        "class=hobby",
        "--set",
        "repeats=2",
        "--json",
    )
    assert result.exit_code == 0, result.output
    assert result.stdout.count("\n") == 1
    return folder, json.loads(result.stdout)


def test_json_has_the_agreed_shape(calibrated):
    folder, printed = calibrated
    assert printed["model"] == str(folder)
    assert printed["seconds"] > 0
    assert printed["rank"] == 30  # 4R + 2P + 6 of a 6R arm whose poses are measured
    names = {"name", "unit", "nominal", "estimated", "change", "standard_error", "remark", "label"}
    assert all(set(row) == names for row in printed["parameters"])
    assert [row["name"] for row in printed["parameters"]][:2] == ["theta_1", "d_1"]
    assert printed["outliers"] == []
    validation = printed["cross_validation"]
    assert (validation["folds"], validation["rows"]) == (3, 60)
    assert set(validation["nominal"]) == set(validation["geometric"]) == POSE
    assert validation["geometric"]["rms_mm"] < validation["nominal"]["rms_mm"] / 3
    assert validation["repeats"] == 2
    for name, rms in validation["rms_mm_of_repeats"].items():
        assert_close(np.sqrt(np.square(rms).mean()), validation[name]["rms_mm"], rtol=1e-12)
        assert len(set(rms)) == 2
    assert "test" not in printed


def test_the_folder_is_whole_and_loads(calibrated, poses):
    folder, printed = calibrated
    assert {entry.name for entry in folder.iterdir()} == FILES
    assert load_model(folder).metrics["rank"] == printed["rank"]
    ik = pisigma.load(folder)
    with no_type_checker():
        T = ik.model.forward(poses.measurements.q)
        solution = ik(T, near=poses.measurements.q)
        again = ik.model.forward(solution.q)
    reached = solution.status == Status.REACHED
    assert int(reached.sum()) > 50
    assert_close(again[reached], T[reached], atol=1e-9)


def test_the_card_states_all_results(calibrated):
    folder, printed = calibrated
    card = (folder / "README.md").read_text()
    assert card.startswith("# arm\n\nGeometric calibration of robot kiro4 (")
    assert (
        "`pisigma calibrate kiro4 poses.csv --out arm --model geometric --folds 3 --set class=hobby --set repeats=2`"
        in card
    )
    assert "60 rows of `poses.csv`" in card
    assert "3-fold cross-validation, 2 repeats: each of 60 rows" in card
    assert f"{printed['cross_validation']['geometric']['rms_mm']:.4f}" in card
    for row in printed["parameters"]:
        assert f"| {row['name']} | {row['unit']} |" in card
    for sentence in printed["redundancy"]["dependencies"]:
        assert f"- {sentence}." in card
    assert load_model(folder).provenance.data_sha256 in card
    lines = (folder / "parameters.csv").read_text().splitlines()
    assert len(lines) == len(printed["parameters"]) + 1


def test_people_read_the_verdict_first_and_everything_on_demand(capsys, calibrated):
    folder, printed = calibrated
    summary = CalibrationSummary.read(load_model(folder))
    errors = printed["cross_validation"]["geometric"]
    rms, p95 = rounded_text(errors["rms_mm"], 60), rounded_text(errors["p95_mm"], 60)
    figures = f"{rms} mm", p95, "3-fold", "60 rows"
    print_result(calibration_text(summary, folder, 1.0), verbose=False)
    text = capsys.readouterr().out
    assert_screen(text, *figures, "--verbose", str(folder))
    assert "theta_6" not in text
    print_result(calibration_text(summary, folder, 1.0), verbose=True)
    whole = capsys.readouterr().out
    assert_screen(whole, *figures, "theta_6", "in a sum", "Rank 30, ", verbose=True)
    for dependency in printed["redundancy"]["dependencies"]:
        assert dependency.split()[0] in whole


def test_a_wrong_scale_of_the_sensor_is_a_warning_where_it_matters(capsys, calibrated):
    folder, printed = calibrated
    summary = CalibrationSummary.read(load_model(folder))
    rms = printed["cross_validation"]["geometric"]["rms_mm"]
    for odds, share, is_warning, is_said in (
        (3.0, 2.0, True, True),
        (0.3, 2.0, False, True),
        (0.01, 2.0, False, False),
        (3.0, 0.1, False, False),
    ):
        scale = ScaleFigures(factor=1.00123, sigma=0.0002, odds=odds, rms_mm_if_sensor_error=share * rms)
        with no_type_checker():
            print_result(calibration_text(summary.with_figures(scale=scale), folder, 1.0), verbose=False)
        text = " ".join(capsys.readouterr().out.split())
        assert ("1.00123 +- 0.00020" in text) == is_said
        assert (text.count("Warning: ") > len(summary.warnings)) == is_warning
        assert (f"{odds:g} to 1" in text) == is_said


@pytest.mark.parametrize("split", ["joints", "time"])
def test_a_share_is_held_out_instead(run, data, tmp_path, split):
    command = ("calibrate", "kiro4", data, "--out", tmp_path / "arm", "--model", "geometric")
    arguments = (*command, "--set", "hold_out=0.25", "--split", split)
    validation = json.loads(run(*arguments, "--json").stdout)["cross_validation"]
    assert (validation["folds"], validation["rows"]) == (1, 15)
    assert "15 rows" in (tmp_path / "arm" / "README.md").read_text()


def test_no_folds_no_cross_validation(run, data, tmp_path):
    printed = json.loads(
        run(
            "calibrate",
            "kiro4",
            data,
            "--out",
            tmp_path / "arm",
            "--model",
            "geometric",
            "--folds",
            0,
            "--json",
        ).stdout
    )
    assert "cross_validation" not in printed
    assert "Held-out" not in (tmp_path / "arm" / "README.md").read_text()


def test_rows_of_the_test_set_are_kept_aside(run, refuses, poses, calibrated, tmp_path):
    rows = poses.measurements
    sets = tuple("test" if row % 3 == 0 else "train" for row in range(60))
    position = rows.position.clone()
    position[::3] += 1.0  # a metre: nobody who looks at these rows overlooks it
    path = write(tmp_path / "sets.csv", replace(rows, position=position), sets)
    printed = json.loads(
        run(
            "calibrate",
            "kiro4",
            path,
            "--out",
            tmp_path / "arm",
            "--model",
            "geometric",
            "--folds",
            2,
            "--json",
        ).stdout
    )
    assert (printed["rows"], printed["test"]["rows"], printed["cross_validation"]["rows"]) == (40, 20, 40)
    assert set(printed["test"]["geometric"]) == POSE
    assert printed["test"]["geometric"]["rms_mm"] > 1700
    assert printed["cross_validation"]["geometric"]["rms_mm"] < 1
    assert printed["outliers"] == []
    assert "## Pose errors of the test set" in (tmp_path / "arm" / "README.md").read_text()
    judged = json.loads(run("evaluate", tmp_path / "arm", path, "--json").stdout)
    assert judged["rows"] == 20
    assert_close(judged["corrected"]["rms_mm"], printed["test"]["geometric"]["rms_mm"], rtol=1e-9)
    alone = write(tmp_path / "alone.csv", rows, ("test",) * 60)
    refuses(
        "calibrate",
        "kiro4",
        alone,
        "--out",
        tmp_path / "other",
        error=MeasurementError,
        file="alone.csv",
        column="set",
        value="test",
    )


@pytest.mark.parametrize(
    ("arguments", "error", "value"),
    [
        (("--split", "tim"), MeasurementError, "tim"),
        (("--folds", "1"), MeasurementError, 1),
        (("--set", "hold_out=2"), MeasurementError, 2.0),
        (("--set", "hold_out=0.2", "--set", "repeats=2"), MeasurementError, 2),
        (("--set", "hold_out=0.2", "--folds", "5"), MeasurementError, 0.2),
        (("--split", "time", "--set", "repeats=2"), MeasurementError, 2),
        (("--set", "prior_mm=0"), IdentificationError, (0.0, 0.001)),
        (("--set", "gravity=0,1"), IdentificationError, "0,1"),
        (("--set", "gravity=0,0,-1"), IdentificationError, (0.0, 0.0, -1.0)),
        (("--set", "new_frame_at=500"), MeasurementError, 500),
    ],
)
def test_options_at_fault(refuses, data, tmp_path, arguments, error, value):
    command = ("calibrate", "kiro4", data, "--out", tmp_path / "arm", "--model", "geometric", *arguments)
    refuses(*command, error=error, value=value)
    assert not (tmp_path / "arm").exists()


def test_parameters_and_priors_at_fault(refuses, data, tmp_path):
    command = ("calibrate", "kiro4", data, "--out", tmp_path / "arm", "--model", "geometric")
    assert "'a_9'" in refuses(*command, "--set", "free=a_9", error=IdentificationError)
    for value in ("nan", "inf"):
        refuses(*command, "--set", f"prior_mm={value}", error=SettingError, option="prior_mm")
    assert not (tmp_path / "arm").exists()


def test_a_new_frame_at_a_line(run, data, tmp_path):
    command = ("calibrate", "kiro4", data, "--out", tmp_path / "arm", "--model", "geometric", "--folds", 0)
    result = run(*command, "--set", "new_frame_at=20", "--set", "new_frame_at=40")
    assert result.exit_code == 0, result.output
    card = (tmp_path / "arm" / "README.md").read_text()
    assert "--folds 0 --set new_frame_at=20 --set new_frame_at=40`" in card
    assert "base_from line 40_x" in card


def test_robots_and_files_at_fault(refuses, data, tmp_path):
    refuses("calibrate", "kiro44", data, "--out", tmp_path / "arm", error=UnknownRobotError)
    refuses(
        "calibrate",
        "kiro4",
        tmp_path / "no.csv",
        "--out",
        tmp_path / "arm",
        error=MeasurementError,
        file="no.csv",
    )
    refuses(
        "calibrate",
        "panda",
        data,
        "--out",
        tmp_path / "arm",
        error=MeasurementError,
        file="poses.csv",
        line=1,
        column="q6_deg",
        value=6,
    )


def test_an_implausible_calibration_is_written_on_demand_only(run, tmp_path):
    """A UR10 that was taken for a UR5: figures and reasons are printed, and the card says it."""
    with no_type_checker():
        rows = write(tmp_path / "ur10.csv", simulate("ur10", rows=40, noise=5e-5).measurements)
    command = ["calibrate", "ur5", rows, "--out", tmp_path / "arm", "--model", "geometric", "--folds", 0]
    result = run(*command, "--json")
    assert (result.exit_code, (tmp_path / "arm").exists()) == (3, False)
    printed = json.loads(result.stdout)
    (worst, *_) = printed["diagnostics"]
    assert (printed["model"], worst["severity"]) == (None, "implausible")
    assert isinstance(problem_of(result), AcceptanceError)
    result = run(*command)
    assert result.exit_code == 3
    assert_screen(result.stdout, "Trust: no: ", "40 rows")
    assert str(tmp_path / "arm") not in result.stdout
    accepted = run(*command, "--accept-implausible")
    assert accepted.exit_code == 0, accepted.output
    card = (tmp_path / "arm" / "README.md").read_text()
    assert "## Implausible" in card
    assert worst["sentence"] in card
    assert load_model(tmp_path / "arm").metrics["diagnostics"] == printed["diagnostics"]


def test_names_that_are_no_text_do_not_matter(run, data, tmp_path):
    """File names of an old system, which are no UTF-8, and one that would colour the terminal."""
    rows, folder = tmp_path / "m\udcff\x1b[31m.csv", tmp_path / "\udcfe"
    shutil.copy(data, rows)
    result = run("calibrate", "kiro4", rows, "--model", "geometric", "--folds", 2, "--out", folder)
    assert result.exit_code == 0, result.output
    assert "\\udcfe" in result.stdout
    model = load_model(folder)
    assert (model.name, model.provenance.data_source) == ("\\udcfe", "m\\udcff\\x1b[31m.csv")
    assert run("report", folder, rows, "--out", tmp_path / "\udcfd.html").exit_code == 0
