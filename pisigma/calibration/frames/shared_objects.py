"""What the fits of several arms have in common: frames, sockets and anchors with the same name, and touches."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import transform_from_xyz_zyx

TOUCH, JOINT = "touch", "joint"
"""Kinds of objects that arms share if the tip of one touches that of another, and if they are on one torso."""
_DETERMINED = 1e-6
"""Ratio of the smallest to the largest standard deviation of a base's directions below which one was not estimated."""


@dataclass(frozen=True, eq=False)
class Postures:
    """Postures of an arm.

    Attributes:
        state: commanded joint values and stated conditions.
        q_corrected: joint values with their corrections [rad or m].
    """

    state: JointState
    q_corrected: Float64[Tensor, "postures dof"]

    def __getitem__(self, chosen: Tensor) -> "Postures":
        """Return the postures that a mask selects."""
        return Postures(self.state[chosen], self.q_corrected[chosen])


@dataclass(frozen=True, eq=False)
class Touches:
    """Rows of an arm whose tip touched that of another arm.

    Attributes:
        names: name of every touch; the row of the other arm has the same name.
        tips: name of the tip of every touch, as in the column `target`.
        sigma: standard deviation of every touch along an axis [m].
        postures: the postures.
    """

    names: tuple[str, ...]
    tips: tuple[str, ...]
    sigma: Float64[Tensor, " touches"]
    postures: Postures

    @staticmethod
    def from_measurements(rows: Measurements, q_corrected: Float64[Tensor, "rows dof"]) -> "Touches":
        """Return the touches in rows with `socket`, `target` and `sigma_position`."""
        assert rows.socket is not None
        assert rows.sigma_position is not None
        return Touches(
            rows.socket,
            rows.target,
            rows.sigma_position,
            Postures(JointState.from_measurements(rows), q_corrected),
        )


@dataclass(frozen=True, eq=False)
class ArmPosterior:
    """Normal distribution of the unknowns of an arm.

    Attributes:
        name: name of the arm.
        uncertainty: its parameters, with the bases of its measuring frames and the unknowns of its sensors, and the
            weights of its joint correction.
        touches: its touches with other arms; None without any.
        torso_joints: names of its first joints, which it shares with other arms of one torso.
    """

    name: str
    uncertainty: PositionUncertainty
    touches: Touches | None = None
    torso_joints: tuple[str, ...] = ()

    @property
    def space(self) -> ParameterSpace:
        """The parameters."""
        return self.uncertainty.space

    @cached_property
    def covariance_root(self) -> Float64[Tensor, "unknowns directions"]:
        """Root `R` of the covariance `R R^T`, whose first rows are those of the parameters [m and rad]."""
        return self.uncertainty.dense_root.cpu().clone()

    @cached_property
    def values(self) -> Float64[Tensor, " parameters"]:
        """Values of all parameters [m or rad]."""
        return self.uncertainty.geometry.values_of(self.space)

    def base_indices(self, frame: str) -> range:
        """Return the indices of the parameters of the base in a frame."""
        first = self.space.indices_of("base").start + 6 * self.space.frames.index(frame)
        return range(first, first + 6)

    @cached_property
    def shared_objects(self) -> dict[tuple[str, str], tuple[str, tuple[int, ...]]]:
        """Frame and parameter indices of everything that another arm could also have measured.

        These are joints of a torso, named frames in which the base was calibrated, and points at positions that were
        estimated: sockets and anchors. For a joint, the parameters are those of the rows before it; for a frame, those
        of the base. A base is not shared if the rows did not
        determine one of its directions, because such a direction keeps its previous value and has no covariance.
        """
        names = [row.name for row in self.space.robot.rows]
        found = {(JOINT, name): ("", tuple(range(5 * names.index(name)))) for name in self.torso_joints}
        found |= {
            ("frame", frame): (frame, tuple(self.base_indices(frame)))
            for frame in self.space.frames
            if frame and is_determined(self.covariance_root[list(self.base_indices(frame))])
        }
        for group in self.space.unknowns:
            first, size = self.space.indices_of(group.name).start, len(group.columns)
            for number, (owner, frame) in enumerate(zip(group.owners, group.frames, strict=False)):
                rows = tuple(range(first + size * number, first + size * (number + 1)))
                if group.has_point and bool(self.covariance_root[list(rows)].any()):
                    found[group.name, owner] = frame, rows
        return found

    @property
    def shareable_object_keys(self) -> tuple[tuple[str, str], ...]:
        """Kind and name of everything that another arm could also have measured or touched."""
        touched = () if self.touches is None else self.touches.names
        return (*self.shared_objects, *((TOUCH, name) for name in touched))

    @property
    def unknown_tips(self) -> tuple[str, ...]:
        """Names of the touching tips that are not targets of the arm's own rows."""
        tips = () if self.touches is None else dict.fromkeys(self.touches.tips)
        return tuple(tip for tip in tips if tip not in self.space.targets)

    def tool_poses_in_base(
        self, postures: Postures, target: str | None = None, tip: Float64[Tensor, " 3"] | None = None
    ) -> tuple[Float64[Tensor, "postures 4 4"], Float64[Tensor, "postures 3 unknowns"]]:
        """Return poses of a tool in the base frame of the arm, and the derivatives of its positions.

        Args:
            postures: the postures.
            target: name of the target on the tool; None for the first one.
            tip: position of a tip on the last row instead of a target [m].
        """
        known = self.uncertainty
        number = 0 if target is None or tip is not None else self.space.targets.index(target)
        tools = dict(known.geometry.tools)
        if tip is not None:
            tools[self.space.targets[0]] = np.array([*tip.tolist(), 0.0, 0.0, 0.0])
            known = replace(known, geometry=replace(known.geometry, tools=tools))
        columns = known.pose_derivatives(postures.state, postures.q_corrected, target=number)[:, :3].clone()
        base, tool = self.space.indices_of("base"), self.space.indices_of("tool")
        columns[..., base.start : base.stop if tip is None else tool.stop] = 0.0
        robot = known.geometry.robot
        T_base = transform_from_xyz_zyx(torch.from_numpy(robot.base.copy()))
        bare = robot.with_geometry(base=np.zeros(6), tool=tools[self.space.targets[number]])
        return forward_kinematics(bare, postures.q_corrected), T_base[:3, :3].mT @ columns


def is_determined(covariance_root: Float64[Tensor, "6 directions"]) -> bool:
    """Return whether all six directions of a base were estimated, by a root of its covariance [m and rad].

    A direction that was held at its previous value has no covariance.
    """
    return int(torch.linalg.matrix_rank(covariance_root, rtol=_DETERMINED)) == len(covariance_root)


@dataclass(frozen=True)
class SharedObject:
    """A frame or a point that several arms measured.

    Attributes:
        kind: "joint", "frame", the group of the sensor's unknowns, such as "socket", or "touch".
        name: its name in the rows of all these arms.
        arms: indices of the arms.
    """

    kind: str
    name: str
    arms: tuple[int, ...]

    @property
    def key(self) -> tuple[str, str]:
        """Kind and name."""
        return self.kind, self.name


def find_shared_objects(arms: Sequence[ArmPosterior]) -> tuple[SharedObject, ...]:
    """Return what two or more arms measured under one name: frames in which they are calibrated, points, and touches.

    Touches are last.
    """
    keys = dict.fromkeys(itertools.chain.from_iterable(arm.shareable_object_keys for arm in arms))
    found = (
        SharedObject(*key, tuple(k for k, arm in enumerate(arms) if key in arm.shareable_object_keys))
        for key in keys
    )
    return tuple(sorted((one for one in found if len(one.arms) > 1), key=lambda one: one.kind == TOUCH))


def uncertainty_of(result: CalibrationResult) -> PositionUncertainty:
    """Return the uncertainty of a geometric calibration."""
    solved = result.solved
    return PositionUncertainty(
        solved.problem.space, solved.geometry, (), CovarianceRoot(solved.covariance_root), variance_factor=1.0
    )
