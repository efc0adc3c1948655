"""Terminal output of a command: the verdict, then warnings, then tables as far as they fit on the screen.

`--verbose`, cards and pages contain everything.
"""

from collections.abc import Sequence
from dataclasses import replace

import typer

from pisigma.cli.output import table_lines, wrap_lines
from pisigma.reporting.result_text import Block, ResultText, merge_alike_warnings
from pisigma.reporting.verdict import Verdict

MAX_LINES = 40
"""Largest number of lines that a command prints without `--verbose` at 80 columns, not counting warnings."""
_SHORT = 12
"""Number of lines up to which the verdict is not repeated at the end."""


def print_screen(
    verdict: Verdict,
    warnings: Sequence[str] = (),
    blocks: Sequence[Block] = (),
    details: Sequence[Block] = (),
    closing_sentences: Sequence[str] = (),
    verbose: bool = False,
    next_step: Sequence[str] = (),
    elsewhere: str = "--verbose",
) -> None:
    """Print a result, and repeat the accuracy at the end if it has scrolled off the screen.

    Args:
        verdict: verdict in three sentences.
        warnings: sentences; all are printed.
        blocks: tables and texts, most important first; blocks that do not fit are only named.
        details: blocks that are printed with `verbose` only.
        closing_sentences: sentences about files that were written.
        verbose: print everything.
        next_step: last lines, with the next step of a cell instead of the verdict's.
        elsewhere: where the user finds the blocks that are not shown, for commands without `--verbose`.
    """
    verdict = replace(verdict, next_step="") if next_step else verdict
    head = [line for label, text in verdict.lines if text for line in wrap_lines([f"{label}: {text}"], "  ")]
    cautions = wrap_lines((f"Warning: {one}" for one in merge_alike_warnings(warnings)), "  ")
    end = wrap_lines(closing_sentences)
    room = MAX_LINES - len(head) - len(cautions) - len(end) - 5
    shown, left_out = list[str](), list[str]()
    for block in (*blocks, *details) if verbose else blocks:
        lines = _lines(block)
        if verbose or len(lines) <= room - len(shown):
            shown += lines
        elif lines:
            left_out.append(block.name)
    left_out += [] if verbose else [block.name for block in details if _lines(block)]
    names = f"Not shown: {'; '.join(dict.fromkeys(left_out))} ({elsewhere})." if left_out else ""
    lines = [
        *head,
        *cautions,
        *([""] if shown else ()),
        *shown,
        *wrap_lines([names] if names else []),
        *end,
    ]
    if len(lines) > _SHORT:
        lines += wrap_lines([verdict.short], "  ")
    typer.echo("\n".join([*lines, *next_step]))


def _lines(block: Block) -> list[str]:
    """Return the lines of a block for the width of the screen."""
    if block.columns:
        return table_lines(block.sentences[0], block.columns, block.rows)
    return wrap_lines(block.sentences, block.indent)


def print_result(
    result: ResultText, verbose: bool = False, next_step: Sequence[str] = (), elsewhere: str = "--verbose"
) -> None:
    """Print a result; see `print_screen`."""
    print_screen(
        result.verdict,
        result.warnings,
        result.blocks,
        result.details,
        result.closing_sentences,
        verbose,
        next_step,
        elsewhere,
    )
