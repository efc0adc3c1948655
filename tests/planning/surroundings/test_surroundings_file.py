"""Cell files, and their faults with file, line and key."""

from pathlib import Path

import pytest
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import PlanningError
from pisigma.planning.surroundings.surroundings import read_surroundings
from pisigma.robot import Robot

ROBOT = Robot.load("ur10")


def _read(tmp_path: Path, text: str) -> object:
    path = tmp_path / "cell.yaml"
    path.write_text(text)
    return read_surroundings(path, ROBOT)


def test_stated_limits_and_margins_narrow_the_range(tmp_path: Path):
    path = tmp_path / "cell.yaml"
    path.write_text("joints:\n  margin_deg: 10\n  limits_deg: {theta_2: [-180, 0], theta_3: [-400, 170]}\n")
    limits = read_surroundings(path, ROBOT).joints.limits(ROBOT).rad2deg()
    assert_close(limits[:3], [[-350.0, 350.0], [-170.0, -10.0], [-350.0, 160.0]], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "line", "column", "value"),
    [
        ("floor: 0", 1, "floor", "floor"),
        ("boxes:\n- {name: a, size_mm: [1, 2, 3]}", 2, "boxes.0.center_mm", None),
        ("boxes:\n- {name: a, center_mm: [0, 0, 0], size_mm: [1, 2, -3]}", 2, "boxes.0.size_mm.2", -3),
        ("clearance_mm: wide", 1, "clearance_mm", "wide"),
        ("\n\njoints:\n  limits_deg: {theta_9: [0, 1]}", 3, "joints", "theta_9"),
        ("joints: {limits_deg: {theta_1: [0, 1]}, margin_deg: 5}", 1, "joints", "theta_1"),
        ("links:\n  radii_mm: {elbow: 50}", 2, "links.radii_mm.elbow", "elbow"),
        ("reflector: {}", 1, None, None),
        ("reflector: {axis: [0, 0, 0]}\ntracker: {x_mm: 1, y_mm: 0, z_mm: 0}", 1, "reflector", None),
        (
            "tracker: {x_mm: 1, y_mm: 0, z_mm: 0}\nboxes:\n- {name: a, center_mm: [0, 0, 0], size_mm: [9, 9, 9]}",
            1,
            None,
            None,
        ),
    ],
)
def test_faults_are_reported_with_line_and_key(
    tmp_path: Path, text: str, line: int, column: str | None, value: object
):
    with refused(PlanningError, file="cell.yaml", line=line, column=column, value=value):
        _read(tmp_path, text)
