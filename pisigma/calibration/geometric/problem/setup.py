"""Build the calibration problem with an initial guess, and convert its solutions to the user's coordinates."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.initial_guess.initial_guess import InitialGuess, guess
from pisigma.calibration.geometric.problem.joint_repeatability import with_joint_repeatability
from pisigma.calibration.geometric.problem.noise import repeat_indices
from pisigma.calibration.geometric.problem.parameters import ParameterSpace, Prior, PriorScaling
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.estimation.loss import AbstractLoss
from pisigma.files.errors import IdentificationError, Place
from pisigma.measurement.conditions import JointState, repeat_key
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.fields import KINDS
from pisigma.measurement.readings import READINGS
from pisigma.measurement.sensors.corner import CornerSensor
from pisigma.measurement.sensors.registry import build_sensors, sort_pairs_first, unknown_groups
from pisigma.measurement.sensors.sensor import SensorRows, indices_of_names
from pisigma.measurement.sensors.socket import PairOfSockets, SocketDistanceSensor
from pisigma.robot.description import Robot
from pisigma.robot.se3 import invert, rotation_from_zyx, transform_from_xyz_zyx, zyx_from_rotation


@dataclass(frozen=True, eq=False)
class ReferenceFrames:
    """Start values of bases and tools; parameters are relative to them, far from the singularity of roll, pitch, yaw.

    Attributes:
        bases: anchor of every frame: `base = anchor · base_of_problem`. Points that sensors estimate are relative to
            it, too.
        tools: anchor of every target's rotation: `R_tool = R_of_problem · anchor`.
    """

    bases: Float64[Tensor, "frames 4 4"]
    tools: Float64[Tensor, "targets 3 3"]

    def sensor_rows(self, measurements: Measurements, frame: Tensor, target: Tensor) -> SensorRows:
        """Return rows of measurements with the anchors of their bases and tools, whose indices are given."""
        bases, tools = self.bases.to(frame.device), self.tools.to(frame.device)
        return SensorRows(measurements, bases[frame], tools[target])


@dataclass(frozen=True, eq=False)
class CalibrationSetup:
    """A calibration problem with start values, ready to be solved.

    Attributes:
        problem: the problem, not yet with free parameters.
        start: start values of all parameters.
        reference_frames: frames to which bases and tools are relative.
        row_indices: indices of the problem's rows in the measurements, in the order of the problem.
        frame_of_owner: index of every owner's frame, by group of the sensors' unknowns.
        free_unknowns: indices of the sensors' unknowns to identify, such as positions of sockets.
        measurements: the rows of the problem, in the order of the problem.
        joint_repeatability: standard deviation of the value of every revolute joint [rad], relative to the estimated
            factor on the noise of corners; see `SetupOptions`.
    """

    problem: CalibrationProblem
    start: Float64[Tensor, " parameters"]
    reference_frames: ReferenceFrames
    row_indices: Tensor
    frame_of_owner: Mapping[str, Int64[Tensor, " owners"]]
    free_unknowns: list[int]
    measurements: Measurements
    joint_repeatability: float = 0.0

    def weighted_rows(self, rows: Measurements, geometry: "IdentifiedGeometry") -> Measurements:
        """Return rows of images whose covariances include the repeatability of the joints of an arm."""
        return with_joint_repeatability(
            rows, geometry.robot, geometry.bases, geometry.tools, self.joint_repeatability
        )

    def weighted_at(self, point: Float64[Tensor, " parameters"]) -> "CalibrationSetup":
        """Return the setup whose images are weighted by the repeatability of the joints of the arm at a point."""
        rows = self.weighted_rows(self.measurements, identified_geometry(self, point))
        weighted, problem = self.corner_sensor(rows), self.problem
        if weighted is None or rows is self.measurements:
            return self
        sensors = tuple(weighted if isinstance(one, CornerSensor) else one for one in problem.sensors)
        return replace(self, problem=replace(problem, sensors=sensors))

    def corner_sensor(self, rows: Measurements) -> CornerSensor | None:
        """Return the images in the rows of the problem, with the weights that these state; None without images."""
        problem, frames = self.problem, self.reference_frames
        return CornerSensor.build(frames.sensor_rows(rows, problem.frame, problem.target))


@dataclass(frozen=True)
class SetupOptions:
    """Settings for base, tool and sensors of a calibration problem.

    Attributes:
        free_base: whether to identify bases.
        free_tool: whether to identify tools.
        free_rotation: whether to identify the rotations of tools.
        base_guesses: initial guesses of bases by frame: x, y, z [m], roll, pitch, yaw [rad].
        socket_distances: distances between two sockets [m].
        socket_sigma: standard deviation of the distances between sockets [m].
        prior_scaling: see `CalibrationProblem`.
        joint_repeatability: standard deviation of the value of every revolute joint [rad], by which images are
            weighted; see `with_joint_repeatability`.
    """

    free_base: bool
    free_tool: bool
    free_rotation: bool = True
    base_guesses: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    socket_distances: Mapping[PairOfSockets, float] = field(default_factory=dict)
    socket_sigma: float = 1e-5
    prior_scaling: PriorScaling = "widened"
    joint_repeatability: float = 0.0


def build_setup(
    robot: Robot,
    measurements: Measurements,
    options: SetupOptions,
    prior: Prior | None,
    loss: AbstractLoss,
) -> CalibrationSetup:
    """Guess bases, tools and the sensors' unknowns, and build the problem relative to them.

    Raises:
        IdentificationError: measurements are missing, too few to identify all parameters, or implausible.
        PoseError: the joint values do not fit the robot.
    """
    robot.check_joint_count(measurements.q.shape[1])
    rows, measurements = usable_rows(measurements)
    space = ParameterSpace(
        robot,
        tuple(dict.fromkeys(measurements.frame)),
        tuple(dict.fromkeys(measurements.target)),
        unknown_groups(measurements),
    )
    guessed = guess(
        space, measurements, options.free_base, options.free_tool, options.free_rotation, options.base_guesses
    )
    return setup_from_guess(space, guessed, (rows, measurements), options, prior, loss)


def setup_from_guess(
    space: ParameterSpace,
    initial_guess: InitialGuess,
    indices_and_usable_rows: tuple[Tensor, Measurements],
    options: SetupOptions,
    prior: Prior | None,
    loss: AbstractLoss,
    dh: Float64[np.ndarray, "rows 5"] | None = None,
) -> CalibrationSetup:
    """Build the problem relative to an initial guess.

    Args:
        space: the parameters.
        initial_guess: bases, tools and sensors' unknowns.
        indices_and_usable_rows: result of `usable_rows`.
        options: settings of base, tool and sensors.
        prior: prior of the geometric errors.
        loss: loss function.
        dh: start values of the rows of the arm [rad and m]; None for the nominal ones.
    """
    rows, measurements = indices_and_usable_rows
    device = measurements.q.device
    frame = indices_of_names(measurements.frame, space.frames, measurements.rows).to(device)
    target = indices_of_names(measurements.target, space.targets, measurements.rows).to(device)
    unknown_frames = {
        own.name: torch.tensor([space.frames.index(name) for name in own.frames]) for own in space.unknowns
    }
    reference, start = _anchored(space, initial_guess, options, unknown_frames)
    if dh is not None:
        start[: space.arm_parameter_count] = torch.from_numpy(dh.flatten())
    start, sensors = start.to(device), build_sensors(reference.sensor_rows(measurements, frame, target))
    distances = SocketDistanceSensor.assign_distances(
        measurements, options.socket_distances, options.socket_sigma
    )
    repeats = repeat_key(measurements)
    problem = CalibrationProblem(
        space=space,
        q=measurements.q,
        frame=frame,
        target=target,
        sensors=tuple(sensors if distances is None else [*sensors, distances]),
        loss=loss,
        prior_mean=start,
        precision=torch.from_numpy(space.precision(prior)).to(device),
        active=torch.zeros(0, dtype=torch.int64, device=device),
        pose=repeat_indices(repeats, frame, target),
        configuration=repeat_indices(repeats, frame) if len(space.targets) > 1 else None,
        pair_count=len(set(measurements.pair or ()) - {""}),
        stated_conditions=JointState.from_measurements(measurements).conditions,
        prior_scaling=options.prior_scaling,
    )
    free = [
        space.indices_of(own.name).start + index
        for own in space.unknowns
        for index in initial_guess.free_unknowns[own.name].flatten().nonzero()[:, 0].tolist()
    ]
    setup = CalibrationSetup(
        problem, start, reference, rows, unknown_frames, free, measurements, options.joint_repeatability
    )
    return setup.weighted_at(start)


def usable_rows(measurements: Measurements) -> tuple[Tensor, Measurements]:
    """Return the rows with measured values; rows of pairs come first, next to each other.

    Returns:
        The indices of these rows, and the rows.

    Raises:
        IdentificationError: no row has a measured value, or all rows have the same joint values.
    """
    usable = torch.stack([measurements.is_measured(kind) for kind in (*KINDS, *READINGS)]).any(0)
    if not bool(usable.any()):
        raise IdentificationError(
            f"none of the {len(usable)} rows has a measured value",
            expected="measured values",
            value=0,
            at=Place(measurements.source),
            remedy="give positions or poses (columns x_mm, y_mm, z_mm), touches, sockets or distances",
        )
    rows = sort_pairs_first(measurements, usable.nonzero()[:, 0])
    whole = len(rows) == len(usable) and measurements.pair is None
    chosen = measurements if whole else measurements.select(rows)
    q = chosen.q
    if q.shape[0] > 1 and float((q - q[0]).abs().max()) < 1e-9:
        raise IdentificationError(
            f"all {q.shape[0]} rows have the same joint values, so they determine the noise but no parameter",
            expected="different joint values",
            value=q.shape[0],
            at=Place(measurements.source),
            remedy="measure at other joint values, spread over the workspace",
        )
    return rows, chosen


def _anchored(
    space: ParameterSpace,
    guessed: InitialGuess,
    options: SetupOptions,
    unknown_frames: Mapping[str, Int64[Tensor, " owners"]],
) -> tuple[ReferenceFrames, Float64[Tensor, " parameters"]]:
    """Return the anchors, and the start relative to them: the identity for free bases and free tool rotations."""
    bases, tools = guessed.bases.copy(), guessed.tools.copy()
    reference = ReferenceFrames(
        torch.eye(4).double().repeat(len(bases), 1, 1), torch.eye(3).double().repeat(len(tools), 1, 1)
    )
    if options.free_base:
        reference = ReferenceFrames(transform_from_xyz_zyx(torch.from_numpy(bases)), reference.tools)
        bases = np.zeros_like(bases)
    if options.free_tool:
        reference = ReferenceFrames(reference.bases, rotation_from_zyx(torch.from_numpy(tools[:, 3:])))
        tools[:, 3:] = 0
    unknowns = {
        own.name: _moved(
            invert(reference.bases)[unknown_frames[own.name]], guessed.unknowns[own.name], own.has_point
        ).numpy()
        for own in space.unknowns
    }
    return reference, space.values(bases, tools, unknowns)


def _moved(
    T: Float64[Tensor, "owners 4 4"], values: Float64[Tensor, "owners columns"], has_point: bool
) -> Float64[Tensor, "owners columns"]:
    """Return the sensors' unknowns with transformed points."""
    if not has_point:
        return values
    points = (T[:, :3, :3] @ values[:, :3, None])[..., 0] + T[:, :3, 3]
    return torch.cat([points, values[:, 3:]], 1)


@dataclass(frozen=True, eq=False)
class IdentifiedGeometry:
    """Identified robot, bases, tools and unknowns of the sensors, in the user's coordinates.

    Attributes:
        robot: the robot, with the base of the first frame and the tool of the first target.
        bases: base in every frame: x, y, z [m], roll, pitch, yaw [rad].
        tools: tool of every target, in the same form.
        unknowns: unknowns of the sensors by group and owner, in the owner's frame, such as
            `unknowns["socket"]["plate/0"]` [m or rad].
        setup: setup of the solved problem; None if it is not available.
        point: the solution in the problem's coordinates.
    """

    robot: Robot
    bases: dict[str, Float64[np.ndarray, " 6"]]
    tools: dict[str, Float64[np.ndarray, " 6"]]
    unknowns: dict[str, dict[str, Float64[np.ndarray, " columns"]]]
    setup: CalibrationSetup | None = field(default=None, repr=False)
    point: Float64[Tensor, " parameters"] | None = field(default=None, repr=False)

    @cached_property
    def coordinate_jacobian(self) -> Float64[Tensor, "parameters parameters"]:
        """Derivative of the user's coordinates with respect to the problem's; requires `setup` and `point`."""
        assert self.setup is not None
        assert self.point is not None
        return coordinate_jacobian(self.setup, self.point.cpu())

    def values_of(self, space: ParameterSpace) -> Float64[Tensor, " parameters"]:
        """Return all parameters of a space as a vector; NaN for missing unknowns of sensors."""
        unknowns = []
        for own in space.unknowns:
            missing, values = np.full(len(own.columns), np.nan), self.unknowns.get(own.name, {})
            unknowns += [values.get(owner, missing) for owner in own.owners]
        blocks = (self.robot.dh.ravel(), *self.bases.values(), *self.tools.values(), *unknowns)
        return torch.from_numpy(np.concatenate(blocks))


def identified_geometry(setup: CalibrationSetup, point: Float64[Tensor, " parameters"]) -> IdentifiedGeometry:
    """Return the geometry at a point of the problem, in the user's coordinates."""
    space = setup.problem.space
    dh, bases, tools = in_user_coordinates(setup, point)
    return IdentifiedGeometry(
        robot=space.robot.with_geometry(dh=dh, base=bases[0], tool=tools[0]),
        bases=dict(zip(space.frames, bases, strict=True)),
        tools=dict(zip(space.targets, tools, strict=True)),
        unknowns={
            own.name: dict(zip(own.owners, values, strict=True))
            for own, values in zip(space.unknowns, unknowns_in_frames(setup, point).values(), strict=True)
        },
        setup=setup,
        point=point,
    )


def in_user_coordinates(
    setup: CalibrationSetup, point: Float64[Tensor, " parameters"]
) -> tuple[Float64[np.ndarray, "rows 5"], Float64[np.ndarray, "frames 6"], Float64[np.ndarray, "targets 6"]]:
    """Return rows, bases and tools at a point of the problem, in the user's coordinates."""
    dh, bases, tools = (block.clone() for block in setup.problem.space.split(point.cpu()))
    T_anchor, R_tool = setup.reference_frames.bases.cpu(), setup.reference_frames.tools.cpu()
    R_anchor = T_anchor[:, :3, :3]
    bases[:, 3:] = zyx_from_rotation(R_anchor @ rotation_from_zyx(bases[:, 3:]))
    bases[:, :3] = (R_anchor @ bases[:, :3, None])[..., 0] + T_anchor[:, :3, 3]
    tools[:, 3:] = zyx_from_rotation(rotation_from_zyx(tools[:, 3:]) @ R_tool)
    return dh.numpy(), bases.numpy(), tools.numpy()


def coordinate_jacobian(
    setup: CalibrationSetup, point: Float64[Tensor, " parameters"]
) -> Float64[Tensor, "parameters parameters"]:
    """Return the derivative of all parameters in the user's coordinates with respect to the problem's parameters.

    Args:
        setup: setup with the anchors to which bases and tools of the problem are relative.
        point: point of the derivative, in the problem's coordinates.
    """
    space, reference_frames = setup.problem.space, setup.reference_frames
    _, bases, tools = space.split(point)
    _, user_bases, user_tools = (torch.from_numpy(block) for block in in_user_coordinates(setup, point))
    change = torch.eye(len(point), dtype=point.dtype)
    for k, anchor in enumerate(reference_frames.bases.cpu()):
        first = space.indices_of("base").start + 6 * k
        # Shifts of a base are in the axes of its anchor.
        change[first : first + 3, first : first + 3] = anchor[:3, :3]
        # Angular velocities agree in both coordinates up to the anchor; the axes convert them from and to rpy.
        # At a pitch of 90 deg, roll and yaw have the same axis; the pseudo-inverse then returns the smallest changes.
        back = torch.linalg.pinv(zyx_axes(user_bases[k, 3:]), rtol=1e-9)
        turns = slice(first + 3, first + 6)
        change[turns, turns] = back @ anchor[:3, :3] @ zyx_axes(bases[k, 3:])
    for k in range(len(tools)):
        first = space.indices_of("tool").start + 6 * k + 3
        back = torch.linalg.pinv(zyx_axes(user_tools[k, 3:]), rtol=1e-9)
        change[first : first + 3, first : first + 3] = back @ zyx_axes(tools[k, 3:])
    for own in space.unknowns:
        # Shifts of points are also in the axes of their frame's anchor.
        if own.has_point:
            for k, number in enumerate(setup.frame_of_owner[own.name].tolist()):
                first = space.indices_of(own.name).start + len(own.columns) * k
                change[first : first + 3, first : first + 3] = reference_frames.bases[number, :3, :3].cpu()
    return change


def unknowns_in_frames(
    setup: CalibrationSetup, point: Float64[Tensor, " parameters"]
) -> dict[str, Float64[np.ndarray, "owners columns"]]:
    """Return the sensors' unknowns at a point of the problem by group, in the frames of their owners."""
    space, bases = setup.problem.space, setup.reference_frames.bases.cpu()
    values = space.sensor_unknowns(point.cpu())
    return {
        own.name: _moved(bases[setup.frame_of_owner[own.name]], values[own.name].t(), own.has_point).numpy()
        for own in space.unknowns
    }


def zyx_axes(zyx: Float64[Tensor, " 3"]) -> Float64[Tensor, "3 3"]:
    """Return the rotation axes of roll, pitch and yaw as columns, for `RotZ(roll) · RotY(pitch) · RotX(yaw)`."""
    roll, pitch, _ = zyx.tolist()
    (cr, cp), (sr, sp) = ((turn(roll), turn(pitch)) for turn in (math.cos, math.sin))
    return zyx.new_tensor([[0.0, -sr, cr * cp], [0.0, cr, sr * cp], [1.0, 0.0, -sp]])
