"""Write the folder of a new cell, completely or not at all."""

import datetime
import math
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pisigma.files.errors import ModelError, OutputError, Phrase, PisigmaError, Place
from pisigma.files.model_files import DESCRIPTION, model_hash
from pisigma.files.output_file import write_atomically
from pisigma.files.scratch import FOLDER, remove_stale_scratch, scratch_beside
from pisigma.lifetime.cell.history import HISTORY, History, InUse, ModelEntry, now
from pisigma.lifetime.cell.layout import CELL_FILE, EXPORTS, MODELS, PLANS, REPORTS, SESSIONS
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.dates import is_date
from pisigma.model.folder.model_folder import load_model
from pisigma.model.model_posterior import FLEET_PRIOR
from pisigma.robot.description import Robot
from pisigma.robot.robot_file import robot_file
from pisigma.robot.writing import robot_to_yaml
from pisigma.workflow.cell.cell_file import CellFile, cell_template


@dataclass(frozen=True)
class NewCell:
    """Contents of a new cell.

    Attributes:
        robot: the nominal robot, a catalogue name, or a robot file (YAML or URDF), which is copied into the cell.
        sensor: "tracker", "camera", "sockets", "draw-wire" or "touch".
        limit_mm: limit on the 95 % quantile of the position errors [mm]; None for no limit.
        base: base link of the URDF file; poses are in its frame. None for its root.
        tip: tool link of the URDF file; None for its only leaf link.
        cameras: cameras and boards, whose files are copied into the cell.
        calibrate: settings of `pisigma calibrate`, by key, for a short `cell.yaml`; None for a `cell.yaml` that lists
            all settings of all steps as comments.
        sessions: files of rows, by their names in `sessions/`.
        model: a model folder, which is copied into the cell.
    """

    robot: Robot | str
    sensor: str = "tracker"
    limit_mm: float | None = None
    base: str | None = None
    tip: str | None = None
    cameras: CameraFiles | None = None
    calibrate: Mapping[str, Any] | None = None
    sessions: tuple[tuple[str, Path], ...] = ()
    model: Path | None = None

    def write(self, folder: Path) -> None:
        """Write the cell into a folder that does not exist or is empty.

        Raises:
            OutputError: the folder already exists and is not empty, or cannot be written.
            RobotError: there is no such robot.
            PlanningError: a value is not valid.
        """
        if isinstance(self.robot, str):
            Robot.load(self.robot, self.base, self.tip)
        target = Path(os.path.realpath(folder))
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            raise OutputError(
                "the folder already exists and is not empty", at=Place(folder), remedy="choose another --out"
            )
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            remove_stale_scratch(target)
            with scratch_beside(target, FOLDER) as scratch:
                self._fill(scratch)
                scratch.chmod(0o755)
                if target.is_dir():
                    target.rmdir()
                os.replace(scratch, target)
        except OSError as problem:
            raise OutputError(f"the cell cannot be written: {problem.strerror}", at=Place(folder)) from None

    def _fill(self, folder: Path) -> None:
        """Write all files of the cell."""
        for part in (PLANS, SESSIONS, MODELS, EXPORTS, REPORTS):
            (folder / part).mkdir()
        known: dict[str, Any] = {
            "robot": self._copied_robot(folder),
            "base": self.base,
            "tip": self.tip,
            "sensor": self.sensor,
            "limit_mm": self.limit_mm,
        }
        if self.cameras is not None:
            known["camera"] = _copied(self.cameras, folder)
        for name, file in self.sessions:
            shutil.copyfile(file, folder / SESSIONS / f"{name}.csv")
        if self.model is not None:
            self._add_model(self.model, folder)
        write_atomically(folder / CELL_FILE, cell_template(known, self.calibrate))
        try:
            CellFile.read(folder)
        except PisigmaError as problem:  # the file is temporary, so its path is not stored
            texts = {name: getattr(problem, name) for name in ("expected", "value", "remedy")}
            raise type(problem)(problem.problem, option=str(problem.column or ""), **texts) from None

    def _add_model(self, model: Path, folder: Path) -> None:
        """Copy a model folder and put the model into use, unless the model must not be trusted."""
        name, made = (
            model.resolve().name,
            datetime.datetime.fromtimestamp((model / DESCRIPTION).stat().st_mtime),
        )
        shutil.copytree(model, folder / MODELS / name)
        day = min((made.date().isoformat(), *(one for one, _ in self.sessions if is_date(one))))
        loaded = load_model(model)
        findings = loaded.metrics.get("diagnostics", ())
        doubt = next((one["sentence"] for one in findings if one["severity"] == "implausible"), "")
        remark = doubt or "in use before the cell was created"
        entry = ModelEntry(
            name,
            model_hash(model),
            made.astimezone(datetime.timezone.utc).isoformat("T", "milliseconds"),
            "",
            day,
            remark=remark,
            has_posterior=loaded.uncertainty is not None,
        )
        History(folder / HISTORY).add(entry, *([] if doubt else [InUse(name, now(), remark)]))

    def _copied_robot(self, folder: Path) -> str:
        """Copy or write the robot file into the cell; return the entry `robot`."""
        if isinstance(self.robot, Robot):
            (folder / "robot.yaml").write_text(robot_to_yaml(self.robot), encoding="utf-8")
            return "robot.yaml"
        if (description := robot_file(self.robot)) is None:
            return self.robot
        name = f"robot{description.suffix.lower()}"
        shutil.copyfile(description, folder / name)
        return name


def cell_from_model(model: Path, cell: NewCell) -> NewCell:
    """Return a cell with a model folder and the robot of the model.

    Raises:
        ModelError: the folder does not contain a model of one robot.
    """
    loaded = load_model(model)
    if loaded.kind == FLEET_PRIOR:
        raise ModelError(
            expected="the model of one robot",
            value=Phrase("the prior of a fleet"),
            at=Place(model),
            remedy="create a cell with `pisigma new ROBOT`, and calibrate it with --prior",
        )
    return replace(cell, robot=loaded.robot, base=None, tip=None, model=model)


def _copied(cameras: CameraFiles, folder: Path) -> dict[str, Any]:
    """Copy the files of cameras and boards into the cell; return the section `camera`.

    Raises:
        OutputError: two files have the same name, or a file has the name of another file of the cell.
    """
    for path in cameras.files:
        if (folder / Path(path).name).exists() or Path(path).name == CELL_FILE:
            raise OutputError(
                "expected unique names for the files of a cell",
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
