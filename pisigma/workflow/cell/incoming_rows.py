"""Files of an instrument that are added to a cell: reading, faults and repairs."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from pisigma.files.errors import AcceptanceError, MeasurementError, Place
from pisigma.lifetime.cell.history import SessionEntry
from pisigma.measurement.camera.corner_file import read_rows
from pisigma.measurement.csv.columns import POSITION
from pisigma.measurement.csv.reading import is_measurement_file
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.foreign.headings import parse_heading
from pisigma.measurement.foreign.mapping import FileMapping
from pisigma.measurement.foreign.quantities import ColumnTarget, MappedColumn
from pisigma.measurement.foreign.units import unit_symbol
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.import_rows import ImportedRows, ImportProposal, import_rows, propose_import
from pisigma.workflow.settings.importing import ImportSettings

_SIZES = {
    "mm": 1e-3,
    "m": 1.0,
    "cm": 1e-2,
    "in": 0.0254,
    "deg": float(np.deg2rad(1)),
    "rad": 1.0,
    "gon": np.pi / 200,
}
"""Sizes of units that are often confused [m or rad]."""
_MISNAMED = {"mm_named_m": 1e-3, "m_named_mm": 1e3}
"""Ratio of correct to stated values, by the cause of a finding that states no figures."""


@dataclass(frozen=True)
class Repair:
    """Settings of the import that correct a finding of a check.

    Attributes:
        text: effect of the settings, such as "read x_mm, y_mm, z_mm as x_in!, y_in!, z_in!".
        settings: all settings of the import, including the correction.
        options: the settings as options of a command line.
    """

    text: str
    settings: ImportSettings

    @property
    def options(self) -> str:
        """The correction as options of `pisigma import`."""
        return stated_options(self.settings)


def stated_options(settings: ImportSettings) -> str:
    """Return stated meanings of columns and new frames as options of `pisigma import`; "" if none are stated."""
    pairs = ",".join(f"{key}={text}" for one in settings.maps for key, text in one.items())
    words = ["--map", pairs] if pairs else []
    for line in settings.new_frame_at:
        words += ["--set", f"new_frame_at={line}"]
    return shlex.join(words)


@dataclass(frozen=True, eq=False)
class IncomingRows:
    """Uploaded or exported files whose rows can be added to a cell.

    Attributes:
        files: the files.
        cell: the cell.
        settings: settings of the import.
    """

    files: tuple[Path, ...]
    cell: Cell
    settings: ImportSettings

    @cached_property
    def proposal(self) -> ImportProposal:
        """Meaning of the columns.

        Raises:
            MeasurementError: see `propose_import`.
        """
        return propose_import(self.files, self.settings)

    @cached_property
    def needs_no_conversion(self) -> bool:
        """Whether the files are a single measurement file, which needs no conversion."""
        stated = self.settings.maps or self.settings.new_frame_at
        return len(self.files) == 1 and not stated and is_measurement_file(self.files[0])

    @cached_property
    def imported_rows(self) -> ImportedRows | None:
        """Return the converted rows; None for a measurement file, which needs no conversion.

        Raises:
            MeasurementError: see `import_rows`.
        """
        return None if self.needs_no_conversion else import_rows(self.proposal)

    @cached_property
    def unchecked_rows(self) -> Measurements:
        """The rows, not yet checked against the robot's limits.

        Raises:
            MeasurementError: the files cannot be read, or see `import_rows`.
        """
        return read_rows(self._rows, self.cell.robot.without_limits, self.cell.cameras)

    @property
    def _rows(self) -> Path | Measurements:
        return self.files[0] if self.imported_rows is None else self.imported_rows.measurements

    def check(self, day: str = "") -> tuple[Diagnostic, ...]:
        """Check the rows as `Sessions.add_session` does, and return the findings.

        Raises:
            MeasurementError: see `Sessions.add_session`.
        """
        try:
            return self.cell.sessions.check(self._rows, day).diagnostics
        except AcceptanceError as refusal:
            return refusal.findings

    def add(self, accept_implausible: bool = False, day: str = "") -> SessionEntry:
        """Add the rows to the cell as a session; see `Sessions.add_session`.

        Raises:
            MeasurementError: the rows cannot be read, or the cell already contains some of them.
            AcceptanceError: the rows must not be trusted; the message states the options that correct them, if any do.
        """
        options = stated_options(self.settings)
        remark = f"Imported with {options}." if options else ""
        try:
            entry = self.cell.sessions.add_session(self._rows, accept_implausible, day, remark)
        except AcceptanceError as refusal:
            if not refusal.findings or (repair := self.repair(refusal.findings[0])) is None:
                raise
            corrected = AcceptanceError(
                refusal.problem,
                at=Place(refusal.file or "rows"),
                remedy=f"{repair.text}, with {repair.options}",
            )
            corrected.findings = refusal.findings
            raise corrected from refusal
        self.cell.sessions.set_imported_aside([] if self.needs_no_conversion else self.files, entry)
        return entry

    def repair(self, finding: Diagnostic) -> Repair | None:
        """Return the settings of the import that correct a finding; None if there is no unique repair."""
        values = finding.values
        if finding.kind == "row_order" and finding.cause == "frame" and "first_line" in values:
            line = int(str(values["first_line"]))
            settings = replace(self.settings, new_frame_at=(*self.settings.new_frame_at, line))
            return Repair(f"start a new frame at line {line}", settings)
        try:
            mappings = self.proposal.mappings
        except MeasurementError:
            return None
        stated: dict[str, str] = {}
        changed: dict[str, str] = {}
        for mapping in mappings:
            stated |= {mapping.key(one): one.target.text for one in mapping.columns if one.is_stated}
            changed |= _corrected(mapping, finding)
        if not changed:
            return None
        text = f"read {', '.join(changed)} as {', '.join(changed.values())}"
        return Repair(text, replace(self.settings, maps=(stated | changed,)))


def _corrected(mapping: FileMapping, finding: Diagnostic) -> Mapping[str, str]:
    """Return the meanings of a file's columns that correct a finding, by heading; empty if there is no repair."""
    kinds, values = set(finding.cause.split("+")) - {"frame", "tool"}, finding.values
    columns, ratio = values.get("columns"), values.get("ratio", _MISNAMED.get(finding.cause))
    targets: list[tuple[MappedColumn, ColumnTarget]] = []
    if isinstance(columns, tuple) and kinds <= {"joint_order", "joint_sign"}:
        for joint, logged in enumerate(columns, 1):
            one = mapping.quantities.get(f"q{abs(logged)}")
            if one is not None and logged != joint:
                sign = one.target.is_reversed != (logged < 0)
                targets.append((one, replace(one.target, quantity=f"q{joint}", is_reversed=sign)))
    elif isinstance(ratio, float) and len(kinds) == 1:
        joints = values.get("joints")
        names = POSITION if finding.cause != "joint_unit" else _names(joints)
        for one in filter(None, map(mapping.quantities.get, names)):
            if (unit := _unit(one.target.unit, ratio)) is not None:
                is_written = bool(_written(mapping, one))
                targets.append((one, replace(one.target, unit=unit, overrides_unit=is_written)))
    return {mapping.key(one): target.text for one, target in targets}


def _names(joints: object) -> Sequence[str]:
    return [f"q{joint}" for joint in joints] if isinstance(joints, tuple) else []


def _written(mapping: FileMapping, column: MappedColumn) -> str:
    """Return the unit that the heading or the unit row states."""
    return parse_heading(column.heading).unit or unit_symbol(mapping.file.units[column.index])


def _unit(stated: str, ratio: float) -> str | None:
    """Return the unit that is larger than a stated unit by a ratio; None if there is no such unit."""
    kinds = (("mm", "m", "cm", "in"), ("deg", "rad", "gon"))
    likely = next((kind for kind in kinds if stated in kind), ())
    return next((one for one in likely if np.isclose(_SIZES[one], ratio * _SIZES[stated])), None)
