"""Generate the tables of the schema of histories from their classes.

`python docs/hooks/history_tables.py` updates the page.
"""

import sqlite3
import tempfile
from contextlib import closing
from pathlib import Path

from recipe_tables import page_with

from pisigma.files.setting import attribute_descriptions
from pisigma.lifetime.cell.history import HISTORY, SCHEMA_VERSION, TABLES, History

PAGE = Path(__file__).parent.parent / "reference" / "history.md"


def tables() -> str:
    """Return every table of a new history, with the types of its columns and the meaning of its attributes."""
    parts = [f"This is version {SCHEMA_VERSION} of the schema.", ""]
    with tempfile.TemporaryDirectory() as folder:
        history = History(Path(folder) / HISTORY)
        history.database.upgrade()
        with closing(sqlite3.connect(history.path)) as database:
            for kind, table in TABLES.items():
                meaning, summary = attribute_descriptions(kind), (kind.__doc__ or "").splitlines()[0]
                key = f" Key: {', '.join(f'`{name}`' for name in table.key)}." if table.key else ""
                parts += [f"### {table.name}", "", f"{summary}{key}", ""]
                parts += ["| column | type | meaning |", "|---|---|---|"]
                for _, name, declared, is_required, *_ in database.execute(
                    f"PRAGMA table_info({table.name})"
                ):
                    null = "" if is_required else ", may be NULL"
                    parts.append(
                        f"| `{name}` | {declared}{null} | {meaning[name].replace('|', chr(92) + '|')} |"
                    )
                parts.append("")
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page_with(PAGE.read_text(encoding="utf-8"), tables()), encoding="utf-8")
