"""Figures of a distilled model: how far it is from the full solutions that it stands for."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.joint_correction.conditions import learned_conditions
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.judging.pose_statistics import PoseErrors
from pisigma.kinematics.status import Status
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot
from pisigma.se3 import pose_error
from pisigma.workflow.distillation import Distillation, Trial
from pisigma.workflow.solved_poses import SINGULAR_BELOW, Region, SolvedPoses


def report_distillation(found: Distillation) -> dict[str, Any]:
    """Parent, region, poses, sizes, and the errors of held-out poses in mm and deg.

    The errors are those of the tool under the full calibrated model of the parent, with the joint values of its full
    solution, of the distilled model, and of the nominal robot.
    """
    parent, poses = found.parent, found.held_out
    model, provenance = found.model, found.model.provenance
    assert model.network is not None
    assert model.domain is not None
    scaled = model.network.scaled_inputs(poses.T, poses.q_nominal)
    report: dict[str, Any] = {
        "parent": {"name": parent.name, "kind": parent.kind, "sha256": provenance.data_sha256},
        "region": _region(found.region, poses, parent.robot),
        "poses": {
            "fitted": found.fitted,
            "held_out": len(poses.T),
            "beyond_measured_share": float((poses.status == Status.OUTSIDE_DOMAIN).double().mean()),
            "inside_domain_share": float(model.domain.contains(scaled).double().mean()),
            "drawn": poses.drawn,
            "refused": poses.refused,
        },
        "sizes": [_size(trial) for trial in found.trials],
        "held_out": {
            "nominal": _tool(parent, poses.T, poses.q_nominal),
            "distilled": _tool(parent, poses.T, poses.q_nominal + found.predicted),
            "full": _tool(parent, poses.T, poses.q_nominal + poses.correction),
        },
        "joints": _joints(parent.robot, poses.correction, found.predicted),
    }
    return report | {"doubts": doubts(found, report), "gives_up": gives_up(found, report)}


USEFUL = 0.2
"""A distilled model whose error against the full solution is larger than this share of the nominal one is warned of."""

_FEW_ROWS = 20
"""Rows per joint from which a region is taken as filled."""


def doubts(found: Distillation, report: dict[str, Any]) -> list[str]:
    """Why the distilled model should perhaps not be used, a sentence each; empty where nothing speaks against it."""
    held_out, sentences = report["held_out"], []
    for key, what, unit in (("rms_mm", "position", "mm"), ("rms_deg", "orientation", "deg")):
        own, nominal = held_out["distilled"][key], held_out["nominal"][key]
        if own > USEFUL * nominal:
            sentences.append(
                f"It takes only {max(1 - own / nominal, 0):.0%} off the nominal error in {what} ({own:.3g} of "
                f"{nominal:.3g} {unit} RMS are left): the region is too large for so small a network; give a "
                "smaller --region, more --poses, or use the parent."
            )
    rows, joints = len(found.region.q), found.parent.robot.dof
    if rows < _FEW_ROWS * joints:
        sentences.append(
            f"The region is told by only {rows} rows of joint values, {_FEW_ROWS * joints} or more fill it: between "
            "few rows it is thin, and the errors hold in there only."
        )
    return sentences


def gives_up(found: Distillation, report: dict[str, Any]) -> list[str]:
    """What the full solution has and the distilled one has not, a sentence each."""
    parent, distilled = found.parent, report["held_out"]["distilled"]
    sentences = [
        f"Exactness: on held-out poses of the region the tool is {distilled['rms_mm']:.4f} mm RMS (95 % within "
        f"{distilled['p95_mm']:.4f} mm, at most {distilled['max_mm']:.4f} mm) from where the full solution brings it. "
        "The errors that the parent itself has come on top."
    ]
    harmonics = _harmonics(parent)
    seen = next(trial.size.harmonics for trial in found.trials if trial.kept)
    if harmonics > seen:
        sentences.append(
            f"Fast ripple: the parent corrects every joint by a series of up to {harmonics} cycles a turn, this "
            f"network sees {'sine and cosine' if seen == 1 else f'up to {seen} cycles'} of the joint's nominal value "
            "and follows what is slower" + _of_smooth(found.trials) + "."
        )
    learned = None if parent.hybrid is None else learned_conditions(parent.hybrid.correction)
    if learned is not None:
        names = " and ".join(learned.names)
        sentences.append(f"Conditions: {names} are taken as usual when the parent was measured.")
    return [
        *sentences,
        "Reach: poses that only the calibrated robot can take have no nominal joint values to correct, and poses near "
        f"a singularity (measure below {SINGULAR_BELOW}) were not learned.",
        "Place: it holds in its region and on its branches only; beyond, the status is OUTSIDE_DOMAIN. It predicts no "
        "accuracy; ask the parent for it.",
    ]


def _of_smooth(trials: Sequence[Trial]) -> str:
    """What sines and cosines of the joints alone would give, where that was tried and something else taken."""
    smooth = [trial.error for trial in trials if trial.size.harmonics == 1]
    if not smooth or any(trial.kept and trial.size.harmonics == 1 for trial in trials):
        return ""
    return f" (with sines and cosines of the joints alone it would be {min(smooth) * 1e3:.4f} mm RMS)"


def _harmonics(parent: CalibratedModel) -> int:
    features = () if parent.hybrid is None else parent.hybrid.correction.features
    return max((chosen.harmonics for chosen in features if isinstance(chosen, FourierSeries)), default=1)


def _region(region: Region, poses: SolvedPoses, robot: Robot) -> dict[str, Any]:
    """Bounds of the joint values and of the positions."""
    low, high = poses.q_nominal.amin(0).tolist(), poses.q_nominal.amax(0).tolist()
    place = poses.T[:, :3, 3]
    box = [
        value * 1e3
        for pair in zip(*place.aminmax(dim=0), strict=True)
        for value in torch.stack(pair).tolist()
    ]
    joints = [
        {"name": joint.name, "unit": unit, "lower": a * factor, "upper": b * factor}
        for joint, a, b, (unit, factor) in zip(robot.joints, low, high, _units(robot), strict=True)
    ]
    return {
        "kind": "joints" if region.box is None else "box",
        "rows": len(region.q),
        "box_mm": box if region.box is None else [value * 1e3 for value in region.box],
        "joints": joints,
    }


def _size(trial: Trial) -> dict[str, Any]:
    return {
        "orders": list(trial.size.orders),
        "harmonics": trial.size.harmonics,
        "unknowns": trial.unknowns,
        "rms_mm": trial.error * 1e3,
        "kept": trial.kept,
    }


def _tool(
    parent: CalibratedModel, T: Float64[Tensor, "poses 4 4"], q: Float64[Tensor, "poses dof"]
) -> dict[str, float]:
    error = pose_error(T, parent.forward(q))
    return PoseErrors(error[:, :3].norm(dim=-1), error[:, 3:].norm(dim=-1)).in_file_units()


def _joints(
    robot: Robot, correction: Float64[Tensor, "poses dof"], predicted: Float64[Tensor, "poses dof"]
) -> list[dict[str, Any]]:
    """Mean, RMS and maximum of what the full solution adds, and of how far the distilled one is from it."""
    found = []
    for j, (unit, factor) in enumerate(_units(robot)):
        figures: dict[str, float] = {}
        for name, error in (("correction", correction[:, j]), ("error", correction[:, j] - predicted[:, j])):
            size = error.abs() * factor
            values = {"mean": size.mean(), "rms": size.square().mean().sqrt(), "max": size.max()}
            figures |= {f"{name}_{what}_{unit}": float(value) for what, value in values.items()}
        found.append({"name": robot.joints[j].name, "unit": unit, **figures})
    return found


def _units(robot: Robot) -> list[tuple[str, float]]:
    return [("deg", math.degrees(1)) if turns else ("mm", 1e3) for turns in robot.revolute]
