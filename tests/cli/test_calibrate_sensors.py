"""`pisigma calibrate` with data that no tracker measured."""

import json

import pytest
from testing.models import no_type_checker

from command import write_touches


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


def test_placements_of_a_real_panda_left_out_in_turn(run, shared_data, tmp_path):
    data = shared_data / "panda_sockets" / "panda_3.csv"
    command = ("calibrate", "panda", data, "--split", "placement", "--socket-distance", "*/0,*/1,50")
    result = run(*command, "--model", "geometric", "--out", tmp_path / "arm", "--json")
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)["cross_validation"]
    assert (figures["folds"], figures["rows"], figures["sockets_held_out"]) == (6, 387, 12)
    assert figures["geometric"]["rms_mm"] <= 0.22  # from where the socket's rows meet on average
    assert figures["nominal"]["rms_mm"] == pytest.approx(2.86, abs=0.1)
    assert figures["socket_distance"]["count"] == 6
    assert figures["socket_distance"]["geometric"]["mean_mm"] <= 0.1
    card = (tmp_path / "arm" / "README.md").read_text()
    assert "12 sockets were held out whole" in card
    assert "--split placement" in card
    assert "The known distance of held-out sockets (6 of them) is met to 0.0" in card


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
    assert "pose errors of 192 held-out rows (2 folds)" in result.stdout
    assert "2 frames were held out whole" in result.stdout
    assert "known distance" not in result.stdout


def test_placements_that_are_not_there_are_refused_in_one_line(run, shared_data, tmp_path):
    data = shared_data / "ur5" / "grid.csv"
    result = run(
        "calibrate", "ur5", data, "--out", tmp_path / "arm", "--model", "geometric", "--split", "placement"
    )
    assert result.exit_code == 2
    assert "two placements or more were wanted" in result.stderr
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
    assert "did you mean 'placement'" in result.stderr


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
        "--socket-distance",
        "a,b,50",
    )
    assert result.exit_code == 2
    assert "no two sockets of the data are called 'a' and 'b'" in result.stderr
    assert not (tmp_path / "arm").exists()
