"""Duplicate rows are left out, and repeated measurements are kept."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pisigma.measurement.camera.corner_file import read_rows
from pisigma.measurement.copies import CopiedRow, without_copies
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.exceeded_limits import row_warnings
from pisigma.robot.description import Robot

ROBOT = Robot.load("rb5")
ROWS = 40
HUNDREDTH = math.radians(1e-2)


def measured(rows: int = ROWS, seed: int = 0) -> Measurements:
    """Rows with all digits; positions may be any."""
    draw = torch.Generator().manual_seed(seed)
    q = torch.rand(rows, 6, generator=draw, dtype=torch.float64) * 2 - 1
    return Measurements(q, torch.rand(rows, 3, generator=draw, dtype=torch.float64), source=f"rows {seed}")


def rounded(rows: Measurements, length: float, angle: float = HUNDREDTH) -> Measurements:
    """Round positions and joint values."""
    assert rows.position is not None
    position = (rows.position / length).round() * length
    return replace(rows, q=(rows.q / angle).round() * angle, position=position, source="copy")


def shuffled(rows: Measurements, count: int = ROWS) -> Measurements:
    return rows.select(torch.randperm(rows.rows, generator=torch.Generator().manual_seed(1))[:count])


VARIANTS = {
    "another name": lambda rows: replace(rows, source="copy"),
    "another date": lambda rows: replace(rows, date=("2026-01-02",) * ROWS),
    "another order": shuffled,
    "0.1 mm, 0.01 deg": lambda rows: rounded(rows, 1e-4),
    "0.01 mm, 0.01 deg": lambda rows: rounded(rows, 1e-5),
    "0.1 mm, joints whole": lambda rows: rounded(rows, 1e-4, 1e-9),
    "0.001 inch": lambda rows: rounded(rows, 2.54e-5),
    "rounded, in part and another order": lambda rows: shuffled(rounded(rows, 1e-5), 5),
    "in part": lambda rows: shuffled(rows, 1),
}


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("copy_first", [False, True])
def test_copies_are_left_out_and_the_row_with_the_most_digits_is_kept(variant, copy_first):
    rows = measured()
    copy = VARIANTS[variant](rows)
    both = join([copy, rows] if copy_first else [rows, copy])
    once = read_rows(both, ROBOT)
    assert once.rows == ROWS
    assert len(once.left_out) == copy.rows
    assert torch.equal(once.position.sort(0).values, rows.position.sort(0).values)
    (warning,) = row_warnings(ROBOT, once)
    assert once.left_out[0].place in warning


@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_files_in_other_units_are_recognised(unit, tmp_path: Path):
    rows = rounded(measured(), 1e-5)
    rows.write_csv(tmp_path / "first.csv", ROBOT)
    scale = 180 / torch.pi if unit == "deg" else 1.0
    lines = [",".join([*(f"q{k}_{unit}" for k in range(1, 7)), "x_m", "y_m", "z_m"])]
    for q, position in zip(rows.q.tolist(), rows.position.tolist(), strict=True):
        lines.append(",".join([*(f"{scale * one:.6f}" for one in q), *(f"{one:.5f}" for one in position)]))
    (tmp_path / "second.csv").write_text("\n".join(lines) + "\n")
    once = read_rows([tmp_path / "first.csv", tmp_path / "second.csv"], ROBOT)
    assert once.rows == ROWS
    assert all(isinstance(one, CopiedRow) for one in once.left_out)


def test_both_rows_of_a_pair_are_copies_or_none():
    draw = torch.Generator().manual_seed(3)
    q = torch.rand(8, 6, generator=draw, dtype=torch.float64)
    distance = torch.rand(4, generator=draw, dtype=torch.float64).repeat_interleave(2)
    names = tuple("aabbccdd")
    pairs = Measurements(q, distance=distance, pair=names)
    copy = replace(pairs.select(torch.arange(4)), pair=tuple("eeff"))
    assert read_rows(join([pairs, copy]), ROBOT).pair == names
    turned = replace(copy, q=torch.cat([copy.q[:3], copy.q[3:] + 0.1]))
    assert read_rows(join([pairs, turned]), ROBOT).pair == (*names, "f", "f")


@pytest.mark.parametrize("noise", [5e-6, 3e-5])
@pytest.mark.parametrize("step", [1e-3, 1e-4, 1e-5, 1e-6])
@pytest.mark.parametrize("interleaved", [False, True])
def test_repeats_are_not_copies(noise, step, interleaved):
    if interleaved and noise < 2e-5:
        return  # no robot is so repeatable
    rows = measured(30)
    repeats = join([rows] * 10) if interleaved else rows.select(torch.arange(30).repeat_interleave(10))
    draw = torch.Generator().manual_seed(4)
    position = repeats.position + noise * torch.randn(300, 3, generator=draw, dtype=torch.float64)
    repeats = rounded(replace(repeats, position=position), step)
    assert without_copies(repeats.as_fields(), ROBOT).rows == 300


@pytest.mark.parametrize("step", [None, 1e-5, 1e-4])
def test_measured_repeats_are_not_copies(step, shared_data):
    rows = Measurements.read_csv(shared_data / "fanuc_r2000/positions.csv")
    rows = rows if step is None else rounded(rows, step, 1e-9)
    assert without_copies(rows.as_fields(), ROBOT).rows == 720
    if step is not None and step < 1e-4:
        both = join([Measurements.read_csv(shared_data / "fanuc_r2000/positions.csv"), rows])
        assert read_rows(both, ROBOT).rows == 720
