"""The geometry of a model as one robot, and what has to be said where only that leaves pisigma."""

from dataclasses import dataclass, replace

from pisigma import __version__
from pisigma.deployment.export.export_format import ExportRequest
from pisigma.files.errors import ModelError, OutputError, nearest_choice
from pisigma.joint_correction.conditions import learned_conditions
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.stated_conditions import condition_warnings
from pisigma.robot.description import Robot

GEOMETRIC, HYBRID = "geometric", "hybrid"
"""The geometries of a model: the geometric fit, used alone, and the one that goes with a hybrid's correction."""


@dataclass(frozen=True, eq=False)
class ChosenGeometry:
    """A geometry of a model, to be written.

    Attributes:
        name: `GEOMETRIC` or `HYBRID`.
        robot: with the geometry, base and tool.
        said: sentences for the head of the file, on what it holds.
    """

    name: str
    robot: Robot
    said: tuple[str, ...]


def check_geometry(request: ExportRequest) -> None:
    """Refuse a geometry that is none.

    Raises:
        OutputError: it is none of `GEOMETRIC` and `HYBRID`.
    """
    if request.geometry not in (None, GEOMETRIC, HYBRID):
        known = nearest_choice(str(request.geometry), (GEOMETRIC, HYBRID))
        raise OutputError(f"--geometry '{request.geometry}' is unknown; {known}")


def chosen_geometry(model: CalibratedModel, name: str | None) -> ChosenGeometry:
    """The geometry of a name, `GEOMETRIC` where None is stated.

    Raises:
        ModelError: the model has no geometry of this name.
    """
    if name == HYBRID:
        return ChosenGeometry(HYBRID, _signed(model, _hybrid_geometry(model)), _hybrid_remarks(model))
    return ChosenGeometry(GEOMETRIC, _signed(model, model.calibrated or model.robot), remarks(model))


def _signed(model: CalibratedModel, robot: Robot) -> Robot:
    return replace(
        robot, source=f"model {model.name} of robot {robot.name}, written by pisigma {__version__}"
    )


def _hybrid_geometry(model: CalibratedModel) -> Robot:
    """The geometry that the joint correction of --format onnx was fitted together with.

    Raises:
        ModelError: that graph does not hold such a correction.
    """
    if model.network is not None:
        raise ModelError(
            f"model '{model.name}': its network corrects nominal joint values, which no geometry of its own goes with; "
            "leave --geometry hybrid out, or export the model that it was distilled from."
        )
    if model.hybrid is None:
        raise ModelError(
            f"model '{model.name}' has no learned joint correction, so there is no hybrid geometry; leave --geometry "
            "hybrid out."
        )
    if model.robot.coupling is not None:
        raise ModelError(
            f"model '{model.name}': its joints are coupled, and their correction cannot be exported with the hybrid "
            "geometry; leave --geometry hybrid out, or use pisigma.load."
        )
    return model.hybrid.robot


def _hybrid_remarks(model: CalibratedModel) -> tuple[str, ...]:
    """Sentences for the head of a file of the geometry that goes with a joint correction."""
    return (
        f"Hybrid geometry of model {model.name} (robot {model.robot.name}), by pisigma {__version__}.",
        "To be used together with the joint correction of the same model (--format onnx): the pose is that of this "
        "geometry at q + correction. Without it, take a file of --geometry geometric.",
        *condition_remarks(model),
        *frame_remarks(model),
    )


def corrects_joints(model: CalibratedModel) -> bool:
    """Whether a model has a learned joint correction, which files of geometry cannot hold."""
    return model.network is not None or model.hybrid is not None


def remarks(model: CalibratedModel) -> tuple[str, ...]:
    """Sentences for the head of a file that holds the geometry of a model and nothing else."""
    drawn = "as drawn, with the identified base and tool" if model.calibrated is None else "as identified"
    said = [f"Geometry {drawn}, of model {model.name} (robot {model.robot.name}), by pisigma {__version__}."]
    if corrects_joints(model):
        said.append(
            "The learned joint correction of the model is not in this file: a program that reads it gets the geometric "
            "fit alone, without the accuracy that the correction adds. Do not add the correction of --format onnx to "
            "it: that goes with --geometry hybrid."
        )
    return (*said, *frame_remarks(model))


def frame_remarks(model: CalibratedModel) -> tuple[str, ...]:
    """Sentences on whose base and tool leave pisigma where the model knows several."""
    several = (("base", "frame", list(model.bases)), ("tool", "target", list(model.tools)))
    return tuple(
        f"The {part} is that of the {what} '{names[0]}'; the model knows {len(names)} {what}s ({', '.join(names)})."
        for part, what, names in several
        if len(names) > 1
    )


def condition_remarks(model: CalibratedModel) -> tuple[str, ...]:
    """Sentences on the payload and temperature that joint values are for, where the model learned what these do."""
    learned = None if model.hybrid is None else learned_conditions(model.hybrid.correction)
    usual = {} if learned is None else dict(zip(learned.names, learned.mean, strict=True))
    stated = [f"{name} {value:g}" for name, value in model.conditions.items()]
    stated += [f"{name} {mean:.4g} (usual)" for name, mean in usual.items()]
    return (f"Made for {' and '.join(stated)}.", *condition_warnings(model)) if stated else ()


def offset_remarks(model: CalibratedModel) -> tuple[str, ...]:
    """The same for a file that holds joint offsets and nothing else."""
    title = f"Joint offsets of model {model.name} (robot {model.robot.name}), by pisigma {__version__}."
    if not corrects_joints(model):
        return (title,)
    return (
        title,
        *condition_remarks(model),
        "The learned joint correction of the model is not in this file, but for the constant offsets that come "
        "nearest to it.",
    )
