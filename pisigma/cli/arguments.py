"""Arguments and options that several commands share, and their completion in shells."""

from pathlib import Path
from typing import Annotated

import typer


def complete_robot(incomplete: str) -> list[str]:
    """Return the robots of the catalogue that begin with a text, for shell completion."""
    from pisigma.robot.robot_file import catalogue

    return [name for name in catalogue() if name.startswith(incomplete)]


def complete_model(incomplete: str) -> list[str]:
    """Return model folders, and folders that contain them, for shell completion."""
    written = Path(incomplete)
    parent = written if incomplete.endswith("/") else written.parent
    folders = [path for path in parent.glob("*/") if str(path).startswith(incomplete.removesuffix("/"))]
    return [str(path) if (path / "model.yaml").is_file() else f"{path}/" for path in sorted(folders)]


def complete_export(incomplete: str) -> list[str]:
    """Return the formats of `pisigma export`, for shell completion."""
    from pisigma.deployment.export.registry import export_names
    from pisigma.files.plugins import load_installed

    load_installed()
    return [name for name in export_names() if name.startswith(incomplete)]


ModelOrCell = Annotated[
    Path, typer.Argument(metavar="MODEL|CELL", help="Model folder or cell.", autocompletion=complete_model)
]
"""Argument of commands that read a model; for a cell, the model in use."""

Verbose = Annotated[bool, typer.Option("--verbose", help="Print all tables and remarks.")]
"""Option `--verbose` of commands that print many figures."""

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
"""Option `--json` of all commands that other programs may call."""

Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace the model in the folder.")]
"""Option `--overwrite` of commands that write a model folder."""

PayloadKg = Annotated[
    float | None,
    typer.Option(help="Payload [kg], for models with payload effects. [default: mean of training rows]"),
]
TemperatureC = Annotated[
    float | None,
    typer.Option(
        help="Temperature of the robot [deg C], for models with temperature effects. [default: mean of "
        "training rows]"
    ),
]

AcceptImplausible = Annotated[
    bool,
    typer.Option(
        "--accept-implausible",
        help="Write the model even if the result is implausible.",
    ),
]
"""Option `--accept-implausible` of commands that check a model before they write it."""
