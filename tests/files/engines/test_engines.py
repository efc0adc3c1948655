"""Both engines do the same work, and lose only the item whose worker died."""

import os

import pytest
from testing.engine_work import environment, square

from pisigma.files.engines.processes import ProcessEngine, RayEngine


@pytest.fixture(scope="module")
def ray_engine():
    pytest.importorskip("ray", reason="Ray comes with the extra ray")
    engine = RayEngine(2)
    yield engine
    engine.close()


@pytest.fixture(params=["processes", "ray"])
def engine(request):
    return ProcessEngine(2) if request.param == "processes" else request.getfixturevalue("ray_engine")


def test_every_item_has_its_result(engine):
    assert sorted(engine.results(square, list(range(5)), 2)) == [(k, k * k) for k in range(5)]


def test_only_the_item_that_kills_its_worker_is_lost(engine):
    results = dict(engine.results(square, [1, -1, 2, 3, 4], 2))
    assert results == {-1: None} | {k: k * k for k in range(1, 5)}


def test_workers_are_other_processes_with_one_thread(engine):
    before = dict(os.environ)
    for _, result in engine.results(environment, ["OMP_NUM_THREADS"] * 2, 1):
        assert result is not None
        assert result[0] == "1"
        assert result[1] != os.getpid()
    assert dict(os.environ) == before
