"""Nominal, geometric and hybrid calibration on the same held-out rows, and what the hybrid says of itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.hybrid import NOISE, hybrid_of
from testing.sensors import socket_data
from testing.sensors import true_robot as true_arm

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.measurement.splits import holdout, k_folds
from pisigma.robot import Robot
from pisigma.validation.held_out.calibration_validation import judge, learning_curve, validate
from pisigma.validation.held_out.pose_statistics import (
    ErrorsWithPredictedSigma,
    PoseErrors,
    errors_with_predicted_sigma,
)
from pisigma.validation.held_out.trained_calibrations import with_missing_frames

ROWS = 240


def small(robot: Robot, **options: object) -> HybridCalibrator:
    """A calibrator that is done in a fraction of a second."""
    return HybridCalibrator(GeometricCalibrator(robot, **options), harmonics=(8,), products=False)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def arm():
    return hybrid_of("rb5", ROWS)


@pytest.fixture(scope="module")
def found(arm):
    steps: list[str] = []
    parts = k_folds(arm.measurements, 3, 0)
    return validate(small(arm.true.nominal), arm.measurements, parts, steps.append), parts, steps


def test_all_three_models_are_evaluated_on_the_same_rows(found):
    validation, _, steps = found
    assert list(validation.errors_by_model) == ["nominal", "geometric", "hybrid"]
    figures = validation.figures()
    assert (figures.folds, figures.rows) == (3, ROWS)
    for errors in validation.errors_by_model.values():
        assert bool(torch.isfinite(errors.position).all())
    nominal, geometric, hybrid = (errors.rms_mm for errors in figures.models.values())
    assert hybrid < 0.6 * geometric < 0.6 * nominal
    assert steps[0] == "fold 1 of 3"
    assert any(step.startswith("fold 3 of 3: gravity + series 8") for step in steps)


def test_geometric_figures_are_those_of_the_geometric_calibrator_alone(arm, found):
    validation, parts, _ = found
    alone = validate(GeometricCalibrator(arm.true.nominal), arm.measurements, parts)
    assert list(alone.errors_by_model) == ["nominal", "geometric"]
    assert alone.spread is None
    assert alone.figures().coverage is None
    for name in alone.errors_by_model:
        assert_close(
            alone.errors_by_model[name].position, validation.errors_by_model[name].position, atol=1e-15
        )


def test_every_fold_uses_only_its_training_rows(arm, found):
    validation, parts, _ = found
    train, test = parts[1]
    again = small(arm.true.nominal).fit(arm.measurements.select(train))
    errors = again.errors_of(arm.measurements.select(test))["position"].norm(dim=-1)
    assert_close(validation.errors_by_model["hybrid"].position[test], errors, atol=1e-12)


def test_means_over_the_parts(found):
    validation, parts, _ = found
    figures = validation.figures(parts)
    for name, errors in validation.errors_by_model.items():
        own = [float(errors.position[test].square().mean().sqrt()) * 1e3 for _, test in parts]
        assert_close(figures.rms_mm_of_simulations[name], own, rtol=1e-12)
        assert_close(figures.mean_rms_mm[name], sum(own) / 3, rtol=1e-12)


def test_coverage_counts_coordinates_within_their_intervals(found):
    validation, _, _ = found
    spread = validation.spread
    assert spread.value_count == 3 * ROWS
    inside = spread.error.abs() <= 1.96 * spread.sigma
    assert_close(spread.coverage, float(inside.double().mean()), atol=1e-12)
    assert 0.88 <= spread.coverage <= 0.995
    assert float(spread.sigma.min()) > 0.5 * NOISE  # the noise of the measurement is part of it


def test_coverage_of_errors_drawn_as_predicted(generator):
    sigma = torch.rand(4000, 3, generator=generator, dtype=torch.float64) + 0.1
    error = sigma * torch.randn(4000, 3, generator=generator, dtype=torch.float64)
    error[::7], sigma[1::7] = torch.nan, torch.nan
    spread = ErrorsWithPredictedSigma(error, sigma)
    assert spread.value_count < 12000
    assert_close(spread.coverage, 0.95, atol=0.01)
    assert_close(ErrorsWithPredictedSigma(0.5 * error, sigma).coverage, 1.0, atol=1e-3)
    assert ErrorsWithPredictedSigma.all_nan(5).in_file_units() == {}


def test_stated_noise_applies_per_row_and_rows_without_it_are_exact(arm):
    stated = torch.full((ROWS,), NOISE, dtype=torch.float64)
    rows = replace(arm.measurements, sigma_position=stated)
    result = small(arm.true.nominal).fit(rows)
    known = errors_with_predicted_sigma(result, rows)
    exact = errors_with_predicted_sigma(result, replace(rows, sigma_position=None))
    loud = errors_with_predicted_sigma(result, replace(rows, sigma_position=10 * stated))
    deviation = result.sigma(rows)
    assert_close(exact.sigma, deviation, atol=1e-15)
    added = (known.sigma.square() - deviation.square()).sqrt()
    assert_close(added, added[:1, :1].expand_as(added), rtol=1e-6)
    assert_close((loud.sigma.square() - deviation.square()).sqrt(), 10 * added, rtol=1e-6)
    assert float(added[0, 0]) >= NOISE * (1 - 1e-9)


def test_rows_kept_aside(arm):
    train, test = holdout(arm.measurements, 0.3, 0)
    calibrator, seen, other = small(arm.true.nominal), *map(arm.measurements.select, (train, test))
    result = calibrator.fit(seen)
    aside = judge(calibrator, result, seen, other)
    whole = validate(calibrator, arm.measurements, [(train, test)])
    for name in ("nominal", "geometric", "hybrid"):
        assert_close(
            aside.errors_by_model[name].position, whole.errors_by_model[name].position[test], atol=1e-12
        )
    assert_close(aside.spread.sigma, whole.spread.sigma[test], atol=1e-12)


def test_a_learning_curve_falls_and_ends_with_all_rows(arm, found):
    whole, parts, _ = found
    points = learning_curve(
        small(arm.true.nominal), arm.measurements, parts, (100, 40), 0, full_training=whole
    )
    assert [point.rows for point in points] == [40, 100, 160]
    assert points[-1].hybrid == whole.figures().hybrid
    assert [figure.held_out for figure in points] == [ROWS] * 3
    errors = [figure.hybrid.rms_mm for figure in points]
    assert errors == sorted(errors, reverse=True)
    assert all(figure.hybrid.rms_mm < 1.05 * figure.geometric.rms_mm for figure in points)


def test_a_frame_that_was_held_out_is_fitted_under_both_arms(arm):
    rows = arm.measurements
    named = replace(rows, frame=tuple("left" if k < 160 else "right" for k in range(ROWS)))
    part = torch.arange(160), torch.arange(160, ROWS)
    found = validate(small(arm.true.nominal), named, [part])
    assert found.frames_held_out == 1
    rms = {name: errors.rms_mm for name, errors in found.figures().models.items()}
    assert rms["hybrid"] < 0.7 * rms["geometric"]
    assert found.spread.value_count == 0  # nothing is predicted of where a frame is that was not seen
    calibrator = small(arm.true.nominal)
    result = calibrator.fit(named.select(part[0]))
    both = with_missing_frames(calibrator.geometric_calibrator, result, named.select(part[1]))
    for known in (both.geometric.bases, both.learned.geometry.bases):
        assert list(known) == ["left", "right"]
        assert_close(known["right"], known["left"], atol=2e-3)  # it is the same place
        assert not np.array_equal(known["right"], known["left"])
    assert list(result.geometric.bases) == ["left"]


def test_sockets_are_evaluated_like_those_of_a_geometric_calibration():
    data = socket_data()
    known = {(f"{plate}/0", f"{plate}/1"): 0.05 for plate in ("plate", "low", "high")}
    parts = k_folds(data, None, 0, "placement")
    found = validate(small(true_arm().nominal, socket_distances=known), data, parts)
    figures = found.figures()
    assert figures.sockets_held_out == 6
    assert figures.socket_distance.count == 3
    assert list(figures.socket_distance.models) == ["nominal", "geometric", "hybrid"]
    assert figures.coverage is None
    assert figures.hybrid.rms_mm <= 1.02 * figures.geometric.rms_mm + 1e-6


def test_nothing_to_learn_leaves_the_geometric_figures():
    from testing.simulated_arm import simulate

    exact = simulate("kiro4", rows=80, noise=5e-5, turn_noise=1e-4)
    found = validate(small(exact.nominal), exact.measurements, k_folds(exact.measurements, 2, 0))
    assert isinstance(found.errors_by_model["hybrid"], PoseErrors)
    assert_close(
        found.errors_by_model["hybrid"].position, found.errors_by_model["geometric"].position, atol=1e-15
    )
    assert_close(
        found.errors_by_model["hybrid"].rotation, found.errors_by_model["geometric"].rotation, atol=1e-15
    )
    assert 0.88 <= found.spread.coverage <= 0.99
