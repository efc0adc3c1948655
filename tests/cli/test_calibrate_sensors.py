"""`pisigma calibrate` with data that no tracker measured."""

import json

import pytest
from testing.models import no_type_checker
from testing.refusals import assert_fields, problem_of
from testing.screens import assert_screen

from command import write_touches
from pisigma.files.errors import IdentificationError


@pytest.fixture(scope="module")
def touches(repository, tmp_path_factory):
    """Simulated touches of a welding robot on two jigs."""
    file = tmp_path_factory.mktemp("touches") / "touches.csv"
    with no_type_checker():
        write_touches(repository / "training", file)
    return file


def test_touches_on_jigs(run, touches, tmp_path):
    result = run(
        "calibrate",
        "welding",
        touches,
        "--out",
        tmp_path / "arm",
        "--model",
        "geometric",
        "--folds",
        2,
        "--json",
    )
    assert result.exit_code == 0, result.output
    printed = json.loads(result.stdout)
    assert [noise["sensor"] for noise in printed["noise"]] == ["touch"]
    figures = printed["cross_validation"]
    assert figures["rows"] == 192
    assert figures["geometric"]["rms_mm"] < 0.3 < 1.0 < figures["nominal"]["rms_mm"]  # touch noise is 0.2 mm


def test_placements_of_a_real_panda_held_out_once(run, shared_data, tmp_path):
    data = shared_data / "panda_sockets" / "panda_3.csv"
    command = ("calibrate", "panda", data, "--split", "placement", "--set", "socket_distance=*/0,*/1,50")
    result = run(*command, "--model", "geometric", "--out", tmp_path / "arm", "--json")
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)["cross_validation"]
    assert (figures["folds"], figures["rows"], figures["sockets_held_out"]) == (6, 387, 12)
    assert figures["geometric"]["rms_mm"] <= 0.22  # from where the socket's rows meet on average
    assert figures["nominal"]["rms_mm"] == pytest.approx(2.86, abs=0.1)
    assert figures["socket_distance"]["count"] == 6
    assert figures["socket_distance"]["geometric"]["mean_mm"] <= 0.1
    card = (tmp_path / "arm" / "README.md").read_text()
    assert "12 sockets" in card
    assert "--split placement" in card
    assert "| backcenter/0 to backcenter/1" in card


def test_jigs_held_out_in_turn(run, touches, tmp_path):
    result = run(
        "calibrate",
        "welding",
        touches,
        "--out",
        tmp_path / "arm",
        "--model",
        "geometric",
        "--split",
        "placement",
    )
    assert result.exit_code == 0, result.output
    assert_screen(result.stdout, "2-fold", "192 rows")
    assert "distance" not in result.stdout


def test_missing_placements_are_refused_in_one_line(run, shared_data, tmp_path):
    data = shared_data / "ur5" / "grid.csv"
    result = run(
        "calibrate", "ur5", data, "--out", tmp_path / "arm", "--model", "geometric", "--split", "placement"
    )
    assert result.exit_code == 2
    assert_fields(problem_of(result), file=data)
    panda = shared_data / "panda_sockets" / "panda_3.csv"
    result = run(
        "calibrate",
        "panda",
        panda,
        "--out",
        tmp_path / "arm",
        "--model",
        "geometric",
        "--split",
        "placements",
    )
    assert result.exit_code == 2
    assert_fields(problem_of(result), value="placements")


def test_unknown_sockets_are_refused_in_one_line(run, shared_data, tmp_path):
    data = shared_data / "panda_sockets" / "panda_3.csv"
    result = run(
        "calibrate",
        "panda",
        data,
        "--out",
        tmp_path / "arm",
        "--model",
        "geometric",
        "--set",
        "socket_distance=a,b,50",
    )
    assert result.exit_code == 2
    assert isinstance(problem_of(result), IdentificationError)
    assert "backcenter/0" in result.stderr
    assert not (tmp_path / "arm").exists()


def test_every_stated_distance_of_sockets_counts(run, shared_data, tmp_path):
    data = shared_data / "panda_sockets" / "panda_3.csv"
    command = (
        "calibrate",
        "panda",
        data,
        "--model",
        "geometric",
        "--folds",
        "0",
        "--out",
        tmp_path / "arm",
        "--json",
    )
    known = ("--set", "socket_distance=backcenter/0,backcenter/1,50")
    result = run(*command, *known, "--set", "socket_distance=backleft/0,backleft/1,50.1")
    assert result.exit_code in (0, 3), result.output
    command_of = json.loads(result.stdout)["command"]
    assert "('backcenter/0', 'backcenter/1'): 0.05" in command_of
    assert "('backleft/0', 'backleft/1'): 0.0501" in command_of
    assert run(*command, *known, "--set", "socket_distance=backcenter/1,backcenter/0,51").exit_code == 2
    assert run(*command, *known, *known).exit_code == 2


def test_plates_held_out_of_a_real_arm_are_judged_by_every_stated_distance(run, shared_data, tmp_path):
    folder = shared_data / "holiday"
    stated = [
        "A/0,A/1,39.90",
        "A/1,A/2,39.92",
        "B/0,B/1,39.97",
        "B/1,B/2,40.00",
        "C/0,C/1,39.93",
        "C/1,C/2,39.96",
    ]
    command = ["calibrate", folder / "fr3.urdf", folder / "fr3_sockets.csv", "--tip", "ball_link", "--json"]
    command += ["--model", "geometric", "--out", tmp_path / "arm"]
    command += [word for one in stated for word in ("--set", f"socket_distance={one}")]
    for split in (("--folds", 2), ("--split", "placement")):
        result = run(*command, *split, "--overwrite")
        assert result.exit_code == 0, result.output
        figures = json.loads(result.stdout)["cross_validation"]
        assert {tuple(one["sockets"]) for one in figures["socket_distance"]["each"]} == {
            tuple(one.split(",")[:2]) for one in stated
        }
        mean = {name: figures["socket_distance"][name]["mean_mm"] for name in ("nominal", "geometric")}
        assert mean["geometric"] < 0.15 < 0.35 < mean["nominal"]
        assert figures["geometric"]["rms_mm"] < 0.45 < 1.3 < figures["nominal"]["rms_mm"]


def test_a_plate_of_a_real_arm_is_evaluated_and_verified_by_a_calibration_on_the_others(
    run, shared_data, tmp_path
):
    folder = shared_data / "holiday"
    head, *lines = (folder / "fr3_sockets.csv").read_text().splitlines()
    for name, plates in (("two", "AB"), ("third", "C")):
        rows = [line for line in lines if line.rsplit(",", 1)[1][0] in plates]
        (tmp_path / f"{name}.csv").write_text("\n".join([head, *rows]) + "\n")
    stated = ("A/0,A/1,39.90", "A/1,A/2,39.92", "B/0,B/1,39.97", "B/1,B/2,40.00")
    command = [
        "calibrate",
        folder / "fr3.urdf",
        tmp_path / "two.csv",
        "--tip",
        "ball_link",
        "--model",
        "geometric",
    ]
    command += [word for one in stated for word in ("--set", f"socket_distance={one}")]
    assert run(*command, "--folds", "0", "--out", tmp_path / "arm").exit_code == 0
    third = ("--set", "socket_distance=C/0,C/1,39.93", "--set", "socket_distance=C/1,C/2,39.96", "--json")
    result = run("evaluate", tmp_path / "arm", tmp_path / "third.csv", *third)
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["corrected"]["rms_mm"] < 0.4 < 0.9 < found["nominal"]["rms_mm"]
    each = found["socket_distance"]["each"]
    assert [one["sockets"] for one in each] == [["C/0", "C/1"], ["C/1", "C/2"]]
    assert max(abs(one["errors_mm"]["arm"]) for one in each) < 0.15
    result = run("verify", tmp_path / "arm", tmp_path / "third.csv", *third)
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["verdict"] == "better"
    wrong = ("--set", "socket_distance=C/0,C/1,45")
    assert run("evaluate", tmp_path / "arm", tmp_path / "third.csv", *wrong).exit_code == 3
    assert run("verify", tmp_path / "arm", tmp_path / "third.csv", *wrong).exit_code == 3
