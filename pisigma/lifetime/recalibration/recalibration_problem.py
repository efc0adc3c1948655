"""Recalibration problem: new rows, and the posterior of a model as the prior of all unknowns."""

import math
from collections.abc import Collection, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.initial_guess.initial_guess import InitialGuess, guess
from pisigma.calibration.geometric.problem.joint_repeatability import corner_sigma_factor
from pisigma.calibration.geometric.problem.parameters import LENGTHS, ParameterSpace
from pisigma.calibration.geometric.problem.setup import (
    CalibrationSetup,
    SetupOptions,
    coordinate_jacobian,
    setup_from_guess,
    usable_rows,
)
from pisigma.calibration.hybrid.design import Design
from pisigma.calibration.hybrid.noise import JOINT
from pisigma.estimation.drift import DriftGroup, LinearValues
from pisigma.estimation.loss import HampelLoss
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_to_keep_whole
from pisigma.measurement.sensors.intrinsics import without_stated_priors
from pisigma.measurement.sensors.registry import unknown_groups
from pisigma.measurement.sensors.sensor import ParameterUnit, UnknownGroup
from pisigma.model.calibrated_model import CalibratedModel, Frames
from pisigma.model.model_posterior import ModelPosterior
from pisigma.robot.robot_class import RobotClass

FrameKey = tuple[str, str]
"""Key of a base or a tool: ("base", frame) or ("tool", target)."""
RELOCATION_PRIOR: dict[ParameterUnit, float] = {"m": 0.1, "rad": 0.1, "px": 100.0, "1": 1.0}
"""Prior standard deviation of a moved base, a moved tool or a new sensor unknown around its guess, by unit."""
_CORRECTION_SCALE = 10.0
"""Drift of a correction at size 1, as a multiple of the RMS of its weights."""
_CORRECTION_PENALTY = 12.0
"""Penalty on a drift of the correction [nats], whose many weights explain the errors of few rows by chance."""
_MOVEMENT_PENALTY = math.log(100)
"""Penalty on a movement [nats]: prior odds of 1 to 100 that a given joint, base or tool has moved."""


def frame_keys(rows: Measurements, kinds: Collection[str]) -> frozenset[FrameKey]:
    """Return the keys of the bases (frames) and tools (targets) of rows, for the given kinds."""
    names = {"base": rows.frame, "tool": rows.target}
    return frozenset((kind, name) for kind in kinds for name in names[kind])


def known_frames(
    posterior: ModelPosterior, rows: Measurements
) -> tuple[frozenset[FrameKey], frozenset[FrameKey]]:
    """Return the keys of the rows' bases and tools that a model has and that may have been moved since it was made."""
    known = {("base", name) for name in posterior.geometry.bases}
    known |= {("tool", name) for name in posterior.geometry.tools}
    return frame_keys(rows, ("base",)) & known, frame_keys(rows, ("tool",)) & known


@dataclass(frozen=True, eq=False)
class RecalibrationProblem:
    """New rows, the unknowns, and their prior.

    Attributes:
        posterior: posterior of the model.
        setup: rows, relative to the current bases and tools.
        design: unknowns: all parameters of the model and the rows, and the weights of the correction.
        mean: prior mean of the unknowns, with parameters relative to `design.problem.prior_mean`.
        covariance_root: root of the prior covariance of the unknowns, with parameters relative to the anchors of the
            setup.
        coordinate_jacobian: derivative of the parameters in the user's coordinates with respect to the problem's
            parameters.
        groups: groups that may drift, with size 0, and moved bases and tools.
        held_covariance_root: root of the covariance of unknowns that are held fixed.
    """

    posterior: ModelPosterior
    setup: CalibrationSetup
    design: Design
    mean: Float64[Tensor, " unknowns"]
    covariance_root: Float64[Tensor, "unknowns directions"]
    coordinate_jacobian: Float64[Tensor, "parameters parameters"]
    groups: tuple[DriftGroup, ...]
    held_covariance_root: Float64[Tensor, "unknowns _directions"]

    @cached_property
    def configuration(self) -> Int64[Tensor, " rows"]:
        """Index of every row's configuration; the two rows of a pair share one."""
        return groups_to_keep_whole(self.setup.measurements)

    def wrong_rows(self, values: LinearValues) -> Bool[Tensor, " rows"]:
        """Return the mask of rows that are not used: rejected by the loss, or of wrong configurations."""
        wrong = ~torch.isin(self.configuration, values.configuration)
        wrong[torch.tensor([*values.rejected], dtype=torch.int64)] = True
        return wrong | torch.isin(self.configuration, torch.tensor([*values.wrong_configurations]))

    def with_fixed_arm(self) -> "RecalibrationProblem":
        """Return the problem with the arm held fixed, in which only moved bases and tools are unknown."""
        relocated = tuple(group for group in self.groups if group.fixed_size)
        return replace(
            self,
            covariance_root=self.held_covariance_root,
            groups=relocated,
            held_covariance_root=self.covariance_root,
        )


def recalibration_problem(
    model: CalibratedModel, posterior: ModelPosterior, rows: Measurements, relocated: Set[FrameKey]
) -> RecalibrationProblem:
    """Set up the problem.

    Args:
        model: the model.
        posterior: posterior of the model.
        rows: new rows, frames and targets by the names of the model.
        relocated: bases and tools that have been moved since the model was made; those that the model lacks need not be
            named.

    Raises:
        IdentificationError: no usable values were measured, or too few to guess a moved base or tool.
        PoseError: the joint values do not fit the robot.
    """
    posterior.space.robot.check_joint_count(rows.q.shape[1])
    usable, rows = usable_rows(without_stated_priors(rows, posterior.geometry.unknowns))
    space = _joined_space(posterior.space, rows)
    known = {("base", name) for name in posterior.geometry.bases}
    known |= {("tool", name) for name in posterior.geometry.tools}
    new = {("base", name) for name in rows.frame} | {("tool", name) for name in rows.target}
    new = (new - known) | set(relocated)
    guessed = _guess(model, posterior, space, rows, new)
    options = SetupOptions(True, True, joint_repeatability=_joint_repeatability(posterior, rows))
    dh = posterior.geometry.robot.dh
    setup = setup_from_guess(space, guessed, (usable, rows), options, None, HampelLoss(), dh)
    start = setup.start
    problem = setup.problem.with_active(range(len(start)))
    change = coordinate_jacobian(setup, start)
    root = posterior.covariance_root.new_zeros(
        (len(start) + len(posterior.weights), posterior.covariance_root.shape[1])
    )
    parameters = len(posterior.space.parameters)
    root[posterior.parameter_indices_in(space)] = posterior.covariance_root[:parameters]
    for group, name in new & known:
        # The posterior does not apply to a frame that was moved; a wide drift group replaces it.
        root[frame_slice(space, group, name)] = 0.0
    # The stored posterior is in the user's coordinates, the problem in the coordinates of its anchors.
    root[: len(start)] = torch.linalg.pinv(change) @ root[: len(start)]
    root[len(start) :] = posterior.covariance_root[parameters:]
    mean = torch.cat([torch.zeros_like(start), posterior.weights])
    design = Design(problem, posterior.features)
    groups = _groups(posterior, space, rows, root, new, setup.free_unknowns)
    return RecalibrationProblem(posterior, setup, design, mean, root, change, groups, root[:, :0])


def _joint_repeatability(posterior: ModelPosterior, rows: Measurements) -> float:
    """Return the repeatability of the joints [rad] relative to the deviations that rows of images state."""
    known = posterior.noise.value
    if "corner" in rows.kinds and JOINT in known:
        return known[JOINT] / corner_sigma_factor(rows, known["corner"])
    return RobotClass.from_robot(posterior.space.robot).joint_repeatability


def _joined_space(space: ParameterSpace, rows: Measurements) -> ParameterSpace:
    """Return the parameters of a model, extended by those of new rows.

    Frames and targets of the model come first. Owners of sensor unknowns are in the order of the rows, which is that of
    the sensors' indices, followed by those that the rows lack, in their previous frames.
    """
    of_rows = {own.name: own for own in unknown_groups(rows)}
    before = {own.name: own for own in space.unknowns}
    frames = tuple(dict.fromkeys((*space.frames, *rows.frame)))
    groups = []
    for name, own in (of_rows | before).items():
        there = of_rows.get(name, UnknownGroup(name, own.columns, ()))
        frame_of = dict(zip(there.owners, there.frames, strict=True))
        earlier = dict(zip(own.owners, own.frames or frames[:1] * len(own.owners), strict=True))
        frame_of |= {owner: frame for owner, frame in earlier.items() if owner not in frame_of}
        groups.append(replace(own, owners=tuple(frame_of), frames=tuple(frame_of.values())))
    targets = tuple(dict.fromkeys((*space.targets, *rows.target)))
    return ParameterSpace(space.robot, frames, targets, tuple(groups))


def _guess(
    model: CalibratedModel,
    posterior: ModelPosterior,
    space: ParameterSpace,
    rows: Measurements,
    new: Set[FrameKey],
) -> InitialGuess:
    """Return the model's bases, tools and sensor unknowns; moved or new ones are guessed."""
    geometry = posterior.geometry
    bases, tools = dict(geometry.bases), dict(geometry.tools)
    unknowns = {group: dict(owners) for group, owners in geometry.unknowns.items()}
    free = {
        own.name: torch.ones(len(own.owners), len(own.columns), dtype=torch.bool) for own in space.unknowns
    }
    owners = {
        (own.name, owner)
        for own in space.unknowns
        for owner in own.owners
        if owner not in unknowns.get(own.name, {})
    }
    if new or owners:
        moved = rows
        if model.hybrid is not None:
            with torch.no_grad():
                moved = replace(rows, q=rows.q + model.hybrid.correction.for_rows(rows))
        there = ParameterSpace(
            geometry.robot,
            tuple(dict.fromkeys(rows.frame)),
            tuple(dict.fromkeys(rows.target)),
            unknown_groups(rows),
        )
        stated = {name: tuple(bases[name]) for name in there.frames if ("base", name) not in new}
        kinds = {kind for kind, _ in new}
        first = guess(there, moved, "base" in kinds, "tool" in kinds, True, stated)
        bases |= _new_frames("base", there.frames, first.bases, new)
        tools |= _new_frames("tool", there.targets, first.tools, new)
        for own in there.unknowns:
            for number, owner in enumerate(own.owners):
                unknowns.setdefault(own.name, {}).setdefault(owner, first.unknowns[own.name][number].numpy())
                if (own.name, owner) in owners:
                    free[own.name][number] = first.free_unknowns[own.name][number]
    values = {
        own.name: torch.from_numpy(np.stack([unknowns[own.name][owner] for owner in own.owners]))
        for own in space.unknowns
    }
    return InitialGuess(
        np.stack([bases[name] for name in space.frames]),
        np.stack([tools[name] for name in space.targets]),
        values,
        free,
    )


def _new_frames(kind: str, names: Sequence[str], frames: np.ndarray, new: Set[FrameKey]) -> Frames:
    """Select the guesses of moved bases or tools."""
    return {name: frame for name, frame in zip(names, frames, strict=True) if (kind, name) in new}


def frame_slice(space: ParameterSpace, group: str, name: str) -> slice:
    """Return the slice of the parameters of a base or a tool."""
    number = (space.frames if group == "base" else space.targets).index(name)
    first = space.indices_of(group).start + 6 * number
    return slice(first, first + 6)


def _groups(
    posterior: ModelPosterior,
    space: ParameterSpace,
    rows: Measurements,
    root: Float64[Tensor, "unknowns directions"],
    new: Set[FrameKey],
    free_unknowns: Collection[int],
) -> tuple[DriftGroup, ...]:
    """Return the groups that may have drifted (arm, bases, tools, correction), and those that were moved."""
    parameters = len(space.parameters)
    free = root[:parameters].any(1)
    groups = _arm_groups(space, free)
    for kind, names, measured in (
        ("base", space.frames, set(rows.frame)),
        ("tool", space.targets, set(rows.target)),
    ):
        for name in names:
            what = f"{kind} {name}" if len(names) > 1 else kind
            stretch = frame_slice(space, kind, name)
            index = torch.arange(stretch.start, stretch.stop)
            if (kind, name) in new:
                groups.append(_relocated_group(space, what, index))
            elif name in measured:
                turn = 1 / space.robot.reach
                scale = torch.tensor([1.0, 1.0, 1.0, turn, turn, turn], dtype=torch.float64)
                groups.append(DriftGroup(what, index[free[index]], scale[free[index]], log_prior_penalty=1.0))
    for own in space.unknowns:
        for number, owner in enumerate(own.owners):
            if owner not in posterior.geometry.unknowns.get(own.name, {}):
                first = space.indices_of(own.name).start + len(own.columns) * number
                index = torch.tensor([k for k in free_unknowns if first <= k < first + len(own.columns)])
                groups.append(_relocated_group(space, f"{own.name} {owner}", index))
    if len(posterior.weights):
        index = torch.arange(parameters, len(root))
        scale = _CORRECTION_SCALE * posterior.rms_weights
        groups.append(
            DriftGroup("correction", index, scale, log_prior_penalty=_CORRECTION_PENALTY, is_one_motion=False)
        )
    return tuple(group for group in groups if len(group.index))


def _relocated_group(space: ParameterSpace, what: str, index: Tensor) -> DriftGroup:
    """Return the group of a moved base or tool, with a wide prior around its guess."""
    scale = [RELOCATION_PRIOR[space.parameters[number].unit] for number in index.tolist()]
    return DriftGroup(what, index, torch.tensor(scale, dtype=torch.float64), 1.0, fixed_size=True)


def _arm_groups(space: ParameterSpace, free: Bool[Tensor, " parameters"]) -> list[DriftGroup]:
    """Return the groups of single joint zeros, and of all other identified lengths and angles."""
    robot = space.robot
    zeros = {
        5 * row + (0 if turns else 1): 1.0 if turns else robot.reach
        for row, turns in zip(robot.joint_rows, robot.revolute, strict=True)
    }
    groups = [
        DriftGroup(f"joint {number}", torch.tensor([index]), torch.tensor([scale], dtype=torch.float64))
        for number, (index, scale) in enumerate(zeros.items(), 1)
    ]
    others = [index for index in range(space.arm_parameter_count) if bool(free[index]) and index not in zeros]
    for what, lengths in (("lengths", True), ("angles", False)):
        chosen = [one for one in others if (space.parameters[one].group in LENGTHS) is lengths]
        scale = torch.ones(len(chosen), dtype=torch.float64)
        groups.append(DriftGroup(what, torch.tensor(chosen, dtype=torch.int64), scale))
    return groups


def movement_hypotheses(problem: RecalibrationProblem) -> tuple[DriftGroup, ...]:
    """List all single movements: of a joint, a base, a tool, a single length or angle, or the correction.

    A change of the correction represents joint errors that changed in many ways, which no single movement explains.
    Joint zeros slip more often than arms are bent, so all lengths together have a tenth of the odds of a joint, as do
    all angles together.
    """
    parameters = problem.design.problem.space.parameters
    single: list[DriftGroup] = []
    for group in problem.groups:
        if group.fixed_size:
            continue
        if group.name not in ("lengths", "angles"):
            single.append(replace(group, log_prior_penalty=_MOVEMENT_PENALTY))
            continue
        for index, scale in zip(group.index, group.sigma_at_unit_size, strict=True):
            penalty = _MOVEMENT_PENALTY + math.log(10 * len(group.index))
            single.append(
                DriftGroup(parameters[int(index)].name, index[None], scale[None], log_prior_penalty=penalty)
            )
    return tuple(single)
