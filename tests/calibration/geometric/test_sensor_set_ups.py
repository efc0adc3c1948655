"""Setups that leave parameters undetermined, and invalid input."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused
from testing.sensors import ARM, TRUE_BASES, joints, pair_data, socket_data, touch_data, true_robot, wire_data

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements, join
from pisigma.robot.row import FRAME_COLUMNS


def calibrator(**options: object) -> GeometricCalibrator:
    return GeometricCalibrator(true_robot().nominal, **options)  # type: ignore[arg-type]


def kinds_of_warnings(result: CalibrationResult) -> set[str]:
    return {warning.kind for warning in result.warning_details}


def test_a_frame_touched_once_is_refused() -> None:
    once = touch_data(("back",), count=1)
    with refused(IdentificationError, expected="more than 6 touches of frame 'back'", value=1):
        calibrator().fit(join([touch_data(), once]))


def test_touches_along_one_axis_do_not_tell_the_frame() -> None:
    data = join([touch_data(), touch_data(("back",), axes="z")])
    given = {"back": tuple(TRUE_BASES["back"])}
    result = calibrator(base_guesses=given).fit(data)
    assert [one.subject for one in result.warning_details if one.kind == "touched_frame"] == ["back"]


def test_a_missing_start_of_a_frame_is_refused() -> None:
    with refused(IdentificationError, option="base_guesses", value="lefd"):
        calibrator(base_guesses={"lefd": (0.0,) * 6}).fit(touch_data())
    with refused(IdentificationError, option="base_guesses", value=(0.0, 0.0, 0.0)):
        calibrator(base_guesses={"left": (0.0, 0.0, 0.0)})


def test_touches_that_fit_nowhere_ask_for_a_start() -> None:
    data = touch_data(("left",))
    assert data.touch is not None
    wild = replace(data, touch=data.touch.roll(7) * 3)
    with refused(IdentificationError, value="left"):
        calibrator().fit(wild)


def test_sockets_do_not_determine_the_scale() -> None:
    result = calibrator().fit(socket_data())
    assert kinds_of_warnings(result) >= {"scale_of_sockets"}
    assert result.status.is_minimum
    known = calibrator(socket_distances={("plate/0", "plate/1"): 0.05}).fit(socket_data())
    assert not kinds_of_warnings(known) & {"scale_of_sockets"}


def test_touches_of_one_plane_have_no_scale() -> None:
    data = touch_data(("left",), count=90)
    flat = replace(data, touch=torch.zeros(90, dtype=torch.float64))
    start = {"left": tuple(TRUE_BASES["left"])}
    with refused(IdentificationError, value="left"):
        calibrator(base_guesses={}).fit(flat)
    assert kinds_of_warnings(calibrator(base_guesses=start).fit(flat)) >= {"scale_of_touches"}


@pytest.mark.parametrize(
    ("known", "value"),
    [
        ({("plate/0", "plate/7"): 0.05}, "plate/7"),
        ({("plate/0", "plate/0"): 0.05}, "50 mm between 'plate/0' and 'plate/0'"),
        ({("plate/0", "plate/1"): -0.05}, "-50 mm between 'plate/0' and 'plate/1'"),
    ],
)
def test_impossible_distances_of_sockets_are_refused(known: dict, value: str) -> None:
    with refused(IdentificationError, option="socket_distances", value=value):
        calibrator(socket_distances=known).fit(socket_data())


def test_sockets_with_a_joint_turning_the_wrong_way_are_refused() -> None:
    data = socket_data()
    wrong = replace(data, q=data.q * torch.tensor([1, -1, 1, 1, 1, 1.0], dtype=torch.float64))
    with refused(IdentificationError, value="a median distance of 103 mm from their mean"):
        calibrator().fit(wrong)


@pytest.mark.parametrize("known", [False, True])
def test_a_wire_shorter_than_possible_is_refused(known: bool) -> None:
    data = wire_data(known=known)
    assert data.distance is not None
    short = data.distance.clone()
    short[17] = 0.05
    with refused(IdentificationError, column="distance", value=50.0) as caught:
        calibrator().fit(replace(data, distance=short))
    assert "row 17" in str(caught.value)


def test_few_distances_and_wrong_pairs_are_refused() -> None:
    with refused(IdentificationError, file="memory", value=4):
        calibrator().fit(join([touch_data(), wire_data().select(torch.arange(4))]))
    pairs = pair_data()
    assert pairs.distance is not None
    long = pairs.distance.clone()
    long[6:8] += 2.0
    with refused(IdentificationError, column="distance") as caught:
        calibrator().fit(replace(pairs, distance=long))
    assert "'pair 3'" in caught.value.expected


def test_rows_named_after_another_frame_are_noticed() -> None:
    data = touch_data(("right", "left", "back"), noise=1e-4)
    assert not kinds_of_warnings(calibrator().fit(data)) & {"frame_misfit"}
    frame = list(data.frame)
    frame[60:85] = ["back"] * 25
    mixed = replace(data, frame=tuple(frame))
    with refused(IdentificationError, value="back"):
        calibrator().fit(mixed)
    result = calibrator(base_guesses={"back": tuple(TRUE_BASES["back"])}).fit(mixed)
    assert ("frame_misfit", "back") in [(one.kind, one.subject) for one in result.warning_details]


def test_noise_is_estimated_for_every_kind() -> None:
    generator = torch.Generator().manual_seed(3)
    wire = wire_data(count=150)
    assert wire.distance is not None
    noisy = replace(wire, distance=wire.distance + 5e-4 * torch.randn(150, generator=generator).double())
    data = join([touch_data(count=100, noise=1e-4), noisy])
    noise = {found.sensor: found.sigma for found in calibrator(free=ARM, tool="position").fit(data).noise}
    assert_close(noise["touch"], 1e-4, rtol=0.2)
    assert_close(noise["distance"], 5e-4, rtol=0.2)


def test_priors_are_estimated_and_bring_weak_data_nearer_to_the_truth() -> None:
    true = true_robot().geometric_robot
    sizes = []
    for options in ({}, {"prior_scaling": "widened"}, {"prior": None}):
        result = calibrator(**options).fit(touch_data(count=96, noise=2e-4))
        sizes.append(float(abs(result.robot.dh - true.dh)[:, 3:].max()))
    assert sizes[0] < 0.7 * sizes[1]
    assert sizes[0] < 0.7 * sizes[2]


def test_options_that_do_not_exist_are_refused() -> None:
    with refused(IdentificationError, option="prior_scaling", value="guessed"):
        calibrator(prior_scaling="guessed")
    with refused(IdentificationError, option="tool", value="positions"):
        calibrator(tool="positions")
    with refused(IdentificationError, expected="measured values"):
        calibrator().fit(Measurements(q=joints(20, 1)))


def test_nothing_depends_on_where_the_base_of_a_floating_frame_starts() -> None:
    robot, exact = true_robot().nominal, socket_data()
    noise = torch.randn(exact.q.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    data = replace(exact, q=exact.q + 2e-4 * noise)
    off = robot.with_geometry(base=np.array([0.7, -1.0, 0.4, 2.0, -0.6, 1.1]))
    distances = {(f"{name}/0", f"{name}/1"): 0.05 for name in ("plate", "low", "high")}
    solved = [GeometricCalibrator(one, socket_distances=distances).solve(data) for one in (robot, off)]
    arm = slice(solved[0].problem.space.arm_parameter_count)
    first, other = (one.solution.linearisation.point[arm] for one in solved)
    assert_close(other, first, atol=1e-9)
    for one in solved:
        result = one.result()
        assert one.solution.status.is_minimum
        assert {f"base_{column}" for column in FRAME_COLUMNS} <= set(result.redundancy.no_effect)
        assert not any(name.startswith("base") for name in result.free_parameters)
        errors = [p.standard_error for p in result.parameters if p.name.startswith("socket")]
        assert max(errors) < 1e-3
