"""Calibrate several arms that measured the same objects, and find their bases relative to each other.

The arms are given in Python, or by the `cell.yaml` of a cell that lists them.
"""

import os
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch
from jaxtyping import Float64
from pydantic import Field
from torch import Tensor

from pisigma.calibration.frames.arm_bases import ArmBases, fit_arm_bases
from pisigma.calibration.frames.shared_objects import ArmPosterior, Postures, Touches, uncertainty_of
from pisigma.calibration.geometric.initial_guess.initial_guess import randomly_chosen_rows
from pisigma.files.errors import (
    AcceptanceError,
    IdentificationError,
    MeasurementError,
    OutputError,
    Place,
    PlanningError,
)
from pisigma.files.model_files import model_hash
from pisigma.files.output_file import write_atomically, write_failure
from pisigma.files.progress import Progress
from pisigma.files.scratch import FOLDER, scratch_beside
from pisigma.files.yaml_file import Section, read_yaml
from pisigma.files.yaml_writing import yaml_text
from pisigma.lifetime.cell.layout import CELL_FILE, MODELS
from pisigma.measurement.camera.corner_file import MeasurementFiles, read_rows
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import corrected_joints
from pisigma.robot.description import Robot
from pisigma.validation.held_out.arms_summary import ArmsSummary, arms_summary, indeterminate_sum_sentences
from pisigma.validation.held_out.trained_calibrations import geometric_result
from pisigma.workflow.arms.torso import torso_joints, torso_settings, with_common_joints
from pisigma.workflow.calibrate import Calibration, calibrate
from pisigma.workflow.cell.cell_file import CameraSection, CellDocument, CellFile, path_inside_cell
from pisigma.workflow.cell.new_files import save_under_new_name
from pisigma.workflow.settings.calibration import CalibrationSettings

FRAMES_FILE = "frames.yaml"
"""File with the bases of the arms relative to each other, next to the folders of their models."""
_MAX_POSTURES = 200
"""Number of postures of every arm at which the distances between tools are evaluated."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


@dataclass(frozen=True)
class Arm:
    """An arm and its rows.

    Attributes:
        name: name of the arm: letters, digits, "_" and "-".
        robot: the nominal robot, or its catalogue name or robot file.
        data: measurements, or CSV files of them. Objects that other arms also measured have the same name in all rows:
            a board, jig or instrument in the column `frame`, sockets in `socket`, anchors in `anchor`.
        settings: settings of the calibration of the arm.
        touches: rows in which its tip touched that of another arm: joint values, name of the touch in the column
            `socket`, `sigma_mm`, and the name of the tip in the column `target`; None without touches.
    """

    name: str
    robot: Robot | str | os.PathLike[str]
    data: Measurements | MeasurementFiles
    settings: CalibrationSettings = field(default_factory=CalibrationSettings)
    touches: Measurements | MeasurementFiles | None = None


@dataclass(frozen=True, eq=False)
class ArmsCalibration:
    """Result of `calibrate_arms`.

    Attributes:
        calibrations: calibration of every arm, by name of the arm.
        bases: bases of the arms, with covariances in SI units.
        summary: figures of the bases.
        seconds: computing time [s].
    """

    calibrations: dict[str, Calibration]
    bases: ArmBases
    summary: ArmsSummary
    seconds: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on values that are known only as sums of bases and tools, and warnings with names of arms."""
        return self.summary.indeterminate_sums + tuple(
            f"{name}: {sentence}" for name, one in self.calibrations.items() for sentence in one.warnings
        )

    @property
    def trusted(self) -> bool:
        """Whether no check found an arm implausible and the arms agree on shared objects."""
        return not self.summary.diagnostics and all(one.trusted for one in self.calibrations.values())

    def to_json(self) -> dict[str, Any]:
        """Return all figures as JSON values, in mm and deg."""
        return {
            "seconds": round(self.seconds, 3),
            **self.summary.to_json(),
            "models": {name: one.to_json() for name, one in self.calibrations.items()},
        }

    def save(
        self, folder: str | os.PathLike[str], command: str | None = None, accept_implausible: bool = False
    ) -> ArmsSummary:
        """Write a folder with the model folder of every arm and `frames.yaml`, completely or not at all.

        Args:
            folder: folder to write; it must not exist, or must be empty.
            command: command that made the models, for their cards. None: the Python calls.
            accept_implausible: whether to also write a result that must not be trusted; `frames.yaml` and the cards
                state the reason.

        Returns:
            The figures as written, with the hashes of the models.

        Raises:
            AcceptanceError: an arm is implausible, or the arms disagree.
            OutputError: the folder is not empty, or cannot be written.
        """
        if not (self.trusted or accept_implausible):
            raise AcceptanceError(
                "the result must not be trusted and was not written",
                at=Place(folder),
                remedy="correct what the diagnostics name, or accept implausible results explicitly "
                "(accept_implausible, --accept-implausible)",
            )
        target = Path(os.path.realpath(folder))
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with scratch_beside(target, FOLDER) as scratch:
                scratch.chmod(0o755)
                summary = self._write(scratch, command, accept_implausible)
                if target.exists() and (not target.is_dir() or any(target.iterdir())):
                    raise OutputError(
                        "the output already exists and is not empty",
                        expected="a new or empty folder",
                        at=Place(folder),
                        remedy="choose another folder",
                    )
                os.replace(scratch, target)
        except OSError as problem:
            raise write_failure(folder, problem) from None
        return summary

    def _write(self, folder: Path, command: str | None, accept_implausible: bool) -> ArmsSummary:
        written = []
        for entry, (name, one) in zip(self.summary.arms, self.calibrations.items(), strict=True):
            one.save(folder / name, command=command, accept_implausible=accept_implausible)
            written.append(entry.model_copy(update={"sha256": model_hash(folder / name)}))
        summary = self.summary.model_copy(update={"arms": tuple(written)})
        write_atomically(folder / FRAMES_FILE, yaml_text(summary.to_json()))
        return summary


def posterior_of(arm: Arm, calibration: Calibration, torso: tuple[str, ...]) -> ArmPosterior:
    """Return the posterior of a calibrated arm, that of its model or of its geometric calibration, with its touches.

    Raises:
        MeasurementError: the touches cannot be read, or lack a name or a standard deviation.
    """
    known = calibration.model.uncertainty or uncertainty_of(geometric_result(calibration.result))
    if arm.touches is None:
        return ArmPosterior(arm.name, known, torso_joints=torso)
    rows = read_rows(arm.touches, calibration.model.robot)
    for column, stated in (
        ("socket", rows.is_measured("socket")),
        (
            "sigma_position",
            torch.zeros(rows.rows) if rows.sigma_position is None else rows.sigma_position > 0,
        ),
    ):
        if not bool(stated.all()):
            raise MeasurementError(
                "a touch has no name in the column 'socket' or no standard deviation in the column 'sigma_mm'",
                expected="both in every row",
                at=rows.place_of(int(stated.long().argmin()), column),
                remedy="state the same name in the row of the other arm, and the play of the tips as 'sigma_mm'",
            )
    touches = Touches.from_measurements(rows, corrected_joint_values(calibration, rows))
    return ArmPosterior(arm.name, known, touches, torso)


def corrected_joint_values(calibration: Calibration, rows: Measurements) -> Float64[Tensor, "rows dof"]:
    """Return the joint values of rows with their corrections [rad or m]."""
    hybrid = calibration.model.hybrid
    return rows.q if hybrid is None else corrected_joints(hybrid, rows)


def postures_of(calibration: Calibration) -> Postures:
    """Return the postures of some rows of a calibration, in random order."""
    rows = calibration.rows.select(randomly_chosen_rows(calibration.rows.rows, _MAX_POSTURES))
    return Postures(JointState.from_measurements(rows), corrected_joint_values(calibration, rows))


def calibrate_arms(arms: Sequence[Arm], progress: Progress = lambda what: None) -> ArmsCalibration:
    """Calibrate every arm with its own rows, and find the bases of the arms relative to each other.

    Every arm is calibrated as by `calibrate`. The bases then follow from the shared objects, see `fit_arm_bases`. The
    models are those of the arms' own rows; information that one arm has about another is used only for the bases. Arms
    of one torso (of one URDF file, with the same first joints) are an exception: they have one base, and one set of
    parameters of these joints from the rows of all of them.

    Args:
        arms: two or more arms.
        progress: called with the current step.

    Returns:
        The calibrated arms; `save` writes a model folder for each, and `frames.yaml`.

    Raises:
        RobotError: a robot is unknown.
        MeasurementError: rows cannot be read, or cannot be split as the settings require.
        IdentificationError: rows do not determine the free parameters, the arms do not share enough objects, or a name
            is not valid.
    """
    started = time.perf_counter()
    names = [arm.name for arm in arms]
    _check_names(names)
    nominal = [
        one.robot if isinstance(one.robot, Robot) else Robot.load(os.fspath(one.robot)) for one in arms
    ]
    torso = torso_joints(names, nominal)
    found = {}
    for arm, robot in zip(arms, nominal, strict=True):

        def of_arm(what: str, name: str = arm.name) -> None:
            progress(f"{name}: {what}")

        settings = torso_settings(arm.name, arm.settings) if torso[arm.name] else arm.settings
        found[arm.name] = calibrate(robot, arm.data, settings, of_arm)
    bases = fit_arm_bases([posterior_of(arm, found[arm.name], torso[arm.name]) for arm in arms])
    updated = bases.updated_arms if any(torso.values()) else ()
    found |= {one.name: with_common_joints(found[one.name], one) for one in updated if torso[one.name]}
    robots = tuple(one.model.robot.name for one in found.values())
    sums = tuple(
        sentence
        for name, one in found.items()
        for sentence in indeterminate_sum_sentences(name, geometric_result(one.result))
    )
    summary = arms_summary(bases, robots, tuple(map(postures_of, found.values())), sums)
    return ArmsCalibration(found, bases, summary, time.perf_counter() - started)


def _check_names(names: Sequence[str]) -> None:
    """Refuse fewer than two arms, and names that are invalid or appear twice.

    Raises:
        IdentificationError: there are fewer than two arms, or a name is invalid or appears twice.
    """
    if len(names) < 2:
        raise IdentificationError(
            expected="two or more arms", value=len(names), option="arms", remedy="use `calibrate` for one arm"
        )
    for number, name in enumerate(names):
        if not _NAME.fullmatch(name) or name in names[:number]:
            raise IdentificationError(
                expected='unique names of letters, digits, "_" and "-"', value=name, option="arms"
            )


class ArmSection(Section):
    """An arm of a cell; its files are inside the cell.

    Attributes:
        robot: catalogue name, or a robot file (YAML or URDF).
        base: base link of the URDF file; None for its root.
        tip: tool link of the URDF file; None for its only leaf link.
        sessions: measurement files (CSV) of the arm.
        touches: files of rows in which its tip touched that of another arm.
        camera: cameras and boards; None without cameras.
    """

    robot: str
    base: str | None = None
    tip: str | None = None
    sessions: Annotated[tuple[str, ...], Field(min_length=1)]
    touches: tuple[str, ...] = ()
    camera: CameraSection | None = None


class ArmsDocument(Section):
    """The content of a `cell.yaml` of several arms.

    Attributes:
        arms: the arms by name; the bases of the others are relative to that of the first.
        calibrate: settings of `pisigma calibrate` of every arm.
    """

    arms: dict[str, ArmSection]
    calibrate: dict[str, Any] | None = None


def arms_of_cell(folder: str | os.PathLike[str], **overrides: Any) -> tuple[Arm, ...]:
    """Read the arms of a cell.

    Args:
        folder: folder of the cell.
        **overrides: settings of the calibration that override the file, by its keys.

    Raises:
        PlanningError: `cell.yaml` is not valid, or a file is outside the cell.
        PisigmaError: a robot cannot be loaded, or a setting is not valid.
    """
    path = Path(folder) / CELL_FILE
    document = read_yaml(path, ArmsDocument, PlanningError)
    arms: list[Arm] = []
    for name, arm in document.arms.items():
        one = CellDocument(
            robot=arm.robot, base=arm.base, tip=arm.tip, camera=arm.camera, calibrate=document.calibrate
        )
        file = CellFile(path, one)
        rows, touches = (
            [path_inside_cell(Path(folder), session) for session in those]
            for those in (arm.sessions, arm.touches)
        )
        robot = Robot.load(file.robot, arm.base, arm.tip)
        settings = file.settings_of_step("calibrate", **overrides)
        arms.append(Arm(name, robot, rows, settings, touches or None))
    return tuple(arms)


def calibrate_arms_of_cell(
    folder: str | os.PathLike[str],
    progress: Progress = lambda what: None,
    accept_implausible: bool = False,
    **overrides: Any,
) -> tuple[ArmsCalibration, Path | None]:
    """Calibrate the arms of a cell, and write `models/DAY/ARM` for each and `models/DAY/frames.yaml`.

    Args:
        folder: folder of the cell.
        progress: called with the current step.
        accept_implausible: whether to also store a result that must not be trusted.
        **overrides: settings that override the file, by its keys.

    Returns:
        The calibration, and the folder with the models, which is None if the result must not be trusted and was not
        stored.

    Raises:
        PisigmaError: see `arms_of_cell` and `calibrate_arms`.
    """
    found = calibrate_arms(arms_of_cell(folder, **overrides), progress)
    if not (found.trusted or accept_implausible):
        return found, None
    save = partial(found.save, accept_implausible=accept_implausible)
    return found, save_under_new_name(Path(folder) / MODELS, save, ())
