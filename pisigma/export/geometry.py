"""The geometry of a model as one robot, and what has to be said where only that leaves pisigma."""

from dataclasses import replace

from pisigma import __version__
from pisigma.joint_correction.conditions import learned_conditions
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.stated_conditions import condition_warnings
from pisigma.robot.description import Robot


def calibrated_geometry(model: CalibratedModel) -> Robot:
    """The robot with its geometry as identified (as drawn where it was not), base and tool of the model."""
    robot = model.calibrated or model.robot
    return replace(
        robot, source=f"model {model.name} of robot {robot.name}, written by pisigma {__version__}"
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
            "The learned joint correction of the model is not in this file: a program that reads it gets the "
            "geometry only, without the accuracy that the correction adds."
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
