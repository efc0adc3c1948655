"""A cell of several arms: the `cell.yaml` that lists them, and the calibration of all of them."""

import os
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from pisigma.files.errors import PlanningError
from pisigma.files.progress import Progress
from pisigma.files.yaml_file import Section, place_of_key, read_yaml
from pisigma.lifetime.cell.layout import CELL_FILE, MODELS
from pisigma.robot.description import Robot
from pisigma.workflow.arms.calibrate_arms import Arm, ArmsCalibration, calibrate_arms
from pisigma.workflow.cell.cell_file import CameraSection, CellDocument, CellFile, path_inside_cell
from pisigma.workflow.cell.new_files import save_new


class ArmSection(Section):
    """An arm of a cell; its files are inside the cell.

    Attributes:
        robot: catalogue name, or a robot file (YAML or URDF).
        base: base link of the URDF file; None for its root.
        tip: tool link of the URDF file; None for its only leaf link.
        sessions: measurement files (CSV) of the arm.
        camera: cameras and boards; None without cameras.
    """

    robot: str
    base: str | None = None
    tip: str | None = None
    sessions: Annotated[tuple[str, ...], Field(min_length=1)]
    camera: CameraSection | None = None


class ArmsDocument(Section):
    """The content of a `cell.yaml` of several arms.

    Attributes:
        arms: the arms by name; the bases of the others are relative to that of the first.
        calibrate: settings of `pisigma calibrate` of every arm.
    """

    arms: dict[str, ArmSection]
    calibrate: dict[str, Any] | None = None


def arms_of_cell(folder: str | os.PathLike[str], **changed: Any) -> tuple[Arm, ...]:
    """Read the arms of a cell.

    Args:
        folder: folder of the cell.
        **changed: settings of the calibration that override the file, by its keys.

    Raises:
        PlanningError: `cell.yaml` is not valid, a file is outside the cell, or two arms of one URDF file share a joint,
            such as that of a torso.
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
        rows = [path_inside_cell(Path(folder), session) for session in arm.sessions]
        robot = Robot.load(file.robot, arm.base, arm.tip)
        for before in arms:
            _check_joints(path, before, Arm(name, robot, rows), document)
        arms.append(Arm(name, robot, rows, file.settings_of_step("calibrate", **changed)))
    return tuple(arms)


def _check_joints(path: Path, first: Arm, second: Arm, document: ArmsDocument) -> None:
    """Refuse two arms of one URDF file with a common joint, which would be calibrated twice.

    Raises:
        PlanningError: two arms have a common joint.
    """
    one, other = document.arms[first.name], document.arms[second.name]
    assert isinstance(first.robot, Robot)
    assert isinstance(second.robot, Robot)
    shared = {joint.name for joint in first.robot.joints} & {joint.name for joint in second.robot.joints}
    same_file = os.path.normpath(one.robot) == os.path.normpath(other.robot)
    if same_file and one.tip != other.tip and shared:
        raise PlanningError(
            f"arms '{first.name}' and '{second.name}' share joint '{sorted(shared)[0]}', which would be calibrated "
            "twice",
            expected="arms without common joints",
            value=sorted(shared)[0],
            at=place_of_key(path, ("arms", second.name)),
            remedy="keep this joint at rest, and state a link after it as the `base` of both arms",
        )


def calibrate_arms_of_cell(
    folder: str | os.PathLike[str],
    progress: Progress = lambda what: None,
    accept_implausible: bool = False,
    **changed: Any,
) -> tuple[ArmsCalibration, Path | None]:
    """Calibrate the arms of a cell, and write `models/DAY/ARM` for each and `models/DAY/frames.yaml`.

    Args:
        folder: folder of the cell.
        progress: called with the current step.
        accept_implausible: whether to also store a result that must not be trusted.
        **changed: settings that override the file, by its keys.

    Returns:
        The calibration, and the folder with the models, which is None if the result must not be trusted and was not
        stored.

    Raises:
        PisigmaError: see `arms_of_cell` and `calibrate_arms`.
    """
    found = calibrate_arms(arms_of_cell(folder, **changed), progress)
    if not (found.trusted or accept_implausible):
        return found, None
    save = partial(found.save, accept_implausible=accept_implausible)
    return found, save_new(Path(folder) / MODELS, save, ())
