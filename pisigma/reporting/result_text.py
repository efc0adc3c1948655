"""Text of a result, for any layout: the verdict, warnings, sentences and tables.

Commands print these texts on a screen, and pages show them in the browser.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from pisigma.reporting.verdict import Verdict

MAX_ALIKE = 10
"""Largest number of similar warnings that are shown one by one; more become one warning with their lines."""

_NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?")
_ROW = re.compile(r"\b(?:line|row|image) (\d+)")


class Table(NamedTuple):
    """A table of text.

    Attributes:
        columns: names of the columns.
        rows: cells of each row.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Block:
    """Sentences or a table that are shown together or not at all.

    Attributes:
        name: short name of the block.
        sentences: sentences; the one before a table is its title.
        columns: headings of the table; () without a table.
        rows: cells of the table.
        indent: indentation of the further lines of a sentence on a screen.
    """

    name: str
    sentences: tuple[str, ...]
    columns: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    indent: str = ""


def table_block(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], name: str = "") -> Block:
    """Return a table with its title; `name` is its short name."""
    return Block(name or title, (title,), tuple(columns), tuple(map(tuple, rows)))


def sentence_block(name: str, lines: Iterable[str], indent: str = "") -> Block:
    """Return sentences as a block."""
    return Block(name, tuple(lines), indent=indent)


@dataclass(frozen=True)
class ResultText:
    """A result for people.

    Attributes:
        verdict: verdict on the result, in three sentences.
        warnings: warnings as sentences; all are shown.
        blocks: blocks, most important first.
        details: blocks that are shown on demand.
        closing_sentences: sentence on the written files.
    """

    verdict: Verdict
    warnings: tuple[str, ...] = ()
    blocks: tuple[Block, ...] = ()
    details: tuple[Block, ...] = ()
    closing_sentences: tuple[str, ...] = ()


def merge_alike_warnings(warnings: Iterable[str]) -> list[str]:
    """Merge more than `MAX_ALIKE` warnings that differ only in numbers into one warning with their lines."""
    kinds: dict[str, list[str]] = {}
    for one in dict.fromkeys(warnings):
        kinds.setdefault(_NUMBER.sub("#", one), []).append(one)
    return [
        line for alike in kinds.values() for line in (alike if len(alike) <= MAX_ALIKE else [_joined(alike)])
    ]


def _joined(alike: Sequence[str]) -> str:
    rows = [int(match[1]) for one in alike[1:] if (match := _ROW.search(one))]
    where = f": lines {numbers_as_ranges(rows)}" if len(rows) == len(alike) - 1 else ""
    return f"{alike[0]} {len(alike) - 1} more of this kind{where}."


def numbers_as_ranges(numbers: Iterable[int]) -> str:
    """Return numbers as text with consecutive numbers joined, such as "3, 7 to 9"."""
    found: list[list[int]] = []
    for number in sorted(set(numbers)):
        if found and number == found[-1][-1] + 1:
            found[-1] = [found[-1][0], number]
        else:
            found.append([number])
    return ", ".join(" to ".join(map(str, one)) for one in found)
