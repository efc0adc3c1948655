"""`pisigma upgrade`: a model folder of an earlier version in the form of this one."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from pisigma.cli.arguments import AsJson, complete_model
from pisigma.cli.output import print_json, print_lines

Model = Annotated[
    Path,
    typer.Argument(
        metavar="MODEL", help="Model folder that an earlier version wrote.", autocompletion=complete_model
    ),
]


def upgrade(model: Model, as_json: AsJson = False) -> None:
    """Rewrite a model folder of an earlier version so that this one reads it, whole or not at all."""
    from pisigma.model.folder.upgrade import upgrade_folder

    done = upgrade_folder(model)
    if as_json:
        print_json({"model": str(model), **asdict(done)})
    elif done.before == done.after:
        typer.echo(f"{model} has the newest format ({done.after}) already.")
    else:
        print_lines([f"{model}: format {done.before} was upgraded to {done.after}.", *done.changes])
