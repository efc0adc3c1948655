"""Plan files: writing, reading, and faults with file and line."""

from pathlib import Path

import pytest
import torch
from testing.cells import CELL
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError, PlanningError
from pisigma.planning.candidates import draw_candidates
from pisigma.planning.plan_file import StoredPlan, read_plan
from pisigma.planning.plan_inputs import instrument_of
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.robot import Robot

ARM = ArmInSurroundings.from_robot(Robot.load("fanuc_r2000"), CELL)
CANDIDATES = draw_candidates(ARM, 6, 0)


@pytest.fixture
def stored(tmp_path: Path) -> StoredPlan:
    points = (CANDIDATES.q[:0], CANDIDATES.q[4:6], *(CANDIDATES.q[:0] for _ in range(2)))
    settings = PlanSettings(
        count=3,
        check=1,
        sigma_mm=0.03,
        box_mm=(-900.0, -900.0, 0.0, 900.0, 900.0, 900.0),
        measured=str(tmp_path / "rows.csv"),
    )
    check = torch.tensor([False, True, False, False])
    plan = StoredPlan(
        ARM, settings, tmp_path / "model", CANDIDATES.q[:4], check, CANDIDATES.number[:4], points
    )
    plan.write(tmp_path / "poses.csv")
    return plan


@pytest.mark.parametrize("name", ["poses.csv", "poses.plan.yaml"])
def test_a_plan_is_the_same_after_writing_and_reading(stored: StoredPlan, tmp_path: Path, name: str):
    read = read_plan(tmp_path / name)
    assert read.settings == stored.settings
    assert read.arm.surroundings == stored.arm.surroundings
    assert read.model == stored.model
    assert_close(read.arm.robot.dh, ARM.robot.dh, atol=1e-12)
    assert_close(read.q, stored.q, atol=1e-8)
    assert read.is_test_pose.tolist() == [False, True, False, False]
    assert read.candidate_number.tolist() == stored.candidate_number.tolist()
    for points, written in zip(read.waypoints, stored.waypoints, strict=True):
        assert_close(points, written, atol=1e-8)


def test_the_poses_are_in_their_order(stored: StoredPlan, tmp_path: Path):
    header, *rows = (tmp_path / "poses.csv").read_text().splitlines()
    assert header == "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,set,order,candidate"
    assert [row.split(",")[6:8] for row in rows] == [
        ["train", "1"],
        ["test", "2"],
        ["train", "3"],
        ["train", "4"],
    ]


def test_a_table_without_its_plan_is_refused(stored: StoredPlan, tmp_path: Path):
    (tmp_path / "poses.plan.yaml").unlink()
    with refused(PlanningError, file="poses.csv", value="poses.plan.yaml"):
        read_plan(tmp_path / "poses.csv")


def test_faults_of_the_files_are_named(stored: StoredPlan, tmp_path: Path):
    csv, yaml = tmp_path / "poses.csv", tmp_path / "poses.plan.yaml"
    text = yaml.read_text()
    yaml.write_text(text.replace("sensor: position", "sensor: lidar"))
    with refused(PlanningError, file="poses.plan.yaml", value="lidar"):
        read_plan(csv)
    yaml.write_text(text)
    csv.write_text(csv.read_text().replace(",order", ",number"))
    with refused(MeasurementError, file="poses.csv", line=1, column="order"):
        read_plan(csv)


@pytest.mark.parametrize(
    ("stated", "option", "value"),
    [
        ({"sensor": "lidar"}, "sensor", "lidar"),
        ({"criterion": "A"}, "criterion", "A"),
        ({"count": 0}, "count", 0),
        ({"sigma_mm": -1.0}, "sigma_mm", -1.0),
        ({"box_mm": (0, 0, 0, 1, -1, 1)}, "box_mm", "0, 0, 0, 1, -1, 1"),
        ({"settling_s": -1.0}, "settling", "-1 s"),
    ],
)
@pytest.mark.usefixtures("without_type_checker")
def test_invalid_settings_are_refused(stated: dict[str, object], option: str, value: object):
    with refused(PlanningError, option=option, value=value):
        PlanSettings(**stated)  # type: ignore[arg-type]


def test_the_origin_of_distances_has_to_be_stated():
    with refused(PlanningError, option="--surroundings"):
        instrument_of(PlanSettings(sensor="distance"))
