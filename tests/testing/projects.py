"""The `pyproject.toml` files of the packages."""

import sys
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def project_of(folder: Path) -> dict[str, Any]:
    """Return the table `project` of a folder's `pyproject.toml`."""
    text = (folder / "pyproject.toml").read_text(encoding="utf-8")
    project: dict[str, Any] = tomllib.loads(text)["project"]
    return project
