"""What people read of a command: the verdict first, then warnings, then tables as far as a screen has room for them.

Nothing is lost by that: `--verbose` prints everything, and so do cards and pages.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import typer

from pisigma.cli.output import table_lines, wrapped
from pisigma.reporting.verdict import Verdict

MAX_LINES = 40
"""Lines that a command prints at most without `--verbose`, at 80 columns; warnings come in addition."""
MAX_ALIKE = 10
"""Warnings of one kind that are printed one by one; more become one warning with their lines."""
SHORT = 12
"""Lines up to which the verdict is not repeated at the end."""

_NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?")
_ROW = re.compile(r"\b(?:line|row|image) (\d+)")


@dataclass(frozen=True)
class Block:
    """Lines that are printed together or not at all.

    Attributes:
        what: they are, for the line that names what is not shown.
        lines: wrapped to the width of the screen.
    """

    what: str
    lines: tuple[str, ...]


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], what: str = "") -> Block:
    """Lay out a table with its title; `what` is a shorter name of it."""
    return Block(what or title, tuple(table_lines(title, columns, rows)))


def sentences(what: str, lines: Iterable[str], indent: str = "") -> Block:
    """Wrap sentences."""
    return Block(what, tuple(wrapped(lines, indent)))


def print_screen(
    verdict: Verdict,
    warnings: Sequence[str] = (),
    blocks: Sequence[Block] = (),
    details: Sequence[Block] = (),
    closing: Sequence[str] = (),
    verbose: bool = False,
) -> None:
    """Print a result, and repeat the accuracy at its end where that has left the screen.

    Args:
        verdict: verdict in three sentences.
        warnings: sentences; all are printed.
        blocks: the most important first; those for which there is no room are named only.
        details: printed with `verbose` alone.
        closing: what was written where.
        verbose: print everything.
    """
    head = [line for label, text in verdict.lines if text for line in wrapped([f"{label}: {text}"], "  ")]
    cautions = wrapped((f"Warning: {one}" for one in together(warnings)), "  ")
    end = wrapped(closing)
    room = MAX_LINES - len(head) - len(cautions) - len(end) - 5
    shown, left_out = list[str](), list[str]()
    for block in (*blocks, *details) if verbose else blocks:
        if verbose or len(block.lines) <= room - len(shown):
            shown += block.lines
        elif block.lines:
            left_out.append(block.what)
    left_out += [] if verbose else [block.what for block in details if block.lines]
    names = f"Not shown: {'; '.join(dict.fromkeys(left_out))} (--verbose)." if left_out else ""
    lines = [
        *head,
        *cautions,
        *([""] if shown else ()),
        *shown,
        *wrapped([names] if names else []),
        *end,
    ]
    if len(lines) > SHORT:
        lines += wrapped([verdict.short], "  ")
    typer.echo("\n".join(lines))


def together(warnings: Iterable[str]) -> list[str]:
    """Join more than `MAX_ALIKE` warnings that differ in numbers only into one with their lines."""
    kinds: dict[str, list[str]] = {}
    for one in dict.fromkeys(warnings):
        kinds.setdefault(_NUMBER.sub("#", one), []).append(one)
    return [
        line for alike in kinds.values() for line in (alike if len(alike) <= MAX_ALIKE else [_joined(alike)])
    ]


def _joined(alike: Sequence[str]) -> str:
    rows = [int(match[1]) for one in alike[1:] if (match := _ROW.search(one))]
    where = f": lines {ranges(rows)}" if len(rows) == len(alike) - 1 else ""
    return f"{alike[0]} {len(alike) - 1} more of this kind{where}."


def ranges(numbers: Iterable[int]) -> str:
    """Write numbers with consecutive ones joined, such as "3, 7 to 9"."""
    found: list[list[int]] = []
    for number in sorted(set(numbers)):
        if found and number == found[-1][-1] + 1:
            found[-1] = [found[-1][0], number]
        else:
            found.append([number])
    return ", ".join(" to ".join(map(str, one)) for one in found)
