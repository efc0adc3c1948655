"""A cell and its page, shared by the tests of a file."""

import pytest
from testing.cell_rows import day, measured
from testing.hybrid import few_choices, few_robots
from testing.models import no_type_checker
from testing.pages import visitor
from testing.report import HOSTILE

from pisigma.workflow.cell.cell import Cell


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Steps that pages start try few features and robots."""
    with few_choices(), few_robots():
        yield


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """A cell with two sessions, one of them set aside, and hostile texts."""
    with no_type_checker():
        made = Cell.create(tmp_path_factory.mktemp("cells") / "welder7", "ur10", limit_mm=0.5)
        for number, ago in enumerate((20, 10)):
            made.add_session(measured(20, number), day=day(ago))
        made.sessions.set_aside(day(10), HOSTILE)
        made.history.record("firmware", note=HOSTILE)
    return made


@pytest.fixture(scope="module")
def bench(cell):
    from pisigma.workbench.workbench import Workbench  # needs the extra view

    with no_type_checker(), Workbench(cell.folder, port=0) as opened:
        yield opened


@pytest.fixture(scope="module")
def browser_with_link(bench):
    return visitor(bench.url)
