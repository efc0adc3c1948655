"""A cell whose files are added one after another: every step that its status names is carried out."""

import pytest
from testing.cell_rows import ROBOT, day, measured
from testing.models import no_type_checker
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.fleet.run import advance_cell


@pytest.fixture(scope="module")
def cell(tmp_path_factory, blank_pictures):
    """A cell with sessions before and after a move of joint 3, which was advanced."""
    folder = tmp_path_factory.mktemp("cells") / "welder7"
    made = Cell.create(folder, "ur10")
    (folder / "cell.yaml").write_text("robot: ur10\ncalibrate:\n  folds: 0\n")
    for ago, rows, zero in ((90, 60, 0.0), (60, 12, 0.0), (30, 12, 0.08), (2, 12, 0.08)):
        measured(rows, ago, zero=zero).write_csv(folder / "sessions" / f"{day(ago)}.csv", ROBOT)
    assert made.status().step.state == "not_taken_in"
    with no_type_checker():
        status = advance_cell(Cell.open(folder))
    assert status.step.state == "up_to_date"
    return Cell.open(folder)


def test_sessions_are_compared_in_the_order_of_their_dates(cell):
    checks = [(one.command, one.session) for one in cell.history.checks() if one.command != "monitor"]
    assert checks == [("calibrate", ""), ("verify", day(60)), ("recalibrate", day(30))]
    first, second = cell.history.models()
    assert (first.sessions, second.sessions) == (day(90), f"{day(90)},{day(30)}")
    assert cell.history.in_use == second
    verdicts = {one.session: one for one in cell.history.checks() if one.command == "monitor"}
    assert (verdicts[day(30)].verdict, verdicts[day(2)].verdict) == ("moved", "unchanged")
    assert verdicts[day(2)].rms_mm < 0.1 < verdicts[day(30)].rms_mm


def test_nothing_is_done_again(cell):
    before = cell.history.checks()
    assert advance_cell(cell).step.state == "up_to_date"
    assert cell.history.checks() == before


def test_a_file_that_cannot_be_used_is_named_until_it_is_corrected(cell):
    path = cell.folder / "sessions" / f"{day(0)}.csv"
    path.write_text("q1_deg\nx\n")
    for _ in range(2):
        with refused(MeasurementError, file=path.name):
            advance_cell(cell)
    assert cell.status().step.state == "file_refused"
    assert [one.session for one in cell.history.checks() if one.command == "import"] == [day(0)]
    path.unlink()
    assert cell.status().step.state == "up_to_date"
