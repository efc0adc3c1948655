"""Options that say what the pixels of files of corners mean."""

import functools
import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from pisigma.measurement.camera.corner_file import CameraFiles

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


def stated_cameras(
    camera: Cameras = None,
    board: Boards = None,
    fixed_camera: FixedCamera = False,
    intrinsics: Intrinsics = "prior",
    repeatability_mm: RepeatabilityMm = 0.02,
    repeatability_deg: RepeatabilityDeg = 0.01,
) -> "CameraFiles | None":
    """What the pixels mean by the options of a command; None where neither camera nor board is stated.

    Raises:
        BadParameter: another option of cameras is stated without them.
    """
    stated: dict[str, Any] = dict(locals())
    from pisigma.measurement.camera.corner_file import CameraFiles
    from pisigma.measurement.camera.image_rows import Repeatability

    cameras, boards = (tuple(map(str, files or ())) for files in (camera, board))
    if not cameras and not boards:
        refuse_without_camera(stated, _OPTIONS.values())
        return None
    repeatability = Repeatability(repeatability_mm / 1e3, math.radians(repeatability_deg))
    return CameraFiles(cameras, boards, fixed_camera, repeatability, stated["intrinsics"])


_OPTIONS = inspect.signature(stated_cameras).parameters


def refuse_without_camera(stated: Mapping[str, Any], options: Iterable[inspect.Parameter]) -> None:
    """Refuse options of cameras whose values are not their defaults, as there is no camera.

    Raises:
        BadParameter: such an option is stated.
    """
    unused = [option.name for option in options if stated[option.name] != option.default]
    if unused:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in unused)
        raise typer.BadParameter(f"{names}: only with --camera and --board.")


def takes_corners(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of `stated_cameras`, whose result it gets as its parameter `cameras`."""

    @functools.wraps(command)
    def with_options(**values: Any) -> None:
        options = {name: values.pop(name) for name in _OPTIONS}
        command(**values, cameras=stated_cameras(**options))

    parameters: list[inspect.Parameter] = []
    for one in inspect.signature(command).parameters.values():
        parameters += _OPTIONS.values() if one.name == "cameras" else [one]
    keyword = inspect.Parameter.KEYWORD_ONLY
    vars(with_options)["__signature__"] = inspect.Signature([one.replace(kind=keyword) for one in parameters])
    with_options.__annotations__ = {one.name: one.annotation for one in parameters}
    return with_options
