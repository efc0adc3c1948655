"""The column `set`: what is marked as test is never trained on."""

from dataclasses import replace

import pytest
import torch
from testing.models import no_type_checker, trained_run

from pisigma.errors import MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.recipes.recipe import MeasuredData
from pisigma.reporting.training_report import report_training
from pisigma.workflow.run import train_recipe

Q = torch.arange(12, dtype=torch.float64).reshape(6, 2)


def rows(*split: str) -> Measurements:
    return Measurements(q=Q, split=split or None, source="rows.csv")


def test_rows_are_parted_by_the_column():
    train, test = rows("train", "test", "train", "train", "test", "train").split_sets()
    assert train.q[:, 0].tolist() == [0, 4, 6, 10]
    assert test.q[:, 0].tolist() == [2, 8]
    assert set(train.split) == {"train"}
    assert set(test.split) == {"test"}


@pytest.mark.parametrize("split", [(), ("train",) * 6])
def test_without_test_rows_all_are_trained_on(split):
    measurements = rows(*split)
    assert measurements.split_sets() == (measurements, None)


def test_test_rows_alone_are_refused():
    with pytest.raises(MeasurementError, match=r"rows\.csv: column 'set' marks all 6 rows as 'test'"):
        rows(*["test"] * 6).split_sets()


def test_rows_of_the_test_set_change_nothing_that_is_learned():
    recipe, run = trained_run("kiro3")
    measured = recipe.model_copy(update={"data": MeasuredData(kind="measured", folds=2, seed=0)})
    everything = run.measurements
    split = tuple("test" if row % 4 == 0 else "train" for row in range(everything.rows))
    position = everything.position.clone()
    position[::4] += 0.5
    marked = replace(everything, split=split)
    train, test = marked.split_sets()
    with no_type_checker():
        models = [
            train_recipe(measured, data).model for data in (marked, replace(marked, position=position), train)
        ]
        report = report_training(measured, train_recipe(measured, marked), None, test)
    states = [model.network.state_dict() for model in models]
    for name, values in states[0].items():
        assert all(torch.equal(values, other[name]) for other in states[1:])
    assert len({model.provenance.data_sha256 for model in models}) == 1
    assert (report["rows"]["kept_aside"], report["test"]["rows"]) == (25, 25)
    assert report["rows"]["used"] + report["rows"]["left_out"] == 75
    assert report["test"]["corrected"]["rms_mm"] < report["test"]["nominal"]["rms_mm"]
