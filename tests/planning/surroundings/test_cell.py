"""Files of cells: read, and refused with file, line and key."""

from pathlib import Path

import pytest
from testing.closeness import assert_close

from pisigma.files.errors import PlanningError
from pisigma.planning.surroundings.cell import read_cell
from pisigma.robot import Robot

ROBOT = Robot.load("ur10")


def _read(tmp_path: Path, text: str) -> object:
    path = tmp_path / "cell.yaml"
    path.write_text(text)
    return read_cell(path, ROBOT)


def test_limits_get_narrower_by_what_is_stated_and_by_margins(tmp_path: Path):
    path = tmp_path / "cell.yaml"
    path.write_text("joints:\n  margin_deg: 10\n  limits_deg: {theta_2: [-180, 0], theta_3: [-400, 170]}\n")
    limits = read_cell(path, ROBOT).joints.limits(ROBOT).rad2deg()
    assert_close(limits[:3], [[-350.0, 350.0], [-170.0, -10.0], [-350.0, 160.0]], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("floor: 0", r"cell\.yaml, line 1: unknown key 'floor' in 'the file'; did you mean 'floor_mm'"),
        ("boxes:\n- {name: a, size_mm: [1, 2, 3]}", r"line 2: the key 'center_mm' is missing"),
        ("boxes:\n- {name: a, center_mm: [0, 0, 0], size_mm: [1, 2, -3]}", r"line 2: 'boxes.0.size_mm.2'"),
        ("clearance_mm: wide", r"line 1: 'clearance_mm'"),
        ("\n\njoints:\n  limits_deg: {theta_9: [0, 1]}", r"line 3: .*theta_9"),
        (
            "joints: {limits_deg: {theta_1: [0, 1]}, margin_deg: 5}",
            r"leave nothing of the range of joint 'theta_1'",
        ),
        ("links:\n  radii_mm: {elbow: 50}", r"line 2: robot 'ur10' has no row 'elbow'"),
        ("reflector: {}", r"a reflector is seen from a tracker"),
        (
            "reflector: {axis: [0, 0, 0]}\ntracker: {x_mm: 1, y_mm: 0, z_mm: 0}",
            r"line 1: .*a direction was wanted",
        ),
        (
            "tracker: {x_mm: 1, y_mm: 0, z_mm: 0}\nboxes:\n- {name: a, center_mm: [0, 0, 0], size_mm: [9, 9, 9]}",
            r"the tracker stands inside the box 'a'",
        ),
    ],
)
def test_what_is_wrong_is_said_with_its_line(tmp_path: Path, text: str, message: str):
    with pytest.raises(PlanningError, match=message):
        _read(tmp_path, text)
