"""Files of poses for `pisigma ik`."""

from collections.abc import Iterable, Sequence
from pathlib import Path

COLUMNS = ("x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg")


def write_poses(path: Path, rows: Iterable[Sequence[float]]) -> None:
    """Write poses [mm, deg], one per row."""
    lines = [",".join(COLUMNS), *(",".join(map(repr, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
