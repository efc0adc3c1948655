"""Whether all commands agree on rows with a mistake."""

from collections.abc import Iterable
from pathlib import Path

from gate.commands import COMMANDS, answer
from gate.table import Mistake, filtered_rows


def disagreements(mistake: Mistake, folder: Path, commands: Iterable[str] = COMMANDS) -> list[str]:
    """List the commands whose result differs from the table."""
    rows, found = mistake.change(filtered_rows()), []
    for command in commands:
        got = answer(command, rows, folder)
        stopped, wanted = got.status in (2, 3), bool(mistake.kinds)
        if got.status not in (0, 2, 3) or (stopped != wanted and command not in mistake.unnoticed):
            found.append(f"{command}: status {got.status}, {got.said[:200]}")
    return found
