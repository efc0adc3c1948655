"""Options that say what the pixels of files of corners mean."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from pisigma.camera.corner_file import CameraFiles

Cameras = Annotated[
    list[Path] | None,
    typer.Option(
        "--camera",
        help="Camera (YAML of pisigma, ROS or OpenCV) whose corners a file holds: columns image, corner, u_px, v_px "
        "and joints; with --board. May be repeated; the column camera then has their names.",
    ),
]
Boards = Annotated[
    list[Path] | None,
    typer.Option(
        "--board",
        help="Board that cameras see (YAML: rows, columns, square_mm). May be repeated; the column board then has "
        "their names.",
    ),
]
FixedCamera = Annotated[
    bool,
    typer.Option(
        "--fixed-camera",
        help="Every camera is fixed and the boards are on the flange, not the other way round; of several cameras, "
        "state is_fixed: true in the files of those that are.",
    ),
]
Intrinsics = Annotated[
    str,
    typer.Option(
        help="Of cameras: fixed: as their files state them; prior: within the standard deviations in their files, or "
        "those of a usual calibration where they state none; free: as the images show them."
    ),
]
RepeatabilityMm = Annotated[
    float, typer.Option(help="Of images: standard deviation with which a position repeats, per axis [mm].")
]
RepeatabilityDeg = Annotated[
    float, typer.Option(help="Of images: standard deviation with which a direction repeats, per axis [deg].")
]


_DEFAULTS = {
    "fixed_camera": False,
    "intrinsics": "prior",
    "repeatability_mm": 0.02,
    "repeatability_deg": 0.01,
}


def stated_cameras(options: Mapping[str, Any]) -> "CameraFiles | None":
    """What the pixels mean by the options of a command; None where neither camera nor board is stated.

    Raises:
        BadParameter: another option of cameras is stated without them.
    """
    from pisigma.camera.corner_file import CameraFiles
    from pisigma.camera.image_rows import Repeatability

    cameras, boards = (tuple(map(str, options[name] or ())) for name in ("camera", "board"))
    if not cameras and not boards:
        unused = [
            f"--{name.replace('_', '-')}" for name, usual in _DEFAULTS.items() if options[name] != usual
        ]
        if unused:
            raise typer.BadParameter(f"{', '.join(unused)}: only with --camera and --board.")
        return None
    repeatability = Repeatability(
        options["repeatability_mm"] / 1e3, math.radians(options["repeatability_deg"])
    )
    return CameraFiles(cameras, boards, options["fixed_camera"], repeatability, options["intrinsics"])
