"""What set-ups cannot tell, and input that cannot be: a sentence each."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.sensors import ARM, TRUE_BASES, joints, pair_data, socket_data, touch_data, true_robot, wire_data

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements, join
from pisigma.robot.row import FRAME_COLUMNS


def calibrator(**options: object) -> GeometricCalibrator:
    return GeometricCalibrator(true_robot().nominal, **options)  # type: ignore[arg-type]


def test_a_frame_touched_once_is_refused() -> None:
    once = touch_data(("back",), count=1)
    with pytest.raises(IdentificationError, match="frame 'back' was touched once only"):
        calibrator().fit(join([touch_data(), once]))


def test_touches_along_one_axis_do_not_tell_the_frame() -> None:
    data = join([touch_data(), touch_data(("back",), axes="z")])
    given = {"back": tuple(TRUE_BASES["back"])}
    result = calibrator(frames=given).fit(data)
    assert any("frame 'back' was touched along z only" in warning for warning in result.warnings)
    assert not any("frame 'left'" in warning for warning in result.warnings)


def test_a_start_of_a_frame_that_is_not_there_is_refused() -> None:
    with pytest.raises(IdentificationError, match="no row is in a frame of that name"):
        calibrator(frames={"lefd": (0.0,) * 6}).fit(touch_data())
    with pytest.raises(IdentificationError, match="six numbers were wanted"):
        calibrator(frames={"left": (0.0, 0.0, 0.0)})


def test_touches_that_fit_nowhere_ask_for_a_start() -> None:
    data = touch_data(("left",))
    assert data.touch is not None
    wild = replace(data, touch=data.touch.roll(7) * 3)
    with pytest.raises(IdentificationError, match="do not determine where it stands"):
        calibrator().fit(wild)


def test_sockets_alone_have_no_scale() -> None:
    result = calibrator().fit(socket_data())
    assert any("sockets alone are met by a robot of any size" in warning for warning in result.warnings)
    assert result.status.good
    known = calibrator(socket_distances={("plate/0", "plate/1"): 0.05}).fit(socket_data())
    assert not any("any size" in warning for warning in known.warnings)


def test_touches_of_one_plane_have_no_scale() -> None:
    data = touch_data(("left",), count=90)
    flat = replace(data, touch=torch.zeros(90, dtype=torch.float64))
    start = {"left": tuple(TRUE_BASES["left"])}
    with pytest.raises(IdentificationError, match="do not determine where it stands"):
        calibrator(frames={}).fit(flat)
    assert any("at one coordinate" in w for w in calibrator(frames=start).fit(flat).warnings)


@pytest.mark.parametrize(
    ("known", "complaint"),
    [
        ({("plate/0", "plate/7"): 0.05}, "no row has it"),
        ({("plate/0", "plate/0"): 0.05}, "two different sockets"),
        ({("plate/0", "plate/1"): -0.05}, "positive"),
    ],
)
def test_distances_of_sockets_that_cannot_be_are_refused(known: dict, complaint: str) -> None:
    with pytest.raises(IdentificationError, match=complaint):
        calibrator(socket_distances=known).fit(socket_data())


def test_sockets_with_a_joint_turning_the_wrong_way_are_refused() -> None:
    data = socket_data()
    wrong = replace(data, q=data.q * torch.tensor([1, -1, 1, 1, 1, 1.0], dtype=torch.float64))
    with pytest.raises(IdentificationError, match="directions and zeros of the joints"):
        calibrator().fit(wrong)


@pytest.mark.parametrize("known", [False, True])
def test_a_wire_shorter_than_possible_is_refused(known: bool) -> None:
    data = wire_data(known=known)
    assert data.distance is not None
    short = data.distance.clone()
    short[17] = 0.05
    with pytest.raises(IdentificationError, match=r"row 17.*50 mm.*shorter than any position"):
        calibrator().fit(replace(data, distance=short))


def test_few_distances_and_wrong_pairs_are_refused() -> None:
    with pytest.raises(IdentificationError, match="anchor 'wire' has 4 distances"):
        calibrator().fit(join([touch_data(), wire_data().select(torch.arange(4))]))
    pairs = pair_data()
    assert pairs.distance is not None
    long = pairs.distance.clone()
    long[6:8] += 2.0
    with pytest.raises(IdentificationError, match="pair 'pair 3' is"):
        calibrator().fit(replace(pairs, distance=long))


def test_rows_named_after_another_frame_are_noticed() -> None:
    data = touch_data(("right", "left", "back"), noise=1e-4)
    assert not any("named after another" in warning for warning in calibrator().fit(data).warnings)
    frame = list(data.frame)
    frame[60:85] = ["back"] * 25
    mixed = replace(data, frame=tuple(frame))
    with pytest.raises(IdentificationError, match="check that they are all of this frame"):
        calibrator().fit(mixed)
    result = calibrator(frames={"back": tuple(TRUE_BASES["back"])}).fit(mixed)
    assert any("of frame 'back' are off by" in warning for warning in result.warnings)


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
    for options in ({}, {"prior_sizes": "widened"}, {"prior": None}):
        result = calibrator(**options).fit(touch_data(count=96, noise=2e-4))
        sizes.append(float(abs(result.robot.dh - true.dh)[:, 3:].max()))
    assert sizes[0] < 0.7 * sizes[1]
    assert sizes[0] < 0.7 * sizes[2]


def test_options_that_do_not_exist_are_refused() -> None:
    with pytest.raises(IdentificationError, match="prior_sizes='guessed' is no choice"):
        calibrator(prior_sizes="guessed")
    with pytest.raises(IdentificationError, match="valid: free, position, fixed"):
        calibrator(tool="positions")
    with pytest.raises(IdentificationError, match="none of its 20 rows has a measured value"):
        calibrator().fit(Measurements(q=joints(20, 1)))


def test_nothing_depends_on_where_the_base_of_a_floating_frame_starts() -> None:
    robot, exact = true_robot().nominal, socket_data()
    noise = torch.randn(exact.q.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    data = replace(exact, q=exact.q + 2e-4 * noise)
    off = robot.with_geometry(base=np.array([0.7, -1.0, 0.4, 2.0, -0.6, 1.1]))
    distances = {(f"{name}/0", f"{name}/1"): 0.05 for name in ("plate", "low", "high")}
    solved = [GeometricCalibrator(one, socket_distances=distances).solve(data) for one in (robot, off)]
    arm = slice(solved[0].problem.space.arm_size)
    first, other = (one.solution.linearisation.point[arm] for one in solved)
    assert_close(other, first, atol=1e-9)
    for one in solved:
        result = one.result()
        assert one.solution.status.good
        assert {f"base_{column}" for column in FRAME_COLUMNS} <= set(result.redundancy.no_effect)
        assert not any(name.startswith("base") for name in result.free)
        errors = [p.standard_error for p in result.parameters if p.name.startswith("socket")]
        assert max(errors) < 1e-3
