"""Rows count once: a model is never verified or recalibrated with rows that it was fitted to."""

from dataclasses import replace

import pytest
import torch
from testing.cell_rows import ROBOT, day, measured
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import join
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.cell.new_cell import NewCell, cell_from_model

pytestmark = pytest.mark.usefixtures("quick_pictures")

NEW = measured(10, 5)


@pytest.mark.parametrize("known", [measured(60, 1), measured(12, 2), measured(12, 2).select(torch.arange(2))])
def test_a_file_that_grew_is_refused_until_the_known_rows_are_removed(known, cell, tmp_path):
    known.write_csv(tmp_path / "known.csv", ROBOT)
    NEW.write_csv(tmp_path / "new.csv", ROBOT)
    head, *rows = (tmp_path / "known.csv").read_text().splitlines()
    new = (tmp_path / "new.csv").read_text().splitlines()
    assert new[0] == head
    (tmp_path / "grown.csv").write_text("\n".join([head, *rows, *new[1:], ""]))
    before = cell.history.sessions()
    with refused(MeasurementError, file=tmp_path / "grown.csv"):
        cell.add_session(tmp_path / "grown.csv")
    assert cell.history.sessions() == before
    assert cell.add_session(tmp_path / "new.csv").rows == NEW.rows


def test_no_rows_are_refused(cell):
    with refused(MeasurementError):
        cell.add_session(NEW.select(torch.arange(0)))


def test_rows_of_a_model_from_outside_of_the_cell_are_refused_with_others(used, tmp_path):
    cell_from_model(used.model_folder(), NewCell("")).write(tmp_path / "other")
    other, fitted = Cell.open(tmp_path / "other"), measured(60, 1)
    with refused(MeasurementError):
        other.add_session(join([fitted, NEW]))
    session = other.add_session(fitted, day=day(60))
    assert other.history.in_use.made_of == (session.name,)


def test_a_session_that_is_not_new_to_the_model_is_refused_by_its_name(cell):
    cell.add_session(measured(12, 6), day=day(40))
    cell.add_session(measured(12, 7), day=day(20))
    model, _ = cell.recalibrate(session=day(30))
    assert model.trusted
    for step in (cell.verify, cell.recalibrate):
        for name in (day(60), day(40)):
            with refused(MeasurementError, value=name):
                step(session=name)


def test_a_session_has_the_first_of_its_stated_days(cell):
    some = replace(NEW, date=("", day(9), *8 * (day(8),)))
    with refused(MeasurementError, option="--date", value=day(1)):
        cell.add_session(some, day=day(1))
    assert cell.add_session(some).day == day(9)


def test_the_cell_is_recalibrated_and_not_the_folder_of_its_model(cell):
    cell.add_session(measured(12, 8, zero=0.2), day=day(3))
    found = cell.monitor()
    advice = [line for line in found.sentences if "pisigma recalibrate" in line]
    assert len(advice) == 1
    assert f"`pisigma recalibrate {cell.folder}`" in advice[0]


@pytest.mark.parametrize(("poses", "state"), [(2, "session_incomplete"), (10, "session_not_judged")])
def test_poses_that_were_measured_several_times_count_once(poses, state, cell):
    cell.plan()
    one, again = measured(poses, 9), torch.linspace(1e-5, 5e-5, 5)
    entry = cell.add_session(
        join([replace(one, position=one.position + shift) for shift in again]), day=day(1)
    )
    assert (entry.rows, entry.poses) == (5 * poses, poses)
    assert cell.status().step.state == state
