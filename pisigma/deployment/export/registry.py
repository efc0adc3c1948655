"""The registry of exports: which formats there are and where each is made."""

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path

from pisigma.deployment.export.export_format import OPTIONS, Exported, ExportFormat, ExportRequest
from pisigma.files.conflicts import check_conflicts
from pisigma.files.errors import OutputError, nearest_choice
from pisigma.files.output_file import check_output, write_whole

BUILT_IN = {
    "urdf": ("pisigma.deployment.export.urdf", "calibrated geometry"),
    "dh": ("pisigma.deployment.export.dh_table", "its DH + Hayati table with base and tool"),
    "offsets": (
        "pisigma.deployment.export.joint_offsets",
        "the best joint offsets alone, with the accuracy that this gives up",
    ),
    "targets": ("pisigma.deployment.export.targets", "corrected targets for --poses"),
    "ur-calibration": (
        "pisigma.deployment.export.controllers.universal_robots",
        "calibration.conf of Universal Robots",
    ),
    "ur-ros": ("pisigma.deployment.export.controllers.ur_ros", "kinematics YAML of their ROS driver"),
    "staubli": ("pisigma.deployment.export.controllers.staubli", "dhOffset of a Staubli arm.cfx"),
    "xacro": (
        "pisigma.deployment.export.controllers.xacro",
        "calibrated origins laid over the URDF of --like",
    ),
    "epson": ("pisigma.deployment.export.controllers.counts:EPSON", "home offsets of Epson in counts"),
    "fanuc-mastering": ("pisigma.deployment.export.controllers.counts:FANUC", "mastering counts of FANUC"),
    "onnx": ("pisigma.deployment.export.onnx_model", "the network alone"),
    "library": ("pisigma.deployment.export.library.c_library", "a shared library for C with a header"),
}
"""By name the module whose `FORMAT` (or what is named behind the colon) it is, imported on use, and what the help says
of it."""

_REGISTERED: dict[str, ExportFormat] = {}


def register_export(form: ExportFormat) -> ExportFormat:
    """Make `pisigma export --format NAME` and `export_model` know a format.

    Raises:
        OutputError: another format has this name, or an option is none of `OPTIONS`.
    """
    if form.name in BUILT_IN or _REGISTERED.setdefault(form.name, form) is not form:
        raise OutputError(f"there is an export '{form.name}' already; name yours otherwise.")
    if unknown := sorted(form.options - set(OPTIONS)):
        del _REGISTERED[form.name]
        raise OutputError(f"export '{form.name}': {unknown[0]}: {nearest_choice(unknown[0], OPTIONS)}")
    return form


def export_names() -> tuple[str, ...]:
    """Names of all formats."""
    return (*BUILT_IN, *_REGISTERED)


def export_format(name: str) -> ExportFormat:
    """The format of a name.

    Raises:
        OutputError: there is none; the message lists them.
    """
    if name in _REGISTERED:
        return _REGISTERED[name]
    if name not in BUILT_IN:
        raise OutputError(f"--format '{name}' is unknown; {nearest_choice(name, export_names())}")
    module, _, attribute = BUILT_IN[name][0].partition(":")
    form = getattr(import_module(module), attribute or "FORMAT")
    assert isinstance(form, ExportFormat)
    return form


def export_model(name: str, request: ExportRequest) -> Exported:
    """Write a model in a format, every file whole or not at all.

    Args:
        name: of the format.
        request: the model, the file and the options.

    Raises:
        OutputError: there is no such format, an option does not go with it, or the file cannot be written.
        PisigmaError: the format cannot hold the model.
    """
    form = export_format(name)
    for option in request.stated:
        if option not in form.options:
            takers = " or ".join(other for other in export_names() if option in export_format(other).options)
            raise OutputError(
                f"--{option.replace('_', '-')} goes with --format {takers}, not with {name}; leave it out."
            )
    form.check(request)
    inputs = (request.model, request.like, request.poses, request.program, request.frames)
    if form.suffixes:
        check_output(request.out, form.suffixes, form.contents, inputs)
    else:
        check_conflicts(request.out, inputs)
    exported = form.write(request)
    if isinstance(exported.content, str | bytes):
        write_whole(request.out, exported.content)
    else:
        _write_folder(request.out, exported.content)
    return exported


def _write_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files into a folder, which is made if it is missing.

    Raises:
        OutputError: it cannot be made or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise OutputError(
            f"{folder}: no folder can be made there ({problem.strerror}); choose another --out."
        ) from None
    for name, content in files.items():
        write_whole(folder / name, content)
