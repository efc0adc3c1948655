"""Mistakes in measured files are stopped and their cause is named; clean files are trusted."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hostile.mistakes import POSES, POSITIONS, SETS, Mistake, answer, clean_rows, unchanged

from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.validation.setup_faults.nominal_robot_faults import find_nominal_robot_faults

pytestmark = pytest.mark.usefixtures("without_type_checker")

FEW = {
    "ur5": ("q5 and q6 swapped", "joint 5 logged constant", "a row lost half-way"),
    "ur10": (
        "sign of q6",
        "reversed Euler order",
        "quaternion wxyz",
        "rotation vector as angles",
        "left-handed frame",
    ),
}
"""One mistake for each class: joint order, log, row order; sign, rotation conventions, handedness."""


@pytest.mark.parametrize(("robot", "name"), [(robot, name) for robot, names in FEW.items() for name in names])
def test_mistakes_are_stopped_with_their_cause(robot, name, shared_data, tmp_path):
    """`python tests/hostile/mistakes.py` runs all 60."""
    _, file, every, mistakes = next(one for one in SETS if one[0] == robot)
    nominal, clean = clean_rows(shared_data, robot, file, every)
    mistake = next(one for one in mistakes if one.name == name)
    got = answer(mistake, nominal, clean, tmp_path)
    assert got.status in (2, 3)
    assert re.search(mistake.words, got.text, re.IGNORECASE), got.text


@pytest.mark.parametrize(
    ("robot", "file"), [("ur5", "grid.csv"), ("ur10", "series_c_train.csv"), ("ur10", "series_b.csv")]
)
def test_clean_files_are_trusted(robot, file, shared_data, tmp_path):
    nominal, clean = clean_rows(shared_data, robot, f"{robot}/{file}", 6)
    assert answer(Mistake("none", unchanged, ""), nominal, clean, tmp_path).status == 0


def fanuc(shared_data: Path) -> tuple[Robot, Measurements]:
    robot = Robot.load("fanuc_r2000")
    rows = Measurements.read_csv(shared_data / "fanuc_r2000" / "positions.csv", robot)
    return robot, rows.select(torch.arange(0, rows.rows, 4))


def test_wrong_target_names_are_found(shared_data, tmp_path):
    """Reflectors under one name are counted, and mislabelled rows are listed with the name that fits."""
    robot, rows = fanuc(shared_data)
    clean = answer(Mistake("none", unchanged, ""), robot, rows, tmp_path)
    assert clean.status == 0
    assert "target" not in clean.text
    (one_name,) = find_nominal_robot_faults(robot, replace(rows, target=()))
    assert (one_name.kinds, one_name.cause_amounts) == (("target",), (3.0,))
    turned = {"A": "B", "B": "C", "C": "A"}
    wrong = tuple(turned[name] if row % 17 == 0 else name for row, name in enumerate(rows.target))
    (mixed,) = find_nominal_robot_faults(robot, replace(rows, target=wrong))
    assert "11 of 180" in mixed.clause
    assert re.search(r"line 2 .*'A'.*'B'", mixed.advice)
    mislabelled = Mistake("", lambda clean, robot: replace(clean, target=wrong), "")
    got = answer(mislabelled, robot, rows, tmp_path)
    assert got.status in (2, 3)
    assert "11 of 180" in got.text


def test_all_mistakes_differ():
    for mistakes in (POSITIONS, POSES):
        assert len({mistake.name for mistake in mistakes}) == 30
        assert torch.tensor([bool(mistake.words) for mistake in mistakes]).all()
