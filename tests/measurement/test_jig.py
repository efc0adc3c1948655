"""Jigs: valid and invalid descriptions, and the points that can be touched."""

from pathlib import Path

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.jig import Jig

STAIRS = """\
name: stairs
source: ours
blocks:
  - name: low
    corner_mm: [0, 0, 0]
    size_mm: [100, 100, 50]
    faces: [+z, -y]
  - name: high
    corner_mm: [0, 100, 0]
    size_mm: [100, 100, 120]
    faces: [-y, +z]
"""


def load(tmp_path: Path, text: str) -> Jig:
    path = tmp_path / "jig.yaml"
    path.write_text(text)
    return Jig.load(path)


def points(*values: tuple[float, float, float]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64) / 1e3


def test_faces_have_axis_coordinate_extent_and_direction(tmp_path: Path):
    jig = load(tmp_path, STAIRS)
    assert jig.face_names == ("low/+z", "low/-y", "high/-y", "high/+z")
    assert jig.axis.tolist() == [2, 1, 1, 2]
    assert_close(jig.coordinate, [0.05, 0.0, 0.1, 0.12], atol=1e-16)
    assert_close(jig.outward, [[0, 0, 1], [0, -1, 0], [0, -1, 0], [0, 0, 1.0]])
    lower, upper = jig.extent
    assert_close(lower, points((0, 0, 50), (0, 0, 0), (0, 100, 0), (0, 100, 120)), atol=1e-16)
    assert_close(upper, points((100, 100, 50), (100, 0, 50), (100, 100, 120), (100, 200, 120)), atol=1e-16)


def test_points_on_a_face_are_inside_its_edges_and_uncovered(tmp_path: Path):
    jig = load(tmp_path, STAIRS)
    riser = torch.full((5,), 2)
    on = points((50, 100, 85), (50, 100, 30), (50, 100, 55), (-1, 100, 85), (50, 250, 85))
    assert jig.is_on_face(riser, on).tolist() == [True, False, True, False, True]
    assert jig.is_on_face(riser, on, margin=0.01).tolist() == [True, False, False, False, True]
    tread = torch.zeros(3, dtype=torch.int64)
    on = points((50, 50, 0), (50, 95, 0), (5, 50, 0))
    assert jig.is_on_face(tread, on).all()
    assert jig.is_on_face(tread, on, margin=0.01).tolist() == [True, False, False]
    assert jig.is_on_face(tread[:0], on[:0]).tolist() == []


def test_lines_intersect_blocks(tmp_path: Path):
    jig = load(tmp_path, STAIRS)
    start = points((50, 50, 60), (50, 50, 51), (50, 50, 51), (50, 50, 51), (50, -10, 25), (50, 50, 50))
    end = points((50, 50, 500), (50, 500, 51), (50, -500, 51), (50, 99, 300), (50, 210, 25), (500, 50, 50))
    assert jig.intersects_line(start, end).tolist() == [False, True, False, False, True, False]
    assert jig.intersects_line(end, start).tolist() == [False, True, False, False, True, False]


def test_the_jig_that_comes_with_the_package_steps_down_along_x_and_y():
    jig = Jig.load("stepped")
    assert sorted(set(jig.axis.tolist())) == [0, 1, 2]
    assert jig.face_count == 15
    assert sorted(jig.coordinate[jig.axis == 2].tolist()) == pytest.approx([0.12, 0.24, 0.36])
    assert "not published" in jig.source
    middles = torch.stack(jig.extent).mean(0)
    uncovered = jig.is_on_face(torch.arange(15), middles)
    covered = {name for name, free in zip(jig.face_names, uncovered.tolist(), strict=True) if not free}
    assert covered == {"low/+z", "middle/+z"}  # their middles are under the next step, their rims are free


@pytest.mark.parametrize(
    ("old", "new", "line", "column", "names"),
    [
        ("faces: [+z, -y]", "faces: [+w, -y]", 7, "blocks.0.faces.0", ["+w"]),
        ("faces: [+z, -y]", "faces: [-y, -y]", 4, "blocks.0", ["-y", "'low'"]),
        ("faces: [+z, -y]", "faces: [+y, -y]", 1, None, ["+y", "'low'", "'high'"]),
        ("[100, 100, 50]", "[100, 0, 50]", 6, "blocks.0.size_mm.1", []),
        ("[100, 100, 50]", "[100, 101, 50]", 1, None, ["'low'", "'high'", "size_mm"]),
        ("name: high", "name: low", 1, None, ["'low'"]),
        ("corner_mm: [0, 0, 0]", "corners_mm: [0, 0, 0]", 5, "blocks.0.corners_mm", ["'corner_mm'"]),
        ("source: ours\n", "", 1, "source", []),
    ],
)
def test_refuses_invalid_jigs(
    tmp_path: Path, old: str, new: str, line: int, column: str | None, names: list[str]
):
    with refused(MeasurementError, file=tmp_path / "jig.yaml", line=line, column=column) as caught:
        load(tmp_path, STAIRS.replace(old, new, 1))
    assert all(name in str(caught.value) for name in names)


def test_refuses_a_jig_without_faces(tmp_path: Path):
    text = STAIRS.replace("faces: [+z, -y]", "faces: []").replace("faces: [-y, +z]", "faces: []")
    with refused(MeasurementError, file=tmp_path / "jig.yaml") as caught:
        load(tmp_path, text)
    assert "'faces'" in str(caught.value)


def test_refuses_an_unknown_jig():
    with refused(MeasurementError, option="jig", value="steped") as caught:
        Jig.load("steped")
    assert "'stepped'" in caught.value.remedy
