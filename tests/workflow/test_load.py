"""A loaded cell takes over the model in use between two calls, unless it is pinned."""

import gc
import time
import weakref

import numpy as np
import pytest
from testing.cell_models import FIRST, SECOND, cell_of_two_models, put_into_use
from testing.closeness import assert_close
from testing.refusals import refused

import pisigma
from pisigma.files.errors import ModelError
from pisigma.workflow.cell.cell import Cell


@pytest.fixture
def cell(tmp_path, without_type_checker):
    return cell_of_two_models(tmp_path / "cell")


def test_the_next_call_is_answered_by_the_new_model(cell, repository):
    ik, pinned = pisigma.load(cell.folder), pisigma.load(cell.folder, pin=True)
    near = np.full(len(ik.joints), 0.3)
    T, task = ik.forward(near), ik.for_task(tolerance_mm=0.1)
    assert ik(T, near=near).model == ik.path(T[None], near=near).solution.model == FIRST
    assert isinstance(ik, pisigma.CorrectedIK)
    put_into_use(cell, SECOND)
    ik._in_use.load_if_changed()
    near = np.full(len(ik.joints), 0.3)
    T = ik.forward(near)
    solution, alone = ik(T, near=near), pisigma.load(repository / "models" / SECOND)(T, near=near)
    assert (solution.model, ik.name) == (SECOND, SECOND)
    assert_close(solution.q, alone.q)
    assert pinned.name == task.name == FIRST


def test_a_path_that_was_begun_is_answered_by_one_model(cell, monkeypatch):
    ik = pisigma.load(cell.folder)
    near = np.full(len(ik.joints), 0.3)
    T = ik.forward(near)[None]
    path = ik.path
    put_into_use(cell, SECOND)
    ik._in_use.load_if_changed()
    assert path(T, near=near).solution.model == FIRST
    assert ik.name == SECOND


def test_a_damaged_model_is_named_in_warnings_of_the_previous_model(cell):
    ik = pisigma.load(cell.folder)
    path = cell.folder / "models" / SECOND / "model.yaml"
    path.write_text("damaged")
    put_into_use(cell, SECOND)
    ik._in_use.load_if_changed()
    assert ik.name == FIRST
    assert any(SECOND in warning for warning in ik.warnings)


def test_the_thread_does_not_keep_the_object(cell):
    ik = pisigma.load(cell.folder)
    followed = weakref.ref(ik._in_use)
    del ik
    end = time.monotonic() + 10
    while followed() is not None:  # the thread may be looking at it just now
        gc.collect()
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_cell_without_a_model_in_use_is_refused(tmp_path):
    with refused(ModelError, file=tmp_path / "cell"):
        pisigma.load(Cell.create(tmp_path / "cell", "ur10").folder)
