"""Distil a calibrated model into a small Pi-Sigma network on nominal joint values.

Jeong et al. 1998 learn `Δθ = θ_measured - θ_analytic` from measurements; here, the full inverse kinematics solution of
a model takes the place of θ_measured, for poses of a region.
"""

import os
import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import IdentificationError, ModelError
from pisigma.files.model_files import model_hash
from pisigma.files.progress import Progress
from pisigma.joint_correction.conditions import learned_conditions, learned_torques
from pisigma.model.calibrated_model import CalibratedModel, Provenance
from pisigma.model.domain import Domain
from pisigma.model.folder.model_folder import load_model
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.stored_starts import evenly_spaced_rows
from pisigma.reporting.derived_cards import write_distilled_card
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.kinematics.status import Status
from pisigma.robot.row import Row
from pisigma.robot.se3 import pose_error
from pisigma.validation.held_out.distillation_summary import (
    AbsoluteErrorFigures,
    DistillationSummary,
    DistilledErrors,
    DistilledJoint,
    JointRange,
    ParentFigures,
    PoseFigures,
    RegionFigures,
    SizeFigures,
)
from pisigma.validation.held_out.pose_statistics import PoseErrors
from pisigma.validation.held_out.validation_figures import ErrorFigures
from pisigma.workflow.distilled_network import choose_network, sizes_for
from pisigma.workflow.result import AbstractModelResult
from pisigma.workflow.settings.distillation import DistillationSettings
from pisigma.workflow.solved_poses import SINGULAR_BELOW, Region, SolvedPoses, draw_solved_poses

_CHOICE_SHARE, _HELD_OUT_SHARE = 0.2, 0.4
"""Numbers of poses for model selection and for testing, relative to the number of fitted poses."""

_MAX_ERROR_SHARE = 0.2
"""Ratio of the error of the network to the nominal error above which a warning is given."""

_DOMAIN_SAMPLES = 512
_MIN_POSES = 100
"""Minimum number of fitted poses."""

_MIN_ROWS_PER_JOINT = 20
"""Number of rows per joint below which a region is sparsely covered."""


@dataclass(frozen=True, eq=False)
class Distillation(AbstractModelResult):
    """Result of `distill`: a distilled model, and its deviation from the full solution.

    Attributes:
        model: the distilled model, with all figures as its metrics.
        parent: the model from which it was distilled.
        region: region of the poses.
        held_out: poses that were used neither for fitting nor for model selection.
        predicted_corrections: corrections that the network adds to their nominal joint values [rad or m].
        summary: all figures.
        seconds: computing time [s].
    """

    model: CalibratedModel
    parent: CalibratedModel
    region: Region
    held_out: SolvedPoses
    predicted_corrections: Float64[Tensor, "poses dof"]
    summary: DistillationSummary
    seconds: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return reasons not to use the model, one sentence each."""
        return self.summary.warnings

    def _describe(self, model: CalibratedModel, summary: DistillationSummary, folder: Path) -> None:
        write_distilled_card(model, summary, folder)


def distill(
    model: CalibratedModel | str | os.PathLike[str],
    settings: DistillationSettings = DistillationSettings(),
    progress: Progress = lambda what: None,
) -> Distillation:
    """Fit a small network on nominal joint values to the full solutions of a model.

    Args:
        model: a model with an identified geometry, or its folder.
        settings: region, number of poses, sizes and seed.
        progress: called with the current step.

    Raises:
        ModelError: the folder is not that of a model, or the model cannot be distilled.
        IdentificationError: the robot reaches too few poses of the region, or too few for the size of the network.
    """
    started, sha256 = time.perf_counter(), ""
    if isinstance(model, CalibratedModel):
        parent = model
    else:
        parent = load_model(model)
        sha256 = model_hash(model)
    _check_parent(parent)
    if settings.poses < _MIN_POSES:
        raise IdentificationError(
            expected=f"{_MIN_POSES} poses or more", value=settings.poses, option="--poses"
        )
    sizes = (settings.size,) if settings.size is not None else sizes_for(parent, settings.poses)
    region = settings.region or Region(parent.starts.double())
    generator = torch.Generator().manual_seed(settings.seed)
    choosing, judging = (round(settings.poses * share) for share in (_CHOICE_SHARE, _HELD_OUT_SHARE))
    total = settings.poses + choosing + judging
    every = draw_solved_poses(CorrectedIK(parent), region, total, generator, progress)
    fitted, chosen_by = slice(settings.poses), slice(settings.poses, settings.poses + choosing)
    network, sizes_tried = choose_network(
        parent, every, (fitted, chosen_by), sizes, settings.seed, settings.epochs, progress
    )
    held_out = every.select(slice(settings.poses + choosing, None))
    solver = closed_form_solver(parent.robot)
    with torch.no_grad():
        predicted = network(held_out.T, held_out.q_nominal)
        scaled = network.scaled_inputs(every.T[fitted], every.q_nominal[fitted])
    distilled = CalibratedModel(
        name=f"{parent.name}_distilled",
        kind="distilled",
        robot=parent.robot,
        network=network,
        domain=Domain.from_rows(scaled[:_DOMAIN_SAMPLES], generator),
        branches=() if solver is None else solver.most_frequent_branches(every.branch),
        starts=evenly_spaced_rows((every.q_nominal + every.correction)[fitted]),
        bases=parent.bases,
        tools=parent.tools,
        provenance=_provenance(parent, sha256, settings),
    )
    summary = _summary(distilled, parent, region, sizes_tried, settings.poses, held_out, predicted)
    distilled = replace(distilled, metrics=summary.to_json())
    seconds = time.perf_counter() - started
    return Distillation(distilled, parent, region, held_out, predicted, summary, seconds)


def _check_parent(parent: CalibratedModel) -> None:
    if parent.network is not None:
        raise ModelError(
            f"model '{parent.name}' already corrects nominal joint values with a network",
            expected="a model without a network",
            value=parent.name,
            remedy="export it unchanged",
        )
    if parent.calibrated is None or not len(parent.starts):
        raise ModelError(
            f"model '{parent.name}' has no identified geometry with measured joint values",
            expected="a model with an identified geometry",
            value=parent.name,
            remedy="give a model written by `pisigma calibrate`",
        )
    if parent.robot.coupling is not None:
        raise ModelError(
            f"the joints of model '{parent.name}' are coupled, and a network on nominal joint values does not model "
            "this coupling",
            expected="a model without coupled joints",
            value=parent.name,
            remedy="use the model unchanged",
        )


def _provenance(parent: CalibratedModel, sha256: str, settings: DistillationSettings) -> Provenance:
    return Provenance(
        data_source=f"full solutions of model {parent.name}",
        data_sha256=sha256,
        rows=settings.poses,
        seed=settings.seed,
        versions=Provenance.installed_versions(),
    )


def _summary(
    model: CalibratedModel,
    parent: CalibratedModel,
    region: Region,
    sizes: tuple[SizeFigures, ...],
    fitted: int,
    poses: SolvedPoses,
    predicted: Float64[Tensor, "poses dof"],
) -> DistillationSummary:
    """Return the figures of held-out poses, with errors of the tool under the full calibrated model."""
    assert model.network is not None
    assert model.domain is not None
    scaled = model.network.scaled_inputs(poses.T, poses.q_nominal)
    held_out = DistilledErrors(
        nominal=_tool_errors(parent, poses.T, poses.q_nominal),
        distilled=_tool_errors(parent, poses.T, poses.q_nominal + predicted),
        full=_tool_errors(parent, poses.T, poses.q_nominal + poses.correction),
    )
    return DistillationSummary(
        command=f"pisigma.distill({parent.name!r})",
        parent=ParentFigures(name=parent.name, kind=parent.kind, sha256=model.provenance.data_sha256),
        region=_region(region, poses, parent.robot),
        poses=PoseFigures(
            fitted=fitted,
            held_out=len(poses.T),
            beyond_measured_share=float((poses.status == Status.OUTSIDE_DOMAIN).double().mean()),
            inside_domain_share=float(model.domain.contains(scaled).double().mean()),
            drawn=poses.drawn_count,
            refused=poses.refused,
        ),
        sizes=sizes,
        held_out=held_out,
        joints=_joint_errors(parent.robot, poses.correction, predicted),
        warnings=_warnings(held_out, len(region.joint_values), parent.robot.dof),
        limitations=_limitations(parent, held_out.distilled, sizes),
    )


def _warnings(held_out: DistilledErrors, rows: int, joints: int) -> tuple[str, ...]:
    """Return reasons not to use the distilled model, one sentence each."""
    sentences = []
    distilled, nominal = held_out.distilled.figures_by_name, held_out.nominal.figures_by_name
    for key, what, unit in (("rms_mm", "position", "mm"), ("rms_deg", "orientation", "deg")):
        if distilled[key] > _MAX_ERROR_SHARE * nominal[key]:
            sentences.append(
                f"The network removes only {100 * max(1 - distilled[key] / nominal[key], 0):.0f} % of the nominal "
                f"{what} error ({distilled[key]:.3g} of {nominal[key]:.3g} {unit} RMS remain): the region is too "
                "large for this network; give a smaller --region, more --poses, or use the parent."
            )
    if rows < _MIN_ROWS_PER_JOINT * joints:
        sentences.append(
            f"Only {rows} rows of joint values describe the region, instead of {_MIN_ROWS_PER_JOINT * joints} or "
            "more: it is sparsely covered, and the errors are valid only near these rows."
        )
    return tuple(sentences)


def _limitations(
    parent: CalibratedModel, errors: ErrorFigures, sizes: tuple[SizeFigures, ...]
) -> tuple[str, ...]:
    """Return the properties of the full solution that the distilled model lacks, one sentence each."""
    sentences = [
        f"Exactness: on held-out poses of the region the tool is {errors.rms_mm:.4f} mm RMS (95 % within "
        f"{errors.p95_mm:.4f} mm, at most {errors.max_mm:.4f} mm) from the position of the full solution. The "
        "errors of the parent model add to these."
    ]
    features = () if parent.hybrid is None else parent.hybrid.correction.features
    harmonics = max((one.highest_harmonic for one in features), default=1)
    inputs = next(size.harmonics for size in sizes if size.is_selected)
    if harmonics > inputs:
        sentences.append(
            f"Fast ripple: the parent corrects joints with up to {harmonics} cycles per turn, while this network uses "
            f"{'sine and cosine' if inputs == 1 else f'up to {inputs} cycles'} of the joint's nominal value and only "
            f"reproduces slower ripple{_without_overtones(sizes)}."
        )
    conditions = None if parent.hybrid is None else learned_conditions(parent.hybrid.correction)
    if conditions is not None:
        names = " and ".join(conditions.names)
        sentences.append(
            f"Conditions: {names} are assumed to be at their means over the measurements of the parent."
        )
    if parent.hybrid is not None and learned_torques(parent.hybrid.correction) is not None:
        sentences.append(
            "Torques: the network assumes gravity torques computed from the joint values, not measured torques."
        )
    return (
        *sentences,
        "Reach: poses that only the calibrated robot can reach have no nominal joint values to correct, and poses near "
        f"a singularity (measure below {SINGULAR_BELOW}) were not learned.",
        "Validity: the model is valid only in its region and on its branches; elsewhere the status is "
        "OUTSIDE_DOMAIN. It does not predict its own accuracy; the parent does.",
    )


def _without_overtones(sizes: tuple[SizeFigures, ...]) -> str:
    """Return the error with only sines and cosines of the joints, if this was tried but not chosen."""
    smooth = [size for size in sizes if size.harmonics == 1]
    if not smooth or any(size.is_selected for size in smooth):
        return ""
    error = min(size.rms_mm for size in smooth)
    return f" (with sines and cosines of the joints alone it would be {error:.4f} mm RMS)"


def _region(region: Region, poses: SolvedPoses, robot: Robot) -> RegionFigures:
    """Return the bounds of the joint values and of the positions."""
    low, high = poses.q_nominal.amin(0).tolist(), poses.q_nominal.amax(0).tolist()
    bounds = torch.stack(poses.T[:, :3, 3].aminmax(dim=0), 1).flatten().tolist()
    return RegionFigures(
        kind="joints" if region.box is None else "box",
        rows=len(region.joint_values),
        box_mm=tuple(value * 1e3 for value in region.box or bounds),
        joints=tuple(
            JointRange(
                name=joint.name,
                unit=joint.file_unit,
                lower=joint.in_file_unit(a),
                upper=joint.in_file_unit(b),
            )
            for joint, a, b in zip(robot.joints, low, high, strict=True)
        ),
    )


def _tool_errors(
    parent: CalibratedModel, T: Float64[Tensor, "poses 4 4"], q: Float64[Tensor, "poses dof"]
) -> ErrorFigures:
    """Return the errors of the tool at joint values q under the full model, relative to the poses T."""
    error = pose_error(T, parent.forward(q))
    return PoseErrors(error[:, :3].norm(dim=-1), error[:, 3:].norm(dim=-1)).figures


def _joint_errors(
    robot: Robot, correction: Float64[Tensor, "poses dof"], predicted: Float64[Tensor, "poses dof"]
) -> tuple[DistilledJoint, ...]:
    """Return, for every joint, the correction of the full solution and the error of the distilled model."""
    joints = []
    for joint, full, residual in zip(robot.joints, correction.T, (correction - predicted).T, strict=True):
        sizes = {"correction": _absolute(full, joint), "error": _absolute(residual, joint)}
        joints.append(DistilledJoint(name=joint.name, unit=joint.file_unit, **sizes))
    return tuple(joints)


def _absolute(values: Float64[Tensor, " poses"], joint: Row) -> AbsoluteErrorFigures:
    size = values.abs()
    figures = {"mean": size.mean(), "rms": size.square().mean().sqrt(), "max": size.max()}
    return AbsoluteErrorFigures(**{name: joint.in_file_unit(float(value)) for name, value in figures.items()})
