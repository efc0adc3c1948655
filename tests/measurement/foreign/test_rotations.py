"""Rotations of every maker agree with scipy."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from testing.closeness import assert_close

from pisigma.measurement.foreign.rotations import ROTATIONS, encodings_of
from pisigma.robot.se3 import rotation_from_quaternion, rotation_from_zyx

ANGLES = np.random.default_rng(1).uniform(-1.4, 1.4, (20, 3))


@pytest.mark.parametrize(
    ("name", "axes", "order"),
    [
        ("kuka", "ZYX", (0, 1, 2)),
        ("mitsubishi", "xyz", (0, 1, 2)),
        ("doosan", "ZYZ", (0, 1, 2)),
        ("fanuc", "xyz", (0, 1, 2)),
        ("epson", "ZYX", (0, 1, 2)),
        ("kawasaki", "ZYZ", (0, 1, 2)),
        ("comau", "ZYZ", (0, 1, 2)),
        ("yaskawa", "xyz", (0, 1, 2)),
        ("staubli", "XYZ", (0, 1, 2)),
        ("rpy", "xyz", (0, 1, 2)),
        ("omron", "ZYZ", (0, 1, 2)),
    ],
)
def test_angles(name: str, axes: str, order: tuple[int, ...]):
    expected = Rotation.from_euler(axes, ANGLES[:, order]).as_matrix()
    assert_close(ROTATIONS[name].to_rotation(torch.from_numpy(ANGLES)), expected, atol=1e-14)


def test_vectors_quaternions_and_matrices():
    rotation = Rotation.from_rotvec(ANGLES)
    xyzw = rotation.as_quat()
    for name, values in (
        ("ur", ANGLES),
        ("quaternion", xyzw),
        ("abb", xyzw[:, [3, 0, 1, 2]]),
        ("matrix", rotation.as_matrix().reshape(-1, 9)),
    ):
        tensor = torch.from_numpy(np.ascontiguousarray(values))
        assert_close(ROTATIONS[name].to_rotation(tensor), rotation.as_matrix(), atol=1e-14)
        assert bool(ROTATIONS[name].is_rotation(tensor).all())
        if not ROTATIONS[name].is_angles:
            assert not bool(ROTATIONS[name].is_rotation(tensor * 1.1).any())


@pytest.mark.parametrize("name", [name for name, encoding in ROTATIONS.items() if encoding.columns])
def test_columns_of_measurement_files_mean_the_same(name: str):
    encoding = ROTATIONS[name]
    values = torch.from_numpy(ANGLES if encoding.is_angles else Rotation.from_rotvec(ANGLES).as_quat())
    names = ("roll", "pitch", "yaw") if encoding.is_angles else ("qx", "qy", "qz", "qw")
    to_rotation = rotation_from_zyx if encoding.is_angles else rotation_from_quaternion
    columns = values[:, [encoding.columns.index(column) for column in names]]
    assert_close(encoding.to_rotation(values), to_rotation(columns), atol=1e-14)


def test_left_handed_matrices_are_not_rotations():
    mirrored = torch.tensor([[1.0, 0, 0, 0, 1, 0, 0, 0, -1], [1, 0, 0, 0, 1, 0, 0, 0, math.nan]]).double()
    assert not bool(ROTATIONS["matrix"].is_rotation(mirrored).any())


def test_names_that_several_makers_use():
    assert set(encodings_of({"a", "b", "c"})) == {"kuka", "mitsubishi", "doosan"}
    assert encodings_of({"q1", "q2", "q3", "q4"}) == {"abb": {f"q{i}": f"abb_q{i}" for i in range(1, 5)}}
