"""Geometric calibration judged on held-out rows: complete placements of sockets and of jigs."""

from dataclasses import replace

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused
from testing.sensors import ARM, TRUE_BASES, socket_data, touch_data, true_robot
from testing.simulated_arm import simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.estimation.loss import SquaredLoss
from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.splits import holdout, k_folds
from pisigma.reporting.calibration_tables import held_out_lines
from pisigma.reporting.tables import distance_table
from pisigma.validation.held_out.calibration_validation import validate
from pisigma.validation.held_out.trained_calibrations import (
    DistanceErrors,
    assign_distances_to_folds,
    with_missing_frames,
)

KNOWN = {(f"{plate}/0", f"{plate}/1"): 0.05 for plate in ("plate", "low", "high")}


def exact(**options: object) -> GeometricCalibrator:
    """The calibrator that gives the true arm back from exact data."""
    return GeometricCalibrator(
        true_robot().nominal,
        free=ARM,
        tool="position",
        prior=None,
        loss=SquaredLoss(),
        **options,  # type: ignore[arg-type]
    )


def test_sockets_of_exact_data_are_met_where_they_were_held_out() -> None:
    data = socket_data()
    found = validate(exact(socket_distances=KNOWN), data, k_folds(data, None, 0, "placement"))
    assert (found.folds, found.sockets_held_out, found.frames_held_out) == (3, 6, 0)
    assert_close(
        found.errors_by_model["geometric"].position, torch.zeros(data.rows, dtype=torch.float64), atol=1e-8
    )
    assert_close(found.distances.errors["geometric"], torch.zeros(3, dtype=torch.float64), atol=1e-8)
    figures = found.figures()
    distance = figures.socket_distance
    assert distance.count == 3
    nominal = found.distances.errors["nominal"].abs() * 1e3
    assert_close(distance.nominal.mean_mm, float(nominal.mean()), atol=1e-12)
    assert_close(distance.nominal.max_mm, float(nominal.max()), atol=1e-12)
    assert float(nominal.mean()) > 0.1
    lines = held_out_lines(figures)
    assert lines[0].startswith("6 sockets ")
    assert lines[1].startswith("Stated distances between sockets (3, ")
    table = distance_table(distance)
    assert [row[0] for row in table.rows] == ["high/0 to high/1", "low/0 to low/1", "plate/0 to plate/1"]


def test_rows_of_a_target_that_is_seen_once_are_not_judged() -> None:
    arm = simulate("ur5", rows=80, noise=5e-5)
    rows = replace(arm.measurements, target=("A",) * 79 + ("B",))
    found = validate(GeometricCalibrator(arm.nominal), rows, k_folds(rows, 4, seed=0))
    assert int(torch.isnan(found.errors_by_model["geometric"].position).sum()) == 1
    figures = found.figures()
    assert (figures.rows, figures.rows_not_judged) == (79, 1)
    (line,) = held_out_lines(figures)
    assert line.startswith("1 row ")
    alone = replace(rows, target=tuple(f"target {row}" for row in range(80)))
    with refused(IdentificationError) as caught:
        validate(GeometricCalibrator(arm.nominal), alone, k_folds(alone, 4, seed=0))
    assert caught.value.file.startswith(alone.source)  # the first held-out row


def test_too_few_training_rows_name_their_fold() -> None:
    arm = simulate("ur5", rows=12, noise=5e-5)
    with refused(IdentificationError, value="fold 1 of 4"):
        validate(GeometricCalibrator(arm.nominal), arm.measurements, k_folds(arm.measurements, 4, seed=0))


def test_an_error_of_a_held_out_socket_is_the_distance_to_where_its_rows_meet() -> None:
    data = socket_data()
    rows = torch.tensor([name.startswith("low/") for name in data.socket or ()])
    part = (~rows).nonzero()[:, 0], rows.nonzero()[:, 0]
    found = validate(exact(socket_distances=KNOWN), data, [part])
    assert bool(torch.isnan(found.errors_by_model["nominal"].position[~rows]).all())
    arm = replace(exact(socket_distances={k: v for k, v in KNOWN.items() if "low" not in k[0]}), free=())
    errors = arm.fit(data.select(part[0])).errors_of(data.select(part[1]))["socket"]
    assert_close(found.errors_by_model["nominal"].position[rows], errors.norm(dim=-1), atol=1e-12)
    for name in ("low/0", "low/1"):
        own = torch.tensor([other == name for other in data.socket or ()])[rows]
        assert_close(errors[own].mean(0), torch.zeros(3, dtype=torch.float64), atol=1e-12)


def test_every_stated_distance_is_predicted_by_a_calibration_without_it() -> None:
    data = socket_data()
    wrong = KNOWN | {("low/0", "low/1"): 0.051}
    found = validate(exact(socket_distances=wrong), data, k_folds(data, 3, 0))
    assert found.sockets_held_out == 0
    each = {one.sockets: one for one in found.figures().socket_distance.each}
    assert set(each) == set(KNOWN)
    assert each["low/0", "low/1"].stated_mm == pytest.approx(51.0)
    assert each["low/0", "low/1"].errors_mm["geometric"] == pytest.approx(-1.0, abs=1e-6)
    others = [abs(one.errors_mm["geometric"]) for pair, one in each.items() if pair != ("low/0", "low/1")]
    assert 1e-3 < max(others) < 1.0  # their calibrations had the wrong one


def test_distances_are_held_out_once_but_never_all_together() -> None:
    data = socket_data()
    whole = assign_distances_to_folds(KNOWN, data, k_folds(data, None, 0, "placement"))
    assert sorted(len(one) for one in whole) == [1, 1, 1]
    assert {pair for one in whole for pair in one} == set(KNOWN)
    assert assign_distances_to_folds(KNOWN, data, [holdout(data, 0.3, 0)]) == ({},)
    assert [len(one) for one in assign_distances_to_folds(KNOWN, data, k_folds(data, 2, 0))] == [2, 1]
    two = dict(list(KNOWN.items())[:2])
    assert [len(one) for one in assign_distances_to_folds(two, data, k_folds(data, 2, 0))] == [1, 1]
    alone = {("low/0", "low/1"): 0.05}
    assert assign_distances_to_folds(alone, data, k_folds(data, 3, 0)) == ({}, {}, {})


def test_a_ball_that_once_missed_its_socket_does_not_move_it() -> None:
    data, known = socket_data(), {("low/0", "low/1"): 0.05}
    result = exact(socket_distances=KNOWN).fit(data)
    row = (data.socket or ()).index("low/0")
    q = data.q.clone()
    q[row, 1] += 0.01
    missed = replace(data, q=q)
    T = result.predicted_poses(missed)
    errors = DistanceErrors.from_poses({"geometric": T}, known, missed).errors["geometric"]
    assert_close(errors, torch.zeros(1, dtype=torch.float64), atol=1e-8)


def test_distances_of_sockets_that_no_row_has_are_still_refused() -> None:
    data = socket_data()
    wrong = exact(socket_distances=KNOWN | {("low/0", "low/7"): 0.05})
    with pytest.raises(IdentificationError):
        validate(wrong, data, k_folds(data, None, 0, "placement"))


def test_frames_of_exact_touches_are_met_where_they_were_held_out() -> None:
    data = touch_data(("right", "left", "back"))
    frames = {name: tuple(base + 0.01) for name, base in TRUE_BASES.items()}
    found = validate(exact(base_guesses=frames), data, k_folds(data, None, 0, "placement"))
    assert (found.folds, found.sockets_held_out, found.frames_held_out) == (3, 0, 3)
    assert_close(
        found.errors_by_model["geometric"].position, torch.zeros(data.rows, dtype=torch.float64), atol=1e-8
    )
    assert float(found.errors_by_model["nominal"].position.square().mean().sqrt()) > 5e-4
    assert held_out_lines(found.figures())[0].startswith("3 frames ")


def test_a_frame_that_is_fitted_afterwards_leaves_the_arm_as_it_was() -> None:
    data = touch_data(("right", "left"))
    right = torch.tensor([name == "right" for name in data.frame])
    arm = exact()
    result = arm.fit(data.select(right.nonzero()[:, 0]))
    both = with_missing_frames(arm, result, data.select((~right).nonzero()[:, 0]))
    assert both.robot is result.robot
    assert sorted(both.bases) == ["left", "right"]
    assert_close(both.bases["left"][:3], TRUE_BASES["left"][:3], atol=1e-7)
    assert sorted(result.bases) == ["right"]


def test_a_held_out_frame_with_several_targets_is_refused() -> None:
    data = touch_data(("right", "left"), count=120)
    two = replace(data, target=("A", "B") * (data.rows // 2))
    frames = {name: tuple(TRUE_BASES[name]) for name in ("right", "left")}
    with refused(IdentificationError, value=("A", "B")):
        validate(exact(base_guesses=frames), two, k_folds(two, None, 0, "placement"))


def test_rows_without_a_socket_are_in_no_test() -> None:
    sockets = socket_data()
    free = Measurements(q=sockets.q[:4] + 0.01, position=torch.zeros(4, 3, dtype=torch.float64))
    data = join([free, sockets])
    tested = torch.cat([test for _, test in k_folds(data, None, 0, "placement")])
    assert sorted(tested.tolist()) == list(range(4, data.rows))
