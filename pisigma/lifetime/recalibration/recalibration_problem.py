"""The problem of a recalibration: new rows, and the posterior of a model as the prior of all unknowns."""

import math
from collections.abc import Collection, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.initial_guess.initial_guess import InitialGuess, guess
from pisigma.calibration.geometric.problem.parameters import LENGTHS, ParameterSpace
from pisigma.calibration.geometric.problem.setup import (
    CalibrationSetup,
    SetupOptions,
    coordinate_change,
    setup_around,
    usable_rows,
)
from pisigma.calibration.hybrid.design import Design
from pisigma.estimation.drift import DriftGroup, LinearValues
from pisigma.estimation.loss import HampelLoss
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_to_keep_whole
from pisigma.measurement.sensors.intrinsics import without_stated
from pisigma.measurement.sensors.registry import unknown_groups
from pisigma.measurement.sensors.sensor import ParameterUnit, UnknownGroup
from pisigma.model.calibrated_model import CalibratedModel, Frames
from pisigma.model.model_posterior import ModelPosterior

FrameKey = tuple[str, str]
"""What can stand elsewhere: ("base", frame) or ("tool", target)."""
ELSEWHERE: dict[ParameterUnit, float] = {"m": 0.1, "rad": 0.1, "px": 100.0, "1": 1.0}
"""Standard deviation of a base, a tool or a sensor's unknown that stands anywhere, about its guess, by its unit."""
LARGEST_CORRECTION = 10.0
"""Size 1 of the drift of a correction, in root mean squares of its weights."""
WORTH_OF_CORRECTION = 12.0
"""[nats] Its many weights explain what a model gets wrong of few rows by chance, so it has to show more clearly."""
WORTH = math.log(100)
"""[nats] Prior odds of 1 to 100 that a thing moved since the calibration, against that nothing did."""


def frame_keys(rows: Measurements, kinds: Collection[str]) -> frozenset[FrameKey]:
    """List the owners among rows: their frames for the kind "base", and their targets for the kind "tool"."""
    names = {"base": rows.frame, "tool": rows.target}
    return frozenset((kind, name) for kind in kinds for name in names[kind])


@dataclass(frozen=True, eq=False)
class RecalibrationProblem:
    """New rows, the unknowns, and what is known of them before.

    Attributes:
        posterior: of the model.
        setup: the rows, relative to where bases and tools stand.
        design: the unknowns: all parameters of the model and the rows, and the weights of the correction.
        mean: of the unknowns, parameters counted from `design.problem.nominal`.
        root: of their covariance, parameters relative to the anchors of the setup.
        change: derivative of the parameters in the user's coordinates by those of the problem.
        groups: that may drift, with no size, and those that stand elsewhere.
        standing: root of the covariance of what is not to change.
    """

    posterior: ModelPosterior
    setup: CalibrationSetup
    design: Design
    mean: Float64[Tensor, " unknowns"]
    root: Float64[Tensor, "unknowns directions"]
    change: Float64[Tensor, "parameters parameters"]
    groups: tuple[DriftGroup, ...]
    standing: Float64[Tensor, "unknowns _directions"]

    @cached_property
    def configuration(self) -> Int64[Tensor, " rows"]:
        """Number of every row's joint values; the two rows of a pair have one."""
        return groups_to_keep_whole(self.setup.measurements)

    def wrong_rows(self, values: LinearValues) -> Bool[Tensor, " rows"]:
        """Which rows do not count: so far off that the loss drops them, or of configurations that are wrong."""
        wrong = ~torch.isin(self.configuration, values.configuration)
        return wrong | torch.isin(self.configuration, torch.tensor([*values.wrong]))

    def without_arm(self) -> "RecalibrationProblem":
        """The same where the arm is exactly as it was: only what stands elsewhere is unknown."""
        elsewhere = tuple(group for group in self.groups if group.fixed_size)
        return replace(self, root=self.standing, groups=elsewhere, standing=self.root)


def recalibration_problem(
    model: CalibratedModel, posterior: ModelPosterior, rows: Measurements, elsewhere: Set[FrameKey]
) -> RecalibrationProblem:
    """State the problem.

    Args:
        model: the model.
        posterior: of it.
        rows: new ones, frames and targets by the names of the model.
        elsewhere: bases and tools that stand elsewhere than when the model was made; those that it does not have need
            not be named.

    Raises:
        IdentificationError: nothing usable was measured, or too little to guess where something stands.
        PoseError: the joint values do not fit the robot.
    """
    posterior.space.robot.check_joint_count(rows.q.shape[1])
    usable, rows = usable_rows(without_stated(rows, posterior.geometry.unknowns))
    space = _joined_space(posterior.space, rows)
    known = {("base", name) for name in posterior.geometry.bases}
    known |= {("tool", name) for name in posterior.geometry.tools}
    new = {("base", name) for name in rows.frame} | {("tool", name) for name in rows.target}
    new = (new - known) | set(elsewhere)
    guessed = _guess(model, posterior, space, rows, new)
    setup = setup_around(space, guessed, (usable, rows), SetupOptions(True, True), None, HampelLoss())
    start = setup.start.clone()
    start[: space.arm_size] = torch.from_numpy(posterior.geometry.robot.dh.ravel().copy())
    problem = replace(setup.problem, nominal=start).with_active(range(len(start)))
    change = coordinate_change(setup, start)
    root = posterior.root.new_zeros((len(start) + len(posterior.weights), posterior.root.shape[1]))
    parameters = len(posterior.space.parameters)
    root[posterior.positions_in(space)] = posterior.root[:parameters]
    for group, name in new & known:
        root[frame_slice(space, group, name)] = 0.0
    root[: len(start)] = torch.linalg.pinv(change) @ root[: len(start)]
    root[len(start) :] = posterior.root[parameters:]
    mean = torch.cat([torch.zeros_like(start), posterior.weights])
    design = Design(problem, posterior.features)
    groups = _groups(posterior, space, rows, root, new, setup.free_unknowns)
    return RecalibrationProblem(posterior, setup, design, mean, root, change, groups, root[:, :0])


def _joined_space(space: ParameterSpace, rows: Measurements) -> ParameterSpace:
    """The parameters of a model and of rows.

    Frames and targets that the model has come first. Owners of sensors' unknowns are in the order of the rows, in
    which the sensors number them, and then those that the rows lack, in the frames where they stood before.
    """
    of_rows = {own.name: own for own in unknown_groups(rows)}
    before = {own.name: own for own in space.unknowns}
    frames = tuple(dict.fromkeys((*space.frames, *rows.frame)))
    groups = []
    for name, own in (of_rows | before).items():
        there = of_rows.get(name, UnknownGroup(name, own.columns, ()))
        stands = dict(zip(there.owners, there.frames, strict=True))
        stood = dict(zip(own.owners, own.frames or frames[:1] * len(own.owners), strict=True))
        stands |= {owner: frame for owner, frame in stood.items() if owner not in stands}
        groups.append(replace(own, owners=tuple(stands), frames=tuple(stands.values())))
    targets = tuple(dict.fromkeys((*space.targets, *rows.target)))
    return ParameterSpace(space.robot, frames, targets, tuple(groups))


def _guess(
    model: CalibratedModel,
    posterior: ModelPosterior,
    space: ParameterSpace,
    rows: Measurements,
    new: Set[FrameKey],
) -> InitialGuess:
    """Where everything but the arm is: as in the model, and guessed where it does not say that."""
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
                moved = replace(rows, q=rows.q + model.hybrid.correction.of_rows(rows))
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
    """Guessed bases or tools of those that stand elsewhere."""
    return {name: frame for name, frame in zip(names, frames, strict=True) if (kind, name) in new}


def frame_slice(space: ParameterSpace, group: str, name: str) -> slice:
    """Say where the parameters of a base or a tool stand."""
    number = (space.frames if group == "base" else space.targets).index(name)
    first = space.of(group).start + 6 * number
    return slice(first, first + 6)


def _groups(
    posterior: ModelPosterior,
    space: ParameterSpace,
    rows: Measurements,
    root: Float64[Tensor, "unknowns directions"],
    new: Set[FrameKey],
    free_unknowns: Collection[int],
) -> tuple[DriftGroup, ...]:
    """What may have drifted: the arm, bases and tools, and the correction; and what stands elsewhere."""
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
                groups.append(_elsewhere(space, what, index))
            elif name in measured:
                turn = 1 / space.robot.reach
                scale = torch.tensor([1.0, 1.0, 1.0, turn, turn, turn], dtype=torch.float64)
                groups.append(DriftGroup(what, index[free[index]], scale[free[index]], log_prior_penalty=1.0))
    for own in space.unknowns:
        for number, owner in enumerate(own.owners):
            if owner not in posterior.geometry.unknowns.get(own.name, {}):
                first = space.of(own.name).start + len(own.columns) * number
                index = torch.tensor([k for k in free_unknowns if first <= k < first + len(own.columns)])
                groups.append(_elsewhere(space, f"{own.name} {owner}", index))
    if len(posterior.weights):
        index = torch.arange(parameters, len(root))
        scale = LARGEST_CORRECTION * posterior.usual_weights
        groups.append(
            DriftGroup("correction", index, scale, log_prior_penalty=WORTH_OF_CORRECTION, single=False)
        )
    return tuple(group for group in groups if len(group.index))


def _elsewhere(space: ParameterSpace, what: str, index: Tensor) -> DriftGroup:
    """What stands anywhere about its guess."""
    scale = [ELSEWHERE[space.parameters[number].unit] for number in index.tolist()]
    return DriftGroup(what, index, torch.tensor(scale, dtype=torch.float64), 1.0, fixed_size=True)


def _arm_groups(space: ParameterSpace, free: Bool[Tensor, " parameters"]) -> list[DriftGroup]:
    """The zeros of single joints, and all other lengths and angles that were identified."""
    robot = space.robot
    zeros = {
        5 * row + (0 if turns else 1): 1.0 if turns else robot.reach
        for row, turns in zip(robot.joint_rows, robot.revolute, strict=True)
    }
    groups = [
        DriftGroup(f"joint {number}", torch.tensor([index]), torch.tensor([scale], dtype=torch.float64))
        for number, (index, scale) in enumerate(zeros.items(), 1)
    ]
    others = [index for index in range(space.arm_size) if bool(free[index]) and index not in zeros]
    for what, lengths in (("lengths", True), ("angles", False)):
        chosen = [one for one in others if (space.parameters[one].group in LENGTHS) is lengths]
        scale = torch.ones(len(chosen), dtype=torch.float64)
        groups.append(DriftGroup(what, torch.tensor(chosen, dtype=torch.int64), scale))
    return groups


def hypotheses(problem: RecalibrationProblem) -> tuple[DriftGroup, ...]:
    """Everything that can have moved by itself: joints, bases, tools, single lengths and angles; or the correction.

    The correction stands for joints that err otherwise than before in many ways, which no single motion explains. Zeros
    of joints slip more often than arms are bent: all lengths together have a tenth of the odds of a joint, and so have
    all angles.
    """
    parameters = problem.design.problem.space.parameters
    single: list[DriftGroup] = []
    for group in problem.groups:
        if group.fixed_size:
            continue
        if group.what not in ("lengths", "angles"):
            single.append(replace(group, log_prior_penalty=WORTH))
            continue
        for index, scale in zip(group.index, group.scale, strict=True):
            worth = WORTH + math.log(10 * len(group.index))
            single.append(
                DriftGroup(parameters[int(index)].name, index[None], scale[None], log_prior_penalty=worth)
            )
    return tuple(single)
