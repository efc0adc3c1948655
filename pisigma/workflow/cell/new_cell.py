"""Write the folder of a new cell."""

import math
import shutil
from pathlib import Path
from typing import Any

from pisigma.files.errors import OutputError, Place
from pisigma.files.output_file import write_whole
from pisigma.lifetime.cell.layout import CELL_FILE, MODELS, PLANS, SESSIONS
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.robot.description import Robot
from pisigma.robot.robot_file import robot_file
from pisigma.workflow.cell.cell_file import template


def write_new_cell(
    folder: Path,
    robot: str,
    sensor: str,
    limit_mm: float | None,
    base: str | None,
    tip: str | None,
    cameras: CameraFiles | None,
) -> None:
    """Write the folder of a new cell; see `pisigma.workflow.cell.cell.Cell.create`."""
    Robot.load(robot, base, tip)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(
            "the folder exists and is not empty", at=Place(folder), remedy="choose another --out"
        )
    known: dict[str, Any] = {
        "robot": robot,
        "base": base,
        "tip": tip,
        "sensor": sensor,
        "limit_mm": limit_mm,
    }
    try:
        for part in (PLANS, SESSIONS, MODELS):
            (folder / part).mkdir(parents=True, exist_ok=True)
        if (description := robot_file(robot)) is not None:
            known["robot"] = f"robot{description.suffix.lower()}"
            shutil.copyfile(description, folder / known["robot"])
        if cameras is not None:
            known["camera"] = _copied(cameras, folder)
        write_whole(folder / CELL_FILE, template(known))
    except OSError as problem:
        raise OutputError(f"the cell cannot be written: {problem.strerror}", at=Place(folder)) from None


def _copied(cameras: CameraFiles, folder: Path) -> dict[str, Any]:
    """Copy the files of cameras and boards into the cell; return the section `camera`.

    Raises:
        OutputError: two files have the same name, or that of another file of the cell.
    """
    for path in cameras.files:
        if (folder / Path(path).name).exists() or Path(path).name == CELL_FILE:
            raise OutputError(
                "expected different names of the files of a cell",
                value=Path(path).name,
                at=Place(path),
                remedy="rename one of them",
            )
        shutil.copyfile(path, folder / Path(path).name)
    return {
        "camera": [Path(one).name for one in cameras.cameras],
        "board": [Path(one).name for one in cameras.boards],
        "fixed_camera": cameras.is_fixed,
        "intrinsics": cameras.intrinsics,
        "repeatability_mm": cameras.repeatability.length * 1e3,
        "repeatability_deg": math.degrees(cameras.repeatability.angle),
    }
