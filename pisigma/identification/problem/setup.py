"""From measurements to a calibration problem with a start: nothing has to be guessed by the user."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.errors import IdentificationError
from pisigma.identification.identifiability.sufficiency import check_poses
from pisigma.identification.initial_guess.initial_guess import Start, find_start
from pisigma.identification.problem.loss import AbstractLoss
from pisigma.identification.problem.noise import renumbered
from pisigma.identification.problem.parameters import ParameterSpace, Prior, PriorSizes
from pisigma.identification.problem.problem import CalibrationProblem
from pisigma.measurement.conditions import JointState, repeat_key
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.fields import KINDS
from pisigma.measurement.readings import READINGS
from pisigma.robot.description import Robot
from pisigma.se3 import invert, rotation_from_rpy, transform_from_xyzrpy
from pisigma.sensors.building import (
    PairOfSockets,
    build_sensors,
    build_socket_distances,
    names_of,
    numbers_of,
)


@dataclass(frozen=True, eq=False)
class Anchors:
    """Where base and tool started; parameters are changes from there, so no angle nears its singularity.

    Attributes:
        bases: per frame, what stands before the base of the problem: `base = anchor · base_of_problem`. Places
            of sockets and anchors in the problem are behind it too.
        tools: per target, what stands behind the tool's rotation: `R_tool = R_of_problem · anchor`.
    """

    bases: Float64[Tensor, "frames 4 4"]
    tools: Float64[Tensor, "targets 3 3"]


@dataclass(frozen=True, eq=False)
class CalibrationSetup:
    """A problem ready to be solved.

    Attributes:
        problem: with no parameter free yet.
        start: values of all parameters.
        anchors: what base and tool are relative to.
        rows: which rows of the measurements the problem has, in its order.
        socket_frame: number of every socket's frame.
        anchor_frame: number of every anchor's frame.
        places_known: per anchor, whether its place is known.
        measurements: the rows of the problem, in its order.
    """

    problem: CalibrationProblem
    start: Float64[Tensor, " parameters"]
    anchors: Anchors
    rows: Tensor
    socket_frame: Int64[Tensor, " sockets"]
    anchor_frame: Int64[Tensor, " anchors"]
    places_known: tuple[bool, ...]
    measurements: Measurements

    @property
    def own_candidates(self) -> list[int]:
        """Indices of the sensors' own unknowns: places of sockets, and of anchors where they are not known."""
        space = self.problem.space
        known = [place for place in self.places_known for _ in range(4)]
        anchors = space.of("anchor")
        free = [i for i, told in zip(anchors, known, strict=True) if not told or (i - anchors.start) % 4 == 3]
        return [*space.of("socket"), *free]


@dataclass(frozen=True)
class SetupOptions:
    """What the user says of base, tool and sensors.

    Attributes:
        free_base: whether bases are to be found.
        free_tool: whether tools are to be found.
        turn_tool: whether their rotations are.
        frames: starts of bases by frame; x, y, z [m], roll, pitch, yaw [rad].
        socket_distances: known distances between two sockets [m].
        socket_sigma: how well they are known [m].
        prior_sizes: see `CalibrationProblem`.
    """

    free_base: bool
    free_tool: bool
    turn_tool: bool = True
    frames: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    socket_distances: Mapping[PairOfSockets, float] = field(default_factory=dict)
    socket_sigma: float = 1e-5
    prior_sizes: PriorSizes = "widened"


def build_setup(
    robot: Robot,
    measurements: Measurements,
    options: SetupOptions,
    prior: Prior | None,
    loss: AbstractLoss,
) -> CalibrationSetup:
    """Find a start, and state the problem relative to it.

    Raises:
        IdentificationError: nothing usable was measured, too little for what has to be found, or something
            that cannot be.
        PoseError: the joint values do not fit the robot.
    """
    robot.check_joint_count(measurements.q.shape[1])
    rows, measurements = _usable(measurements)
    space = ParameterSpace(
        robot,
        tuple(dict.fromkeys(measurements.frame)),
        tuple(dict.fromkeys(measurements.target)),
        names_of(measurements.socket),
        names_of(measurements.anchor),
    )
    found = find_start(
        space, measurements, options.free_base, options.free_tool, options.turn_tool, options.frames
    )
    device = measurements.q.device
    frame = numbers_of(measurements.frame, space.frames, measurements.rows).to(device)
    target = numbers_of(measurements.target, space.targets, measurements.rows).to(device)
    socket_frame = _frame_of(measurements.socket, space.sockets, frame)
    anchor_frame = _frame_of(measurements.anchor, space.anchors, frame)
    anchors, start = _anchored(space, found, options, socket_frame, anchor_frame)
    start = start.to(device)
    known = build_socket_distances(measurements, options.socket_distances, options.socket_sigma)
    sensors = build_sensors(measurements, anchors.bases, anchors.tools, frame, target)
    repeats = repeat_key(measurements)
    problem = CalibrationProblem(
        space=space,
        q=measurements.q,
        frame=frame,
        target=target,
        sensors=tuple(sensors if known is None else [*sensors, known]),
        loss=loss,
        nominal=start,
        precision=torch.from_numpy(space.precision(prior)).to(device),
        active=torch.zeros(0, dtype=torch.int64, device=device),
        pose=repeated(repeats, frame, target),
        configuration=repeated(repeats, frame) if len(space.targets) > 1 else None,
        pairs=len(names_of(measurements.pair)),
        stated=JointState.of(measurements).stated,
        prior_sizes=options.prior_sizes,
    )
    return CalibrationSetup(
        problem, start, anchors, rows, socket_frame, anchor_frame, found.places_known, measurements
    )


def _usable(measurements: Measurements) -> tuple[Tensor, Measurements]:
    """The rows in which something was seen; those of pairs come first, side by side."""
    seen = torch.zeros(measurements.rows, dtype=torch.bool, device=measurements.q.device)
    for kind in (*KINDS, *READINGS):
        seen = seen | measurements.measured(kind)
    if not bool(seen.any()):
        raise IdentificationError(
            f"{measurements.source}: none of its {len(seen)} rows has a measured value; give positions or poses "
            "(columns x_mm, y_mm, z_mm), touches, sockets or distances."
        )
    rows = seen.nonzero()[:, 0]
    if measurements.pair is not None:
        order = names_of(measurements.pair)
        place = numbers_of(measurements.pair, order, measurements.rows).to(rows.device)[rows]
        place = torch.where(place < 0, len(order), place)
        rows = rows[torch.sort(place, stable=True).indices]
    whole = len(rows) == len(seen) and measurements.pair is None
    chosen = measurements if whole else measurements.select(rows)
    check_poses(chosen)
    return rows, chosen


def _frame_of(
    names: tuple[str, ...] | None, order: tuple[str, ...], frame: Tensor
) -> Int64[Tensor, " names"]:
    """The frame that every socket or anchor is in."""
    first = [(names or ()).index(name) for name in order]
    return frame[torch.tensor(first, dtype=torch.int64, device=frame.device)].cpu()


def repeated(q: Tensor, *names: Tensor) -> Tensor | None:
    """Number every row's joint values (with payload, to 1e-9) and names, such as of frame and target.

    Returns:
        None where no two rows are the same.
    """
    keys = torch.stack([*(q * 1e9).round().long().unbind(1), *names])
    mixed = torch.zeros_like(keys[0])
    for key in keys:  # integers wrap around, so equal rows mix equally
        mixed = mixed * 6_364_136_223_846_793_005 + key * 1_442_695_040_888_963_407
    found = renumbered(mixed)
    return None if int(found.max()) + 1 == len(q) else found


def _anchored(
    space: ParameterSpace,
    found: Start,
    options: SetupOptions,
    socket_frame: Int64[Tensor, " sockets"],
    anchor_frame: Int64[Tensor, " anchors"],
) -> tuple[Anchors, Float64[Tensor, " parameters"]]:
    """Bases start at their anchor, tools at their place, turned like their anchor; what is fixed has none."""
    bases, tools = found.bases.copy(), found.tools.copy()
    anchors = Anchors(
        torch.eye(4).double().repeat(len(bases), 1, 1), torch.eye(3).double().repeat(len(tools), 1, 1)
    )
    if options.free_base:
        anchors = Anchors(transform_from_xyzrpy(torch.from_numpy(bases)), anchors.tools)
        bases = np.zeros_like(bases)
    if options.free_tool:
        anchors = Anchors(anchors.bases, rotation_from_rpy(torch.from_numpy(tools[:, 3:])))
        tools[:, 3:] = 0
    back = invert(anchors.bases)
    sockets = _moved(back[socket_frame], torch.from_numpy(found.sockets))
    places = _moved(back[anchor_frame], torch.from_numpy(found.anchors[:, :3]))
    ends = np.concatenate([places.numpy(), found.anchors[:, 3:]], 1)
    return anchors, space.values(bases, tools, sockets.numpy(), ends)


def _moved(T: Float64[Tensor, "points 4 4"], points: Float64[Tensor, "points 3"]) -> Tensor:
    return (T[:, :3, :3] @ points[..., None])[..., 0] + T[:, :3, 3]
