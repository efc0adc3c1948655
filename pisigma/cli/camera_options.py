"""Options that say what the pixels of files of corners mean."""

import inspect
from collections.abc import Iterable, Mapping
from typing import Annotated, Any

import typer

FixedCamera = Annotated[
    bool,
    typer.Option(
        "--fixed-camera",
        help="Every camera is fixed and the boards are on the flange, not the other way round; of several cameras, "
        "state is_fixed: true in the files of those that are.",
    ),
]
RepeatabilityMm = Annotated[
    float, typer.Option(help="Of images: standard deviation with which a position repeats, per axis [mm].")
]
RepeatabilityDeg = Annotated[
    float, typer.Option(help="Of images: standard deviation with which a direction repeats, per axis [deg].")
]


def refuse_without_camera(stated: Mapping[str, Any], options: Iterable[inspect.Parameter]) -> None:
    """Refuse options of cameras whose values are not their defaults, as there is no camera.

    Raises:
        BadParameter: such an option is stated.
    """
    unused = [option.name for option in options if stated[option.name] != option.default]
    if unused:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in unused)
        raise typer.BadParameter(f"{names}: only with --camera and --board.")
