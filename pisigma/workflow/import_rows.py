"""Import what instruments and controllers export as measurements."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pisigma.files.errors import MeasurementError
from pisigma.files.output_file import check_output, write_whole
from pisigma.measurement.csv.reading import fields_of
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.foreign.accounting import FileAccount, LeftOutRow, Place, account, sentences
from pisigma.measurement.foreign.conversion import ConvertedRows, MeasurementTable, convert, measurement_table
from pisigma.measurement.foreign.export_file import read_export
from pisigma.measurement.foreign.joining import JoinedRows, append_rows, join_rows
from pisigma.measurement.foreign.mapping import FileMapping, doubts, map_columns
from pisigma.measurement.foreign.quantities import LEFT_OUT
from pisigma.measurement.foreign.saved_map import check_used, map_for, save_map
from pisigma.measurement.foreign.units import parse_units
from pisigma.workflow.settings.importing import ImportSettings


@dataclass(frozen=True, eq=False)
class ImportProposal:
    """What the columns of exports are, before their rows are imported.

    Attributes:
        mappings: of the files, in their order.
        settings: how they are read.
    """

    mappings: tuple[FileMapping, ...]
    settings: ImportSettings

    @property
    def is_stated(self) -> bool:
        """Whether the caller said of every column what it is, so that there is nothing to ask."""
        return all(column.is_stated for mapping in self.mappings for column in mapping.columns)

    def columns_json(self) -> list[dict[str, object]]:
        """Give the mapping of every column as plain values."""
        return [
            {
                "file": mapping.file.source,
                "column": column.index + 1,
                "heading": column.heading if mapping.file.has_header else None,
                "read_as": None if column.target.quantity == LEFT_OUT else column.target.text,
                "reason": column.reason,
            }
            for mapping in self.mappings
            for column in mapping.columns
        ]

    def save_map(self, path: str | os.PathLike[str]) -> None:
        """Write the mapping as a file that `--map` takes.

        Raises:
            OutputError: it cannot be written.
        """
        save_map(self.mappings, path)


@dataclass(frozen=True, eq=False)
class ImportedRows:
    """Measurements that were imported.

    Attributes:
        proposal: what the columns are.
        content: the measurement file.
        accounts: of every file, what became of its rows.
        warnings: what else should be known, each a sentence.
    """

    proposal: ImportProposal
    content: MeasurementTable
    accounts: tuple[FileAccount, ...]
    warnings: tuple[str, ...]

    @property
    def rows(self) -> int:
        """Number of measurements."""
        return len(self.content.table.records)

    @property
    def left_out(self) -> tuple[LeftOutRow, ...]:
        """The rows of all files that were not imported."""
        return tuple(row for file in self.accounts for row in file.left_out)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What is to be said of the rows: which are left out and why, and warnings."""
        return (*sentences(self.left_out), *self.warnings)

    @property
    def measurements(self) -> Measurements:
        """The measurements."""
        return Measurements.from_fields(fields_of(self.content.table))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the measurement file.

        Raises:
            OutputError: it cannot be written, or is one of the exports.
        """
        files = [mapping.file.source for mapping in self.proposal.mappings]
        check_output(Path(path), (".csv",), "a measurement file", files)
        write_whole(Path(path), self.content.text())

    def to_json(self) -> dict[str, object]:
        """Give what was read and left out as plain values."""
        return {
            "rows": self.rows,
            "files": [file.to_json() for file in self.accounts],
            "columns": self.proposal.columns_json(),
            "left_out": [row.to_json() for row in self.left_out],
            "warnings": list(self.warnings),
        }


def propose_import(
    files: Sequence[str | os.PathLike[str]], settings: ImportSettings | None = None
) -> ImportProposal:
    """Find out what the columns of exports are; nothing is imported yet.

    Args:
        files: one or more.
        settings: how they are read. None: `ImportSettings()`.

    Raises:
        MeasurementError: a file is no table of numbers, or a setting does not fit the files.
    """
    settings = settings or ImportSettings()
    units = parse_units(settings.units)
    _check_different(files)
    exports = [read_export(path, settings.decimal) for path in files]
    check_used(settings.maps, [file.headings for file in exports])
    mappings = tuple(
        map_columns(file, map_for(settings.maps, file.headings), settings.rotation, units) for file in exports
    )
    return ImportProposal(mappings, settings)


def _check_different(files: Sequence[str | os.PathLike[str]]) -> None:
    """Refuse a file that is given twice, whose rows would count twice.

    Raises:
        MeasurementError: see above.
    """
    paths = [os.path.realpath(path) for path in files]
    for number, path in enumerate(paths):
        if path in paths[:number]:
            raise MeasurementError(
                f"{files[number]}: expected different files, got this one twice; give it once."
            )


def import_rows(
    files: Sequence[str | os.PathLike[str]] | ImportProposal, settings: ImportSettings | None = None
) -> ImportedRows:
    """Import what instruments and controllers export as measurements.

    Numbers keep all of their digits: lengths are written in mm, angles in deg or rad as they are, rotations that are
    neither quaternions nor RotZ(roll)·RotY(pitch)·RotX(yaw) as quaternions.

    Args:
        files: one or more, or what `propose_import` gave.
        settings: how they are read. None: `ImportSettings()`.

    Raises:
        MeasurementError: a unit or the way of a rotation is not stated, or rows are no measurements; the message names
            file, line and column, and the option that helps.
    """
    proposal = files if isinstance(files, ImportProposal) else propose_import(files, settings)
    converted = [(mapping, convert(mapping)) for mapping in proposal.mappings]
    rows, joined = _joined(converted, proposal.settings)
    content = measurement_table(rows)
    exports = [mapping.file for mapping in proposal.mappings]
    left_out = [*(row for file in exports for row in file.skipped), *content.left_out]
    used: list[Place] = list(content.places)
    if joined is not None:
        left_out += (*joined.unmatched, *joined.unused)
        used += joined.used
    warnings = [sentence for mapping in proposal.mappings for sentence in doubts(mapping)]
    return ImportedRows(
        proposal,
        content,
        account([place for file in exports for place in file.places], used, left_out),
        (*warnings, *(() if joined is None else joined.warnings)),
    )


def _joined(
    converted: Sequence[tuple[FileMapping, ConvertedRows]], settings: ImportSettings
) -> tuple[ConvertedRows, JoinedRows | None]:
    """All rows, and how they were joined."""
    if settings.join is None:
        for _, rows in converted if len(converted) > 1 else ():
            measurement_table(rows)  # so that a fault is named with its file
        return append_rows([rows for _, rows in converted]), None
    joints = [rows for mapping, rows in converted if mapping.has_joints]
    measured = [rows for mapping, rows in converted if not mapping.has_joints]
    if not joints or not measured:
        missing = "without joint values" if joints else "with joint values"
        raise MeasurementError(
            f"--join {settings.join}: a file with joint values and one without are put together, but there is none "
            f"{missing}; give both, or name the columns with --map."
        )
    joined = join_rows(append_rows(measured), append_rows(joints), settings.join, settings.within)
    return joined.rows, joined
