"""Entries of a history on exported files, and on which of them is active on the controller."""

from dataclasses import dataclass
from typing import Literal

Changes = Literal["joint_zeros", "kinematics", "nothing"]
"""What an exported file changes on a controller: what its joint values mean, the kinematics with which it converts
joint values to poses, or nothing, because robot programs or other programs use the file."""


@dataclass(frozen=True)
class ExportEntry:
    """A file that was exported from a model.

    Attributes:
        file: path to which it was written.
        sha256: SHA-256 of the file.
        format: its `--format`.
        changes: what it changes on a controller.
        model: name of the model.
        exported: time at which it was written (ISO 8601, UTC).
    """

    file: str
    sha256: str
    format: str
    changes: Changes
    model: str
    exported: str


@dataclass(frozen=True)
class ControllerEntry:
    """A change of the export that is active on the controller.

    Attributes:
        day: day from which it is active (ISO 8601).
        sha256: SHA-256 of the exported file; empty if no export is active any more.
        note: free text.
        recorded: time at which it was recorded (ISO 8601, UTC).
    """

    day: str
    sha256: str
    note: str
    recorded: str
