"""What an export is: a format with its files, the options it takes, and how a model is written in it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pisigma.model.calibrated_model import CalibratedModel


@dataclass(frozen=True)
class ExportRequest:
    """What is to be exported; an option is None where it is not stated.

    Attributes:
        model: the model folder.
        out: the file to write.
        like: the file whose other content stays; with urdf and xacro a URDF file, else the one in the model folder.
        tip: with `like`, the link that is the tool.
        geometry: with urdf and dh, "geometric" or "hybrid".
        poses: with targets, the file of poses.
        targets: with targets, "joints" or "cartesian".
        branch: with targets, the branch to take instead of the trained one.
        config: with FANUC's Cartesian targets, the arm's configuration.
        program: with targets, an existing program whose targets are rewritten.
        frames: with `program`, the file of frames and tools that it does not state.
        tolerance_mm: with `program`, how far the tool may leave a straight line between way points [mm].
        counts_per_turn: with counts, encoder counts a turn of every joint, with commas between.
        present_counts: with counts, those that the controller has now.
        payload_kg: what the robot carries [kg].
        temperature_c: of the robot [deg C].
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
    def stated(self) -> tuple[str, ...]:
        """Names of the options that are stated."""
        return tuple(name for name in OPTIONS if getattr(self, name) is not None)

    @property
    def as_csv(self) -> bool:
        """Whether the file is a table."""
        return self.out.suffix.lower() == ".csv"

    @property
    def conditions(self) -> dict[str, float]:
        """Stated payload and temperature, by the columns of measurement files."""
        values = {"payload_kg": self.payload_kg, "temperature_c": self.temperature_c}
        return {name: value for name, value in values.items() if value is not None}

    def load(self) -> "CalibratedModel":
        """The model, under the stated conditions.

        Raises:
            ModelError: the folder holds no model, or the model did not learn what a stated condition does.
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
"""Options of which every format declares those that it takes."""


@dataclass(frozen=True)
class Exported:
    """A file's content and what to say about it.

    Attributes:
        content: of the file, or of several by their names in a folder.
        facts: what `--json` prints, by key.
        remarks: sentences that a reader of the file should know.
        doubts: sentences on what may not be as wanted; they go to stderr.
        summary: what was written, as a sentence that ends before the file's name; "" for the format's contents.
        details: what the sentence says behind the file's name.
        failure: why the input is at fault though the file was written; None where all is well.
        shortfall: which limit is missed though the file was written; None where none is.
        shown: what is printed before all else, such as a diff.
    """

    content: str | bytes | Mapping[str, bytes]
    facts: Mapping[str, object]
    remarks: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    summary: str = ""
    details: str = ""
    failure: str | None = None
    shortfall: str | None = None
    shown: str = ""


@dataclass(frozen=True)
class ExportFormat:
    """One format.

    Attributes:
        name: what `--format` calls it.
        contents: what a file holds, such as "a DH table".
        suffixes: endings that its files may have; () where it writes a folder.
        write: makes the content of a file; raises a `PisigmaError` where it cannot.
        options: those of `OPTIONS` that it takes.
        check: refuses requests before anything is loaded; raises a `PisigmaError`.
    """

    name: str
    contents: str
    suffixes: tuple[str, ...]
    write: Callable[[ExportRequest], Exported]
    options: frozenset[str] = field(default_factory=frozenset)
    check: Callable[[ExportRequest], None] = lambda request: None


def model_facts(model: "CalibratedModel") -> dict[str, object]:
    """The model's robot and its number of joints, for `Exported.facts`."""
    return {"robot": model.robot.name, "joints": model.robot.dof}
