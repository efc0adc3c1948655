"""A cell that an earlier version wrote, with the monitored sessions of its model in a file next to it.

A UR10 with a model of 40 rows and three monitored sessions of ten rows; before the last one joint 3 moved by 0.1 deg.
"""

import zipfile
from pathlib import Path

MODEL = "2026-11-26"
"""Name of its model."""


def cell_of_schema_1(folder: Path) -> Path:
    """Write the cell into a folder, and return its path."""
    with zipfile.ZipFile(Path(__file__).with_name("cell_of_schema_1.zip")) as archive:
        archive.extractall(folder / "cell")
    return folder / "cell"
