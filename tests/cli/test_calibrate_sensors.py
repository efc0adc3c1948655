"""`pisigma calibrate` with data that no tracker measured."""

import json


def test_touches_on_jigs(run, repository, tmp_path):
    touches = tmp_path / "touches.csv"
    assert run("simulate", repository / "training" / "jigs.yaml", "--out", touches).exit_code == 0
    result = run("calibrate", "welding", touches, "--out", tmp_path / "arm", "--folds", 2, "--json")
    assert result.exit_code == 0, result.output
    printed = json.loads(result.stdout)
    assert [noise["sensor"] for noise in printed["noise"]] == ["touch"]
    figures = printed["cross_validation"]
    assert figures["rows"] == 192
    assert figures["geometric"]["rms_mm"] < 0.3 < 1.0 < figures["nominal"]["rms_mm"]  # touch noise is 0.2 mm


def test_balls_in_sockets_of_a_real_panda(run, shared_data, tmp_path):
    data = shared_data / "panda_sockets" / "panda_3.csv"
    command = (
        "calibrate",
        "panda",
        data,
        "--out",
        tmp_path / "arm",
        "--socket-distance",
        "*/0,*/1,50",
        "--json",
    )
    result = run(*command, "--folds", 3)
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)["cross_validation"]
    assert figures["geometric"]["rms_mm"] < 0.24
    assert figures["nominal"]["rms_mm"] > 2


def test_unknown_sockets_are_refused_in_one_line(run, shared_data, tmp_path):
    data = shared_data / "panda_sockets" / "panda_3.csv"
    result = run("calibrate", "panda", data, "--out", tmp_path / "arm", "--socket-distance", "a,b,50")
    assert result.exit_code == 2
    assert "no two sockets of the data are called 'a' and 'b'" in result.stderr
    assert not (tmp_path / "arm").exists()
