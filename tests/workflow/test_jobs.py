"""Work for other processes can be pickled, and gives the same results there."""

import pytest
from testing.engine_work import PicklingEngine
from testing.models import no_type_checker, trained_run
from testing.simulated_arm import simulate

import pisigma
from pisigma.files.engines import processes
from pisigma.files.progress import no_progress, with_stage
from pisigma.workflow.recipes.recipe import MeasuredData
from pisigma.workflow.settings.calibration import CalibrationSettings
from pisigma.workflow.settings.training import TrainSettings


@pytest.fixture
def tasks(monkeypatch):
    """Number of items that were sent to other processes."""
    counted = []
    monkeypatch.setattr(
        processes, "ProcessEngine", lambda jobs: PicklingEngine(jobs, lambda: counted.append(jobs))
    )
    return counted


@pytest.mark.parametrize(
    ("stated", "count"),
    [
        ({"folds": 2, "repeats": 2}, 5),
        ({"folds": 2}, None),
        ({"hold_out": 0.3}, 2),
        ({"folds": 2, "train_rows": 18, "split": "space"}, None),
        ({"folds": 2, "repeats": 1, "model": "hybrid", "features": ("gravity",)}, 3),
    ],
    ids=str,
)
def test_a_calibration_in_processes_gives_the_same(tasks, stated, count):
    rows = simulate("kiro4", rows=40, noise=5e-5).measurements
    settings = {"model": "geometric", **stated}
    with no_type_checker():
        here, there = (
            pisigma.calibrate("kiro4", rows, CalibrationSettings(**settings, jobs=jobs)) for jobs in (None, 2)
        )
    assert here.summary.cross_validation == there.summary.cross_validation
    assert here.summary.training_errors == there.summary.training_errors
    assert len(tasks) == count or count is None
    assert len(tasks) >= 2


def test_a_training_in_processes_gives_the_same(tasks):
    recipe, run = trained_run("kiro4")
    data, fit = MeasuredData(kind="measured", folds=3, seed=0), recipe.fit.model_copy(update={"epochs": 8})
    measured = recipe.model_copy(update={"data": data, "fit": fit})
    with no_type_checker():
        here, there = (
            pisigma.train(measured, run.measurements, TrainSettings(jobs=jobs)) for jobs in (None, 2)
        )
    assert len(tasks) == 3
    assert here.validation == there.validation


def test_stages_of_stages_can_be_sent(tasks):
    nested = with_stage(with_stage(no_progress, "repeat 1 of 2", ", "), "fold 1")
    assert list(PicklingEngine().results(nested, ["calibrating"], 1)) == [("calibrating", None)]
