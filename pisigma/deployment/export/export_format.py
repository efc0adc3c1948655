"""Export formats, requests and results."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from pisigma.lifetime.cell.exports import Contents

if TYPE_CHECKING:
    from pisigma.model.calibrated_model import CalibratedModel


@dataclass(frozen=True)
class ExportRequest:
    """Request for an export; options that are not given are None.

    Attributes:
        model: model folder.
        out: file to write.
        like: file whose other content is kept; for urdf, mjcf and xacro, a URDF file, by default the one in the model
            folder; for mjcf, also an MJCF file.
        tip: link of the tool in `like`.
        geometry: "geometric" or "hybrid", for urdf, mjcf and dh.
        poses: file of poses, for targets.
        targets: "joints" or "cartesian", for targets.
        branch: branch to use instead of the trained branch, for targets.
        config: configuration of the arm, for Cartesian targets of FANUC.
        program: existing program whose targets are rewritten.
        frames: file of frames and tools that `program` does not state.
        tolerance_mm: largest deviation of the tool from a straight line between waypoints of `program` [mm].
        counts_per_turn: comma-separated encoder counts per turn of every joint, for counts.
        present_counts: comma-separated current counts of the controller, for counts.
        payload_kg: mass that the robot carries [kg].
        temperature_c: temperature of the robot [deg C].
    """

    model: Path
    out: Path
    like: Path | None = None
    tip: str | None = None
    geometry: str | None = None
    poses: Path | None = None
    targets: str | None = None
    branch: str | None = None
    config: str | None = None
    program: Path | None = None
    frames: Path | None = None
    tolerance_mm: float | None = None
    counts_per_turn: str | None = None
    present_counts: str | None = None
    payload_kg: float | None = None
    temperature_c: float | None = None

    @property
    def stated_options(self) -> tuple[str, ...]:
        """Names of the options that are given."""
        return tuple(name for name in OPTIONS if getattr(self, name) is not None)

    @property
    def is_csv(self) -> bool:
        """Whether the file is a table."""
        return self.out.suffix.lower() == ".csv"

    @property
    def conditions(self) -> dict[str, float]:
        """Payload and temperature, if given, by column of measurement files."""
        values = {"payload_kg": self.payload_kg, "temperature_c": self.temperature_c}
        return {name: value for name, value in values.items() if value is not None}

    def load(self) -> "CalibratedModel":
        """Load the model at the given conditions.

        Raises:
            ModelError: the folder is not a model, or the model did not learn the effect of a given condition.
        """
        from pisigma.model.folder.model_folder import load_model
        from pisigma.model.stated_conditions import under_stated_conditions

        model = load_model(self.model)
        return under_stated_conditions(model, **self.conditions) if self.conditions else model


OPTIONS = (
    "like",
    "tip",
    "geometry",
    "poses",
    "targets",
    "branch",
    "config",
    "program",
    "frames",
    "tolerance_mm",
    "counts_per_turn",
    "present_counts",
    "payload_kg",
    "temperature_c",
)
"""Names of all options; every format declares the options that it accepts."""


@dataclass(frozen=True)
class Exported:
    """Content of an exported file, and a report about it.

    Attributes:
        content: content of the file, or of several files by name in a folder.
        facts: values for `--json`, by key.
        remarks: sentences for the reader of the file.
        warnings: warnings, which are printed to stderr.
        sentence_start: sentence about the written file, up to its name; "" for the contents of the format.
        sentence_end: remainder of this sentence after the file's name.
        failure: fault of the input, although the file was written; None if there is none.
        missed_limit: sentence about a missed limit, although the file was written; None if no limit is missed.
        leading_text: text that is printed first, such as a diff.
    """

    content: str | bytes | Mapping[str, bytes]
    facts: Mapping[str, object]
    remarks: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    sentence_start: str = ""
    sentence_end: str = ""
    failure: str | None = None
    missed_limit: str | None = None
    leading_text: str = ""


@dataclass(frozen=True)
class ExportFormat:
    """An export format.

    Attributes:
        name: name of the `--format`.
        contents: contents of a file, for example "a DH table".
        suffixes: suffixes of its files; () if it writes a folder.
        write: function that returns the content of a file, or raises a `PisigmaError`.
        options: options of `OPTIONS` that the format accepts.
        check: function that raises a `PisigmaError` for invalid requests before anything is loaded.
        contains: contents of its files, which determine whether a correction would be applied twice on a controller.
    """

    name: str
    contents: str
    suffixes: tuple[str, ...]
    write: Callable[[ExportRequest], Exported]
    options: frozenset[str] = field(default_factory=frozenset)
    check: Callable[[ExportRequest], None] = lambda request: None
    contains: Contents = "description"

    @property
    def title(self) -> str:
        """The contents of a file as the beginning of a sentence, without an article, for example "DH table"."""
        text = re.sub("^(an?|the) ", "", self.contents)
        return f"{text[0].upper()}{text[1:]}"

    def contents_for(self, request: ExportRequest) -> Contents:
        """Return the contents of the requested file; targets of programs may be poses instead of joint values."""
        is_pose = request.program is not None or request.targets == "cartesian"
        return "poses" if is_pose else self.contains


def model_facts(model: "CalibratedModel") -> dict[str, object]:
    """Return the model's robot and its number of joints, for `Exported.facts`."""
    return {"robot": model.robot.name, "joints": model.robot.dof}
