"""Import exports of instruments and controllers as measurements."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pisigma.files.errors import MeasurementError, Phrase, Place
from pisigma.files.output_file import check_output, write_atomically
from pisigma.measurement.csv.reading import fields_of
from pisigma.measurement.dataset import Measurements, with_new_frames
from pisigma.measurement.foreign.accounting import (
    FileAccount,
    FileLine,
    LeftOutRow,
    count_rows,
    left_out_sentences,
)
from pisigma.measurement.foreign.conversion import (
    ConvertedRows,
    MeasurementTable,
    convert_rows,
    measurement_table,
)
from pisigma.measurement.foreign.export_file import read_export
from pisigma.measurement.foreign.joining import JoinedRows, append_rows, join_rows
from pisigma.measurement.foreign.mapping import FileMapping, map_columns, mapping_warnings
from pisigma.measurement.foreign.quantities import LEFT_OUT
from pisigma.measurement.foreign.saved_map import check_headings_exist, map_for, save_map
from pisigma.measurement.foreign.units import parse_units
from pisigma.workflow.settings.importing import ImportSettings


@dataclass(frozen=True, eq=False)
class ImportProposal:
    """Meaning of the columns of exports, before their rows are imported.

    Attributes:
        mappings: column mappings of the files, in their order.
        settings: settings of the import.
    """

    mappings: tuple[FileMapping, ...]
    settings: ImportSettings

    @property
    def is_stated(self) -> bool:
        """Whether the caller stated the meaning of every column, so that no confirmation is needed."""
        return all(column.is_stated for mapping in self.mappings for column in mapping.columns)

    def columns_json(self) -> list[dict[str, object]]:
        """Return the mapping of every column as plain values."""
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
        """Write the mapping of columns as a file for the option `--map`.

        Raises:
            OutputError: the file cannot be written.
        """
        save_map(self.mappings, path)


@dataclass(frozen=True, eq=False)
class ImportedRows:
    """Result of `import_rows`: imported measurements.

    Attributes:
        proposal: meaning of the columns.
        measurement_table: the measurement file.
        accounts: imported and omitted rows of every file.
        warnings: sentences with other remarks.
    """

    proposal: ImportProposal
    measurement_table: MeasurementTable
    accounts: tuple[FileAccount, ...]
    warnings: tuple[str, ...]

    @property
    def row_count(self) -> int:
        """Number of measurements."""
        return len(self.measurement_table.table.records)

    @property
    def left_out(self) -> tuple[LeftOutRow, ...]:
        """Rows of all files that were not imported."""
        return tuple(row for file in self.accounts for row in file.left_out)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences about rows that are left out, with the reasons, and warnings."""
        return (*left_out_sentences(self.left_out), *self.warnings)

    @property
    def measurements(self) -> Measurements:
        """The imported measurements."""
        return Measurements.from_fields(fields_of(self.measurement_table.table))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the imported rows as a measurement file.

        Raises:
            OutputError: the file cannot be written, or is one of the exports.
        """
        files = [mapping.file.source for mapping in self.proposal.mappings]
        check_output(Path(path), (".csv",), "a measurement file", files)
        write_atomically(Path(path), self.measurement_table.text())

    def to_json(self) -> dict[str, object]:
        """Return a summary of imported and omitted rows as plain values."""
        return {
            "rows": self.row_count,
            "files": [file.to_json() for file in self.accounts],
            "columns": self.proposal.columns_json(),
            "left_out": [row.to_json() for row in self.left_out],
            "warnings": list(self.warnings),
        }


def propose_import(
    files: Sequence[str | os.PathLike[str]], settings: ImportSettings | None = None
) -> ImportProposal:
    """Recognise the columns of exports, without importing their rows.

    Args:
        files: one or more exports.
        settings: see `ImportSettings`; None for the defaults.

    Raises:
        MeasurementError: a file is not a table of numbers, or a setting does not fit the files.
    """
    settings = settings or ImportSettings()
    units = parse_units(settings.units)
    _check_different(files)
    exports = [read_export(path, settings.decimal) for path in files]
    check_headings_exist(settings.maps, [file.headings for file in exports])
    mappings = tuple(
        map_columns(file, map_for(settings.maps, file.headings), settings.rotation, units) for file in exports
    )
    return ImportProposal(mappings, settings)


def _check_different(files: Sequence[str | os.PathLike[str]]) -> None:
    """Check that no file is given twice, because its rows would be used twice.

    Raises:
        MeasurementError: a file is given twice.
    """
    paths = [os.path.realpath(path) for path in files]
    for number, path in enumerate(paths):
        if path in paths[:number]:
            raise MeasurementError(
                "expected different files, got this one twice", at=Place(files[number]), remedy="give it once"
            )


def import_rows(
    files: Sequence[str | os.PathLike[str]] | ImportProposal, settings: ImportSettings | None = None
) -> ImportedRows:
    """Import exports of instruments and controllers as measurements.

    No number is rounded. Lengths are written in mm, and angles in deg or rad as in the export. Rotations are written as
    quaternions, unless they are already in the form RotZ(roll)·RotY(pitch)·RotX(yaw).

    Args:
        files: one or more exports, or the result of `propose_import`.
        settings: see `ImportSettings`; None for the defaults.

    Raises:
        MeasurementError: a unit or a rotation convention is not stated, or rows are not measurements. The message names
            file, line and column, and the option that helps.
    """
    proposal = files if isinstance(files, ImportProposal) else propose_import(files, settings)
    converted = [(mapping, convert_rows(mapping)) for mapping in proposal.mappings]
    rows, joined = _joined(converted, proposal.settings)
    content = _in_new_frames(measurement_table(rows), proposal.settings.new_frame_at)
    exports = [mapping.file for mapping in proposal.mappings]
    left_out = [*(row for file in exports for row in file.skipped_lines), *content.left_out]
    used: list[FileLine] = list(content.places)
    if joined is not None:
        left_out += (*joined.unmatched_rows, *joined.unneeded_rows)
        used += joined.joined_lines
    warnings = [sentence for mapping in proposal.mappings for sentence in mapping_warnings(mapping)]
    return ImportedRows(
        proposal,
        content,
        count_rows([place for file in exports for place in file.row_places], used, left_out),
        (*warnings, *(() if joined is None else joined.warnings)),
    )


def _in_new_frames(content: MeasurementTable, lines: Sequence[int]) -> MeasurementTable:
    """Return the content with the names of new frames, which start at given lines, in the column `frame`.

    Raises:
        MeasurementError: the rows come from several files, or see `with_new_frames`.
    """
    if not lines:
        return content
    if len(files := dict.fromkeys(file for file, _ in content.places)) > 1:
        raise MeasurementError(
            option="new_frame_at",
            expected="rows of one file",
            value=Phrase(", ".join(files)),
            remedy="import the files one by one",
        )
    table, frames = (
        content.table,
        with_new_frames(Measurements.from_fields(fields_of(content.table)), lines).frame,
    )
    kept = [index for index, name in enumerate(table.header) if name != "frame"]
    records = [[*(row[one] for one in kept), frame] for row, frame in zip(table.records, frames, strict=True)]
    header = (*(table.header[one] for one in kept), "frame")
    return replace(content, table=replace(table, header=header, records=records))


def _joined(
    converted: Sequence[tuple[FileMapping, ConvertedRows]], settings: ImportSettings
) -> tuple[ConvertedRows, JoinedRows | None]:
    """Return all rows, and how they were joined; None if the files were concatenated.

    Raises:
        MeasurementError: files are to be joined, but either all or none of them have joint values.
    """
    if settings.join is None:
        for _, rows in converted if len(converted) > 1 else ():
            measurement_table(rows)  # a failure here names the faulty file
        return append_rows([rows for _, rows in converted]), None
    joints = [rows for mapping, rows in converted if mapping.has_joints]
    measured = [rows for mapping, rows in converted if not mapping.has_joints]
    if not joints or not measured:
        missing = "without joint values" if joints else "with joint values"
        raise MeasurementError(
            f"expected a file with joint values and one without, but there is none {missing}",
            expected=f"a file {missing}",
            value=settings.join,
            option="--join",
            remedy="give both, or name the columns with --map",
        )
    joined = join_rows(append_rows(measured), append_rows(joints), settings.join, settings.within)
    return joined.rows, joined
