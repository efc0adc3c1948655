"""Plan files: a CSV file with the poses, and a YAML file next to it with all data for replanning."""

import csv
import io
import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float64, Int64
from pydantic import Field
from torch import Tensor

from pisigma.files.errors import MeasurementError, Place, PlanningError
from pisigma.files.output_file import write_atomically
from pisigma.files.yaml_file import Section, read_yaml
from pisigma.files.yaml_writing import yaml_text
from pisigma.measurement.csv.columns import PLAN_COLUMNS
from pisigma.measurement.csv.reading import read_joints
from pisigma.measurement.csv.table import Table, read_table
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.planning.surroundings.surroundings import Surroundings
from pisigma.robot.description import Robot
from pisigma.robot.robot_file import RobotDocument
from pisigma.robot.row import BoundedFloat
from pisigma.robot.writing import robot_document

YAML_SUFFIX = ".plan.yaml"
"""Suffix of the YAML file of a plan, such as `poses.plan.yaml` for `poses.csv`."""


class Waypoint(Section):
    """Joint values through which the robot moves to a pose.

    Attributes:
        before_pose: number of the pose, in the order of the plan; `before` in the file.
        joints: joint values [deg, or mm for prismatic joints].
    """

    before_pose: int = Field(ge=1, alias="before")
    joints: tuple[BoundedFloat, ...]


class PlanDocument(Section):
    """Content of the YAML file of a plan.

    Attributes:
        poses_file: name of the CSV file in the same folder; `poses` in the file.
        robot: nominal robot.
        model: folder of the planned model, relative to this file; None for a nominal robot.
        settings: settings of the plan, with paths relative to this file.
        cell: surroundings of the robot.
        way_points: waypoints between poses whose straight joint motion is not free.
    """

    poses_file: str = Field(alias="poses")
    robot: RobotDocument
    model: str | None = None
    settings: PlanSettings
    cell: Surroundings = Surroundings()
    way_points: tuple[Waypoint, ...] = ()


@dataclass(frozen=True, eq=False)
class StoredPlan:
    """Poses in the order of measurement, with the settings, robot and surroundings of the plan.

    Attributes:
        arm: the robot in its surroundings.
        settings: settings of the plan, with paths relative to the working directory.
        model: folder of the planned model; None for a nominal robot.
        q: joint values [rad or m].
        is_test_pose: whether each pose tests the calibration (set "test") or is used for it ("train").
        candidate_number: row of each pose in the file of candidates, or its number among the random poses; from 1.
        waypoints: joint values through which the robot moves to each pose [rad or m]; usually none.
        number: number of each pose, which is kept in parts of the plan; () if numbers start at 1.
    """

    arm: ArmInSurroundings
    settings: PlanSettings
    model: Path | None
    q: Float64[Tensor, "poses dof"]
    is_test_pose: Bool[Tensor, " poses"]
    candidate_number: Int64[Tensor, " poses"]
    waypoints: tuple[Float64[Tensor, "_points dof"], ...]
    number: tuple[int, ...] = ()

    @property
    def numbers(self) -> tuple[int, ...]:
        """Number of each pose."""
        return self.number or tuple(range(1, len(self.q) + 1))

    def select_poses(self, poses: Int64[Tensor, " some"]) -> "StoredPlan":
        """Return some of the poses, which keep their numbers."""
        return replace(
            self,
            q=self.q[poses],
            is_test_pose=self.is_test_pose[poses],
            candidate_number=self.candidate_number[poses],
            waypoints=tuple(self.waypoints[pose] for pose in poses.tolist()),
            number=tuple(self.numbers[pose] for pose in poses.tolist()),
        )

    def write(self, path: Path) -> None:
        """Write the CSV file and the YAML file next to it; existing files are replaced.

        Raises:
            OutputError: a file cannot be written.
        """
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([*joint_columns(self.arm.robot), "set", *PLAN_COLUMNS])
        sets = ["test" if check else "train" for check in self.is_test_pose.tolist()]
        rows = zip(self._in_file_units(self.q), sets, self.candidate_number.tolist(), strict=True)
        for order, (joints, name, candidate) in zip(self.numbers, rows, strict=True):
            writer.writerow([*joints, name, order, candidate])
        write_atomically(path, text.getvalue())
        write_atomically(yaml_of(path), yaml_text(self._document(path)))

    def _in_file_units(self, q: Float64[Tensor, "poses dof"]) -> list[list[float]]:
        """Return the controller's values [deg or mm], rounded to the digits that controllers accept."""
        robot = self.arm.robot
        return [
            [round(axis.in_file_unit(value), 6) for axis, value in zip(robot.axes, row, strict=True)]
            for row in robot.to_controller(q).tolist()
        ]

    def _document(self, path: Path) -> dict[str, Any]:
        """Return the content of the YAML file, without values that are not stated."""
        folder = path.resolve().parent
        seen = self.settings.with_files(lambda path: os.path.relpath(path, folder))
        settings = {name: value for name, value in asdict(seen).items() if value is not None}
        settings |= {"box_mm": list(self.settings.box_mm)} if self.settings.box_mm is not None else {}
        document: dict[str, Any] = {"poses": path.name, "settings": settings}
        if self.model is not None:
            document["model"] = os.path.relpath(self.model, folder)
        document["cell"] = self.arm.surroundings.model_dump(mode="json", exclude_none=True)
        points = zip(self.numbers, map(self._in_file_units, self.waypoints), strict=True)
        document["way_points"] = [{"before": n, "joints": joints} for n, rows in points for joints in rows]
        return document | {"robot": robot_document(self.arm.nominal)}


def joint_columns(robot: Robot) -> list[str]:
    """Return the names of the columns of the controller's values, such as q1_deg."""
    return [f"q{number}_{axis.file_unit}" for number, axis in enumerate(robot.axes, start=1)]


def yaml_of(path: Path) -> Path:
    """Return the path of the YAML file that belongs to the CSV file of a plan."""
    return path.with_suffix(YAML_SUFFIX)


def read_plan(path: str | os.PathLike[str]) -> StoredPlan:
    """Return the plan in a CSV file or a YAML file.

    Raises:
        PlanningError: the YAML file is missing or cannot be used.
        MeasurementError: the CSV file cannot be used.
    """
    file = Path(path)
    if file.suffix.lower() == ".csv":
        if not yaml_of(file).exists():
            raise PlanningError(
                f"expected a plan, but there is no {yaml_of(file).name} next to this file",
                expected="a plan",
                value=yaml_of(file).name,
                at=Place(file),
                remedy="give the CSV file that `pisigma plan` wrote, and keep its YAML file next to it",
            )
        file = yaml_of(file)
    document = read_yaml(file, PlanDocument, PlanningError)
    arm = ArmInSurroundings.from_robot(Robot(*document.robot.to_fields()), document.cell)
    poses = file.parent / document.poses_file
    table, q = read_table(poses), read_joints(poses, arm.robot)
    order = _numbers(table, "order")
    axes = arm.robot.axes
    scale = torch.tensor([axis.from_file_unit(1.0) for axis in axes], dtype=torch.float64)
    return StoredPlan(
        arm,
        document.settings.with_files_from(file.parent),
        None if document.model is None else file.parent / document.model,
        q,
        torch.tensor([name == "test" for name in _cells(table, "set")]),
        torch.tensor(_numbers(table, "candidate")),
        tuple(
            arm.robot.to_dh(
                torch.tensor(
                    [point.joints for point in document.way_points if point.before_pose == number],
                    dtype=torch.float64,
                ).reshape(-1, len(axes))
                * scale
            )
            for number in order
        ),
        tuple(order),
    )


def _cells(table: Table, name: str) -> list[str]:
    """Return the cells of a column of a plan."""
    if name not in table.header:
        raise MeasurementError(
            "the column is missing",
            at=Place(table.source, table.header_line, name),
            remedy="give the poses as `pisigma plan` wrote them",
        )
    column = table.header.index(name)
    return [row[column].strip() if column < len(row) else "" for row in table.records]


def _numbers(table: Table, name: str) -> list[int]:
    """Return the cells of a column of numbers from 1."""
    cells = _cells(table, name)
    for line, cell in zip(table.lines, cells, strict=True):
        if not (cell.isascii() and cell.isdigit() and int(cell) >= 1):
            raise MeasurementError(
                expected="an integer >= 1",
                value=cell,
                at=Place(table.source, line, name),
                remedy="give the poses as `pisigma plan` wrote them",
            )
    return list(map(int, cells))
