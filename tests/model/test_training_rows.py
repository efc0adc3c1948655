"""Training rows of a model are recognised, all or in part, in any order and among others."""

import math
from dataclasses import replace

import pytest
import torch
from testing.calibrated_ur5 import calibrated_ur5, measured
from testing.refusals import numbers_in, refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.model.stored_starts import MAX_STARTS, count_rows_at_starts, evenly_spaced_rows
from pisigma.model.training_rows import (
    stored_training_rows,
    training_row_mask,
    training_row_warnings,
    without_known_rows,
)

ROWS = 40


@pytest.fixture(scope="module")
def made():
    """A model, its training rows, and as many others."""
    model, q, T = calibrated_ur5(2 * ROWS)
    own, others = (measured(q[part], T[part], False) for part in (slice(ROWS), slice(ROWS, None)))
    provenance = replace(model.provenance, data_sha256=own.content_hash(), rows=ROWS)
    return replace(model, starts=own.q.clone(), provenance=provenance), own, others


def joined(first: Measurements, second: Measurements) -> Measurements:
    return Measurements(torch.cat([first.q, second.q]), torch.cat([first.position, second.position]))


def test_its_own_file_is_recognised_with_certainty(made):
    model, own, others = made
    (certain,) = training_row_warnings(model, own)
    assert model.name in certain
    assert numbers_in(certain.replace(model.name, "")) == []  # all rows, not some of them
    assert training_row_warnings(model, others, own) == (certain,)


def test_parts_of_its_rows_are_recognised_by_joint_values(made):
    model, own, others = made
    backwards = own.select(torch.arange(ROWS - 1, -1, -1))
    cases = [(backwards, ROWS, ROWS), (own.select(torch.arange(10)), 10, 10)]
    cases.append((joined(own.select(torch.arange(3)), others), 3, ROWS + 3))
    for rows, known, count in cases:
        (sentence,) = training_row_warnings(model, rows)
        assert numbers_in(sentence.replace(model.name, "")) == [known, count, ROWS, ROWS]


def test_other_rows_are_not(made):
    model, own, others = made
    assert training_row_warnings(model, others) == ()
    assert training_row_warnings(model, replace(own, q=own.q + 1e-5)) == ()
    unknown = replace(model, provenance=replace(model.provenance, data_sha256=""))
    assert training_row_warnings(replace(unknown, starts=others.q[:0]), own) == ()


def rounded(rows: Measurements) -> Measurements:
    step = math.radians(1e-2)
    return replace(rows, q=(rows.q / step).round() * step, position=(rows.position * 1e5).round() / 1e5)


@pytest.mark.parametrize("change", [lambda rows: rows, rounded], ids=["exact", "rounded"])
def test_repeated_rows_are_recognised_by_their_readings(made, change, tmp_path):
    model, own, others = made
    save_model(replace(model, training_values=stored_training_rows(model.robot, own)), tmp_path)
    model = load_model(tmp_path)
    again = change(own.select(torch.tensor([7, 3, 5, 30])))
    assert training_row_mask(model, again).all()
    mixed = joined(again, change(others))
    assert training_row_mask(model, mixed).nonzero()[:, 0].tolist() == [0, 1, 2, 3]
    new, warnings = without_known_rows(model, mixed)
    assert new.rows == ROWS
    assert len(warnings) == 1
    with refused(MeasurementError, file=again.source, expected="new rows"):
        without_known_rows(model, again)


def test_poses_that_were_measured_again_are_new_rows(made):
    model, own, _ = made
    model = replace(model, training_values=stored_training_rows(model.robot, own))
    later = replace(own, position=own.position + 1e-5 * torch.ones(3))
    assert not training_row_mask(model, later).any()
    assert len(training_row_warnings(model, later)) == 1


def test_half_of_many_rows_are_recognised_by_the_stored_ones(made):
    """Of many rows a model stores some, at even spacing."""
    q = torch.rand(3 * MAX_STARTS, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    half = q[torch.randperm(len(q), generator=torch.Generator().manual_seed(1))[: len(q) // 2]]
    assert 200 < count_rows_at_starts(evenly_spaced_rows(q), half) < 312


def test_rows_that_a_table_rounded_are_recognised(made):
    """Nearly all: a few joint values are at the boundary between rounding up and down."""
    _, own, _ = made
    assert count_rows_at_starts(own.q, (own.q * 1e8).round() / 1e8) > 0.9 * ROWS
