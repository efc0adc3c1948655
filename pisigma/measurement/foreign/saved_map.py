"""Mappings of columns as people write them: on a command line, or in a file for the next time."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from pisigma.files.errors import MeasurementError
from pisigma.files.output_file import write_whole
from pisigma.files.yaml_file import Section, read_yaml, yaml_text
from pisigma.measurement.foreign.mapping import FileMapping


class SavedMap(Section):
    """A file of mappings: for every file of an import, what its columns are by their headings."""

    files: tuple[dict[str, str], ...]


StatedMaps = Sequence[Mapping[str, str]]
"""Mappings of which the one that fits a file best counts."""


def parse_map(text: str) -> StatedMaps:
    """Read a mapping such as "A1=q1_deg,X=x_mm,note=-", or a file of mappings.

    Raises:
        MeasurementError: it is neither.
    """
    if "=" not in text:
        if not os.path.exists(text):
            raise MeasurementError(
                f"--map {text}: HEADING=COLUMN was wanted, such as A1=q1_deg,X=x_mm, or a file that --save-map wrote; "
                "there is no such file."
            )
        return read_yaml(text, SavedMap, MeasurementError).files
    stated: dict[str, str] = {}
    heading = ""
    for part in text.split(","):
        heading += part
        if "=" not in part:  # the heading itself holds a comma
            heading += ","
            continue
        name, _, target = heading.rpartition("=")
        stated[name.strip()] = target.strip()
        heading = ""
    if heading or "" in stated:
        raise MeasurementError(
            f"--map {text}: HEADING=COLUMN was wanted, with commas between, such as A1=q1_deg,X=x_mm."
        )
    return (stated,)


def map_for(maps: StatedMaps, headings: Sequence[str]) -> Mapping[str, str]:
    """Choose the mapping that names most headings of a file; of several mappings one that names no others."""
    there = {*headings, *map(str, range(1, len(headings) + 1))}
    fitting = maps if len(maps) == 1 else [one for one in maps if set(one) <= there]
    return max(fitting, key=lambda one: len(set(one) & there), default={})


def check_used(maps: StatedMaps, headings: Sequence[Sequence[str]]) -> None:
    """Refuse a heading in a mapping that no file has.

    Raises:
        MeasurementError: see above.
    """
    there = {name for one in headings for name in (*one, *map(str, range(1, len(one) + 1)))}
    for name in dict.fromkeys(name for one in maps for name in one):
        if name not in there:
            columns = ", ".join(f"'{text}'" for one in headings for text in one)
            raise MeasurementError(f"--map {name}=...: no file has such a column; the columns are {columns}.")


def save_map(mappings: Sequence[FileMapping], path: str | os.PathLike[str]) -> None:
    """Write a file of mappings that `parse_map` reads.

    Raises:
        OutputError: the file cannot be written.
    """
    files = [{mapping.key(one): one.target.text for one in mapping.columns} for mapping in mappings]
    write_whole(Path(path), yaml_text({"files": files}))
