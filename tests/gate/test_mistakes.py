"""The common check of all commands notices mistakes in rows; a mistake of every kind goes through every command.

`python tests/gate/run.py mistakes` runs every command with all forty.
"""

import pytest
from gate.agreement import disagreements
from gate.commands import COMMANDS
from gate.table import MISTAKES, MOVES, Mistake, filtered_rows
from testing.aged import original_model
from testing.hybrid import few_choices, few_robots

from pisigma.validation.checks import check as row_check
from pisigma.validation.gate import check_rows

pytestmark = pytest.mark.usefixtures("without_type_checker", "quick", "blank_pictures")

EVERYWHERE = {
    "lengths x 1.001": COMMANDS,
    "sign of q5": list(COMMANDS)[::2],
    "half in inches": list(COMMANDS)[::2],
    "metres named mm": list(COMMANDS)[1::2],
    "tracker moved by 2 mm half-way": list(COMMANDS)[1::2],
}
"""Commands by mistake: each of them for a scale that siblings could judge apart, a setup fault, and mixed rows."""
ALIKE = {
    "mm named m",
    "feet named mm",
    "radians named degrees",
    "sign of q2",
    "sign of q3",
    "sign of q4",
    "q2 and q3 swapped",
    "q5 and q6 swapped",
    "two robots, one after the other",
    "half mirrored",
    "tracker carried by 100 mm half-way",
    "lengths x 0.999",
    "lengths x 1.01",
    "rows of a UR10",
}
"""Mistakes that another one of the table resembles: the same unit, joints or mixture with other numbers."""


@pytest.fixture(scope="module")
def quick():
    with few_choices(), few_robots():
        yield


@pytest.mark.parametrize(
    "mistake", [one for one in MISTAKES if one.name not in ALIKE], ids=lambda one: one.name
)
def test_the_check_notices(mistake):
    found = check_rows(
        mistake.change(filtered_rows()), original_model(), allowed_moves=row_check.MOVES
    ).implausible_findings
    assert found
    assert "*" in mistake.kinds or found[0].kind in mistake.kinds, found[0].sentence


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_valid_rows_are_trusted(seed):
    assert check_rows(filtered_rows(seed), original_model()).diagnostics == ()


@pytest.mark.parametrize("move", MOVES, ids=lambda one: one.name)
def test_moves_of_any_size_are_not_mistakes(move):
    rows = move.change(filtered_rows())
    assert check_rows(rows, original_model(), allowed_moves=row_check.MOVES).trusted
    assert not check_rows(rows, original_model()).trusted


def test_wrong_rows_are_named():
    (mistake,) = (one for one in MISTAKES if one.name == "tracker moved by 2 mm half-way")
    (found,) = check_rows(mistake.change(filtered_rows()), original_model()).implausible_findings
    assert found.row_places == tuple(f"rows.csv, line {line}" for line in range(10, 18))


@pytest.mark.parametrize("name", EVERYWHERE)
def test_commands_agree(name, tmp_path):
    (mistake,) = (one for one in MISTAKES if one.name == name)
    assert disagreements(mistake, tmp_path, EVERYWHERE[name]) == []


def test_every_command_accepts_right_rows(tmp_path):
    assert disagreements(Mistake("none", lambda rows: rows, ()), tmp_path) == []
    assert len(COMMANDS) == 10
