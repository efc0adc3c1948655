"""`pisigma fleet prior` and `pisigma calibrate --prior`."""

import json

import pytest
from testing.fleet_robots import DRAWN, rows_of

pytest.importorskip("pyarrow", reason="Parquet comes with the extra fleet")


@pytest.fixture(scope="module")
def prior(tmp_path_factory, run):
    """A folder with five robots, one with few rows, and the prior of the five."""
    folder = tmp_path_factory.mktemp("prior")
    (folder / "in").mkdir()
    for k in range(5):
        rows_of(k, 30, k).write_csv(folder / "in" / f"r{k}.csv", DRAWN)
    rows_of(50, 10, 1).write_csv(folder / "few.csv", DRAWN)
    made = run("fleet", "prior", folder / "in", "--robot", "rb5", "--out", folder / "prior")
    assert made.exit_code == 0, made.output
    return folder, made


def test_what_the_robots_have_in_common_is_printed_and_kept(prior):
    folder, made = prior
    assert "what 5 robots have in common" in made.stdout
    assert all(len(line) <= 80 for line in made.stdout.splitlines())
    card = (folder / "prior" / "README.md").read_text(encoding="utf-8")
    assert "What 5 robots of the type rb5" in card
    assert "| a_2 | mm |" in card


def test_a_calibration_of_ten_poses_begins_with_it(prior, run):
    folder, _ = prior
    done = run(
        "calibrate", "rb5", folder / "few.csv", "--prior", folder / "prior", "--out", folder / "m", "--json"
    )
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    assert report["kept"] in ("recalibrated", "old")
    assert report["parent"]["kind"] == "fleet_prior"
    assert report["moved"] == []
    assert (folder / "m" / "model.yaml").is_file()


def test_the_prior_of_another_robot_is_refused(prior, run):
    folder, _ = prior
    done = run("calibrate", "ur5", folder / "few.csv", "--prior", folder / "prior", "--out", folder / "x")
    assert done.exit_code == 2
    assert "is of robot 'rb5' and not of 'ur5'" in " ".join(done.output.split())
    assert not (folder / "x").exists()
