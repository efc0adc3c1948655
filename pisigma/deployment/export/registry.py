"""Registry of export formats."""

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path

from pisigma.deployment.export.export_format import OPTIONS, Exported, ExportFormat, ExportRequest
from pisigma.files.conflicts import check_conflicts
from pisigma.files.errors import OutputError, Place, check_choice, choice_remedy
from pisigma.files.output_file import check_output, write_atomically

BUILT_IN = {
    "urdf": ("pisigma.deployment.export.urdf", "calibrated geometry"),
    "mjcf": ("pisigma.deployment.export.mjcf", "the same as MJCF for MuJoCo"),
    "dh": ("pisigma.deployment.export.dh_table", "its DH + Hayati table with base and tool"),
    "offsets": (
        "pisigma.deployment.export.joint_offsets",
        "the best joint offsets alone, and the accuracy that this loses",
    ),
    "targets": ("pisigma.deployment.export.targets", "corrected targets for --poses"),
    "ur-calibration": (
        "pisigma.deployment.export.controllers.universal_robots",
        "calibration.conf of Universal Robots",
    ),
    "ur-ros": (
        "pisigma.deployment.export.controllers.ur_ros",
        "kinematics YAML of the ROS driver of Universal Robots",
    ),
    "staubli": ("pisigma.deployment.export.controllers.staubli", "dhOffset of a Staubli arm.cfx"),
    "xacro": (
        "pisigma.deployment.export.controllers.xacro",
        "the URDF of --like with calibrated origins as properties",
    ),
    "epson": (
        "pisigma.deployment.export.controllers.counts:EPSON",
        "home offsets of Epson in encoder counts",
    ),
    "fanuc-mastering": ("pisigma.deployment.export.controllers.counts:FANUC", "mastering counts of FANUC"),
    "lerobot": (
        "pisigma.deployment.lerobot.calibration_file",
        "calibration JSON of LeRobot with corrected zeros, from --like",
    ),
    "rsi": ("pisigma.deployment.export.rsi", "RSI configuration of KUKA for serve --rsi"),
    "onnx": ("pisigma.deployment.export.onnx_model", "the network alone"),
    "library": ("pisigma.deployment.export.library.c_library", "a shared library for C with a header"),
}
"""Module with `FORMAT` (or the attribute after the colon), which is imported on use, and help text, by format name."""

_REGISTERED: dict[str, ExportFormat] = {}


def register_export(form: ExportFormat) -> ExportFormat:
    """Register a format for `pisigma export --format NAME` and `export_model`.

    Raises:
        OutputError: another format has this name, or an option is not one of `OPTIONS`.
    """
    if form.name in BUILT_IN or _REGISTERED.setdefault(form.name, form) is not form:
        raise OutputError(
            f"there is already an export format '{form.name}'", value=form.name, remedy="choose another name"
        )
    if unknown := sorted(form.options - set(OPTIONS)):
        del _REGISTERED[form.name]
        raise OutputError(
            f"export format '{form.name}' declares the unknown option '{unknown[0]}'",
            value=unknown[0],
            remedy=choice_remedy(unknown[0], OPTIONS),
        )
    return form


def export_names() -> tuple[str, ...]:
    """Return the names of all formats."""
    return (*BUILT_IN, *_REGISTERED)


def export_format(name: str) -> ExportFormat:
    """Return a format by name.

    Raises:
        OutputError: there is no such format; the message lists them.
    """
    if name in _REGISTERED:
        return _REGISTERED[name]
    check_choice(OutputError, "--format", name, export_names())
    module, _, attribute = BUILT_IN[name][0].partition(":")
    form = getattr(import_module(module), attribute or "FORMAT")
    assert isinstance(form, ExportFormat)
    return form


def export_model(name: str, request: ExportRequest) -> Exported:
    """Export a model in a format; every file is written completely or not at all.

    Args:
        name: name of the format.
        request: model, file and options.

    Raises:
        OutputError: there is no such format, it does not accept an option, or the file cannot be written.
        PisigmaError: the format cannot describe the model.
    """
    form = export_format(name)
    for option in request.stated_options:
        if option not in form.options:
            takers = " or ".join(other for other in export_names() if option in export_format(other).options)
            raise OutputError(
                f"the option applies only to --format {takers}, not to {name}",
                option=f"--{option.replace('_', '-')}",
                value=name,
                remedy="omit it",
            )
    form.check(request)
    inputs = (request.model, request.like, request.poses, request.program, request.frames)
    if form.suffixes:
        check_output(request.out, form.suffixes, form.contents, inputs)
    else:
        check_conflicts(request.out, inputs)
    exported = form.write(request)
    if isinstance(exported.content, str | bytes):
        write_atomically(request.out, exported.content)
    else:
        _write_folder(request.out, exported.content)
    return exported


def _write_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files into a folder, which is created if necessary.

    Raises:
        OutputError: the folder cannot be created or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise OutputError(
            f"the folder cannot be created: {problem.strerror}",
            at=Place(folder),
            option="--out",
            remedy="choose another folder",
        ) from None
    for name, content in files.items():
        write_atomically(folder / name, content)
