"""Geometry of a model as one robot, and remarks for files that contain only the geometry."""

from dataclasses import dataclass, replace

from pisigma import __version__
from pisigma.deployment.export.export_format import ExportRequest
from pisigma.files.errors import ModelError, OutputError, check_choice
from pisigma.joint_correction.conditions import learned_conditions
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.frame_choice import several_names
from pisigma.model.stated_conditions import condition_warnings
from pisigma.robot.description import Robot

GEOMETRIC, HYBRID = "geometric", "hybrid"
"""Names of the geometries of a model: that of the geometric fit alone, and that of a hybrid model."""


@dataclass(frozen=True, eq=False)
class ChosenGeometry:
    """A geometry of a model for export.

    Attributes:
        name: `GEOMETRIC` or `HYBRID`.
        robot: robot with the geometry, base and tool.
        comments: sentences for the top of the file.
    """

    name: str
    robot: Robot
    comments: tuple[str, ...]


def check_geometry(request: ExportRequest) -> None:
    """Check the name of the geometry.

    Raises:
        OutputError: the name is neither `GEOMETRIC` nor `HYBRID`.
    """
    if request.geometry is not None:
        check_choice(OutputError, "--geometry", request.geometry, (GEOMETRIC, HYBRID))


def chosen_geometry(model: CalibratedModel, name: str | None) -> ChosenGeometry:
    """Return a geometry by name; None means `GEOMETRIC`.

    Raises:
        ModelError: the model has no geometry of this name.
    """
    if name == HYBRID:
        return ChosenGeometry(HYBRID, _signed(model, _hybrid_geometry(model)), _hybrid_remarks(model))
    return ChosenGeometry(GEOMETRIC, _signed(model, model.calibrated or model.robot), geometry_remarks(model))


def _signed(model: CalibratedModel, robot: Robot) -> Robot:
    return replace(
        robot, source=f"model {model.name} of robot {robot.name}, written by pisigma {__version__}"
    )


def _hybrid_geometry(model: CalibratedModel) -> Robot:
    """Return the geometry that was fitted together with the joint correction of --format onnx.

    Raises:
        ModelError: the model has no such correction.
    """
    if model.network is not None:
        raise ModelError(
            f"the network of model '{model.name}' corrects nominal joint values and has no geometry",
            option="--geometry",
            value=HYBRID,
            remedy="omit --geometry hybrid, or export the model that it was distilled from",
        )
    if model.hybrid is None:
        raise ModelError(
            f"model '{model.name}' has no learned joint correction and therefore no hybrid geometry",
            option="--geometry",
            value=HYBRID,
            remedy="omit --geometry hybrid",
        )
    if model.robot.coupling is not None:
        raise ModelError(
            f"the joints of model '{model.name}' are coupled, so their correction cannot be exported with the hybrid "
            "geometry",
            option="--geometry",
            value=HYBRID,
            remedy="omit --geometry hybrid, or use pisigma.load",
        )
    return model.hybrid.robot


def _hybrid_remarks(model: CalibratedModel) -> tuple[str, ...]:
    """Return comments for a file of the geometry that belongs to a joint correction."""
    return (
        f"Hybrid geometry of model {model.name} (robot {model.robot.name}), by pisigma {__version__}.",
        "Use it together with the joint correction of the same model (--format onnx): the pose is that of this "
        "geometry at q + correction. Without the correction, use a file of --geometry geometric.",
        *pose_remarks(model),
    )


def corrects_joints(model: CalibratedModel) -> bool:
    """Return whether a model has a learned joint correction, which files of geometry cannot include."""
    return model.network is not None or model.hybrid is not None


def geometry_remarks(model: CalibratedModel) -> tuple[str, ...]:
    """Return comments for a file that includes only the geometry of a model."""
    kind = (
        "Nominal geometry with identified base and tool"
        if model.calibrated is None
        else "Identified geometry"
    )
    sentences = [f"{kind} of model {model.name} (robot {model.robot.name}), by pisigma {__version__}."]
    if corrects_joints(model):
        sentences.append(
            "The learned joint correction of the model is not in this file: it describes the geometric fit alone, "
            "without the accuracy that the correction adds. Do not combine it with the correction of --format onnx, "
            "which belongs to --geometry hybrid."
        )
    return (*sentences, *frame_remarks(model))


def frame_remarks(model: CalibratedModel) -> tuple[str, ...]:
    """Return remarks that state which base and tool are exported if the model has several."""
    parts = {"frame": "base", "target": "tool"}
    return tuple(
        f"The {parts[kind]} is that of the {kind} '{names[0]}'; the model has {len(names)} {kind}s "
        f"({', '.join(names)})."
        for kind, names in several_names(model)
    )


def condition_remarks(model: CalibratedModel) -> tuple[str, ...]:
    """Return remarks on the payload and temperature of joint values, if the model learned their effect."""
    learned = None if model.hybrid is None else learned_conditions(model.hybrid.correction)
    usual = {} if learned is None else dict(zip(learned.names, learned.mean, strict=True))
    stated = [f"{name} {value:g}" for name, value in model.conditions.items()]
    stated += [f"{name} {mean:.4g} (mean of the calibration)" for name, mean in usual.items()]
    return (*((f"For {' and '.join(stated)}.",) if stated else ()), *condition_warnings(model))


def pose_remarks(model: CalibratedModel) -> tuple[str, ...]:
    """Return remarks on the conditions, base and tool for which a file relates joint values and poses."""
    return (*condition_remarks(model), *frame_remarks(model))


def offset_remarks(model: CalibratedModel) -> tuple[str, ...]:
    """Return comments for a file that includes only joint offsets."""
    title = f"Joint offsets of model {model.name} (robot {model.robot.name}), by pisigma {__version__}."
    if not corrects_joints(model):
        return (title,)
    return (
        title,
        *condition_remarks(model),
        "The learned joint correction of the model is not in this file, except for the constant offsets that "
        "approximate it best.",
    )
