"""Entries in a history about exported files, and about the file that is active on the controller."""

from dataclasses import dataclass
from typing import Literal

Contents = Literal["joint_values", "poses", "description", "kinematics", "joint_zeros"]
"""Contents of an exported file: corrected joint values (or the means to compute them), corrected poses for a
controller that computes with the nominal robot, a description of the robot for other programs, the kinematics with
which a controller converts joint values to poses, or the zeros of the joints on a controller."""
ON_CONTROLLER: tuple[Contents, ...] = ("kinematics", "joint_zeros")
"""Contents that are active on a controller as soon as they are entered."""


@dataclass(frozen=True)
class ExportEntry:
    """A file that was exported from a model.

    Attributes:
        file: name of the file.
        sha256: SHA-256 of the file.
        format: its `--format`.
        contains: contents of the exported file, see `Contents`.
        model: name of the model.
        exported: time of the export (ISO 8601, UTC).
    """

    file: str
    sha256: str
    format: str
    contains: Contents
    model: str
    exported: str


@dataclass(frozen=True)
class ControllerEntry:
    """A change of the exports that are active on the controller.

    Attributes:
        day: day from which the export is active (ISO 8601).
        sha256: SHA-256 of the exported file; empty if no export is active from then on.
        note: free text.
        recorded: time of recording (ISO 8601, UTC).
    """

    day: str
    sha256: str
    note: str
    recorded: str
