"""The target and the frame of a model's poses, if it was calibrated for several."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from pisigma.files.errors import ModelError
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.stated_conditions import condition_warnings


def with_frame_and_target(
    model: CalibratedModel, frame: str | None = None, target: str | None = None
) -> CalibratedModel:
    """Return the model whose poses are those of one target in one frame of the calibration rows.

    Args:
        model: calibrated model.
        frame: name of the frame; None for that of `model`.
        target: name of the target; None for that of `model`.

    Raises:
        ModelError: the model was not calibrated for this frame or target, or its network was trained for others.
    """
    ends: dict[str, Any] = {}
    of_hybrid: dict[str, Any] = {}
    frames: dict[str, Any] = {}
    for end, kind, name in (("base", "frame", frame), ("tool", "target", target)):
        if name is None:
            continue
        own, hybrid = getattr(model, f"{end}s"), getattr(model, f"hybrid_{end}s")
        if name not in own:
            raise ModelError(
                f"model '{model.name}' was not calibrated for {kind} '{name}'",
                value=name,
                option=kind,
                remedy=f"use one of {', '.join(map(repr, own))}" if any(own) else f"omit the {kind}",
            )
        if name != next(iter(own)):
            check_frames_can_change(model)
        ends[end], frames[f"{end}s"] = own[name], {name: own[name]}
        if model.hybrid is not None:
            of_hybrid[end], frames[f"hybrid_{end}s"] = hybrid[name], {name: hybrid[name]}
    arm = model.hybrid
    return replace(
        model,
        robot=model.robot.with_geometry(**ends),
        calibrated=model.calibrated and model.calibrated.with_geometry(**ends),
        hybrid=arm and replace(arm, robot=arm.robot.with_geometry(**of_hybrid)),
        **frames,
    )


def check_frames_can_change(model: CalibratedModel) -> None:
    """Check that no network corrects nominal joint values of the model's poses, which depend on base and tool.

    Raises:
        ModelError: a network does.
    """
    if model.network is not None:
        raise ModelError(
            f"the network of model '{model.name}' is valid only for the base and tool with which it was trained",
            value=model.kind,
            remedy="use a geometric or hybrid model",
        )


def several_names(model: CalibratedModel) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield "frame" and "target" with the names of a model that has several; its poses are those of the first."""
    for kind, names in (("frame", tuple(model.bases)), ("target", tuple(model.tools))):
        if len(names) > 1:
            yield kind, names


def warnings_without_rows(model: CalibratedModel) -> tuple[str, ...]:
    """Return warnings about poses for which no row states a condition, a frame or a target."""
    several = (
        f"Poses are those {'in' if kind == 'frame' else 'of'} {kind} '{names[0]}', the first of {len(names)} "
        f"({', '.join(names)})"
        + (f", unless --{kind} or `for_target` states another." if model.network is None else ".")
        for kind, names in several_names(model)
    )
    return (*condition_warnings(model), *several)
