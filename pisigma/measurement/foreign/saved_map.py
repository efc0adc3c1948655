"""Mappings of columns on the command line or in a file."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from pisigma.files.errors import MeasurementError
from pisigma.files.output_file import write_atomically
from pisigma.files.yaml_file import Section, read_yaml
from pisigma.files.yaml_writing import yaml_text
from pisigma.measurement.foreign.mapping import FileMapping


class SavedMap(Section):
    """Contents of a file of mappings: targets by heading for every file of an import."""

    files: tuple[dict[str, str], ...]


StatedMaps = Sequence[Mapping[str, str]]
"""Type of several mappings; the mapping that fits a file best is used for it."""


def parse_map(text: str) -> StatedMaps:
    """Parse a mapping such as "A1=q1_deg,X=x_mm,note=-", or read a file of mappings.

    Raises:
        MeasurementError: the text is neither a mapping nor a file of mappings.
    """
    if "=" not in text:
        if not os.path.exists(text):
            raise MeasurementError(
                option="--map",
                expected="HEADING=COLUMN, such as A1=q1_deg,X=x_mm, or an existing file written by --save-map",
                value=text,
            )
        return read_yaml(text, SavedMap, MeasurementError).files
    stated: dict[str, str] = {}
    heading = ""
    for part in text.split(","):
        heading += part
        if "=" not in part:  # the heading contains a comma
            heading += ","
            continue
        name, _, target = heading.rpartition("=")
        stated[name.strip()] = target.strip()
        heading = ""
    if heading or "" in stated:
        raise MeasurementError(
            option="--map",
            expected="HEADING=COLUMN pairs separated by commas, such as A1=q1_deg,X=x_mm",
            value=text,
        )
    return (stated,)


def map_for(maps: StatedMaps, headings: Sequence[str]) -> Mapping[str, str]:
    """Return the mapping that names the most headings of a file and, if possible, no other headings."""
    there = {*headings, *map(str, range(1, len(headings) + 1))}
    fitting = maps if len(maps) == 1 else [one for one in maps if set(one) <= there]
    return max(fitting, key=lambda one: len(set(one) & there), default={})


def check_headings_exist(maps: StatedMaps, headings: Sequence[Sequence[str]]) -> None:
    """Refuse a heading in a mapping that no file has.

    Raises:
        MeasurementError: no file has a heading of the mapping.
    """
    there = {name for one in headings for name in (*one, *map(str, range(1, len(one) + 1)))}
    for name in dict.fromkeys(name for one in maps for name in one):
        if name not in there:
            columns = ", ".join(f"'{text}'" for one in headings for text in one)
            raise MeasurementError(
                f"no file has a column '{name}'",
                option="--map",
                value=name,
                remedy=f"choose one of {columns}",
            )


def save_map(mappings: Sequence[FileMapping], path: str | os.PathLike[str]) -> None:
    """Write a file of mappings that `parse_map` reads.

    Raises:
        OutputError: the file cannot be written.
    """
    files = [{mapping.key(one): one.target.text for one in mapping.columns} for mapping in mappings]
    write_atomically(Path(path), yaml_text({"files": files}))
