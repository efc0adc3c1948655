"""Two processes that work on one cell lose nothing and store nothing twice."""

import multiprocessing
import sys

import pytest
from testing.cell_rows import ROBOT, day, measured
from testing.models import no_type_checker
from testing.pictures import no_pictures

from pisigma.files.errors import MeasurementError, OutputError
from pisigma.model.folder.model_folder import load_model
from pisigma.workflow.cell.cell import Cell


def _work(folder, number, start, refusals):
    with no_type_checker(), no_pictures():
        cell, both = Cell.open(folder), folder.parent / "both.csv"
        mine = measured(12, 10 + number)
        start.wait()
        try:
            cell.add_session(both, day=day(9))
        except MeasurementError:
            refusals.put(number)
        cell.add_session(mine, day=day(8))
        start.wait()
        cell.calibrate(folds=0)
        start.wait()
        cell.plan(count=4, check=0, candidates=50)


def test_two_processes_work_on_one_cell(tmp_path):
    cell = Cell.create(tmp_path / "cell", "ur10")
    measured(40, 1).write_csv(tmp_path / "both.csv", ROBOT)
    context = multiprocessing.get_context("fork")
    start, refusals = context.Barrier(2), context.Queue()
    workers = [
        context.Process(target=_work, args=(cell.folder, number, start, refusals)) for number in (0, 1)
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(120)
    assert [worker.exitcode for worker in workers] == [0, 0]
    assert refusals.get() in (0, 1)
    assert refusals.empty()
    assert sorted(one.rows for one in cell.history.sessions()) == [12, 12, 40]
    assert cell.status().facts.unrecorded_files == cell.status().facts.edited_sessions == ()
    assert len(list((cell.folder / "plans").glob("*.csv"))) == 2
    assert len({one.name for one in cell.history.models()}) == 2
    for one in cell.history.models():
        load_model(cell.model_folder(one.name))


@pytest.mark.skipif(sys.platform == "win32", reason="there are no limits of the size of files")
def test_rows_that_do_not_fit_on_the_disk_are_refused_and_nothing_is_lost(tmp_path):
    import resource

    cell = Cell.create(tmp_path / "cell", "ur10")
    first = cell.add_session(measured(12, 1), day=day(9))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000, limits[1]))
    try:
        with pytest.raises(OutputError):
            cell.add_session(measured(12, 2), day=day(8))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert cell.history.sessions() == (first,)
    assert cell.status().facts.unrecorded_files == ()
    cell.add_session(measured(12, 2), day=day(8))
