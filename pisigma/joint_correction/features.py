"""Functions of the joint values that a joint's correction is a weighted sum of: one interface, named choices."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from pisigma.kinematics.forward import Geometry, forward_kinematics, iterate_rows
from pisigma.network.inputs import Inputs
from pisigma.robot.description import Robot

BAND_STARTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256)
"""First harmonic of every band: about two bands an octave."""


class AbstractFeatures(ABC):
    """Columns for every joint: the correction of joint j is `Σ_m weight[j, m] · columns(q)[..., j, m]`.

    Attributes:
        name: of the choice, as recipes and models write it.
        used: `(dof, m)`: which columns a joint has; the others are not to be given weights.
        group: `(dof, m)`: number of the prior size that a column's weight has, from 0 on.
        group_names: of the prior sizes.
        periodic: whether a full turn of a revolute joint changes nothing.
    """

    name: ClassVar[str]
    used: Bool[Tensor, "dof columns"]
    group: Int64[Tensor, "dof columns"]
    group_names: tuple[str, ...]
    periodic: bool = True

    @abstractmethod
    def columns(self, q: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch dof columns"]:
        """Values of the columns, of the order of 1.

        Args:
            q: joint values [rad or m], and behind them conditions, which only `ConditionFeatures` look at.
        """

    def describe(self) -> dict[str, Any]:
        """The name and what else `features_from` of `feature_description` needs to make the same features again."""
        return {"name": self.name}

    @property
    def count(self) -> int:
        """Number of columns of a joint."""
        return self.used.shape[1]


def turning_rate(robot: Robot) -> Float[np.ndarray, " dof"]:
    """Angle of a joint's periodic functions per joint value: 1 for a revolute joint [rad/rad].

    A prismatic joint repeats after twice its travel, [rad/m]; without limits its unit of travel is the reach.
    """
    travel = np.diff(robot.limits)[:, 0]
    travel = np.where(np.isfinite(travel) & (travel > 0), travel, max(robot.reach, 1e-3))
    return np.where(robot.revolute, 1.0, np.pi / travel)


class FourierSeries(AbstractFeatures):
    """sin(k q_j) and cos(k q_j) of the joint's own value, k = 1 … K: gears and encoders that run out of true.

    Weights of neighbouring harmonics share a prior size (see `BAND_STARTS`), so that the data say how the
    error's spectrum falls with k. Source of the model: Judd and Knasinski, IEEE Transactions on Robotics and
    Automation 6(1), 1990, 20-30.
    """

    name = "series"

    def __init__(self, robot: Robot, harmonics: int) -> None:
        """Take the first `harmonics` harmonics, at least one."""
        if harmonics < 1:
            raise ValueError(f"a Fourier series needs at least one harmonic, got {harmonics}.")
        self.harmonics = harmonics
        self._rate = torch.from_numpy(turning_rate(robot))
        k = torch.arange(1, harmonics + 1)
        band = torch.bucketize(k, torch.tensor(BAND_STARTS), right=True) - 1
        self.used = torch.ones(robot.dof, 2 * harmonics, dtype=torch.bool)
        self.group = torch.cat([band, band]).expand(robot.dof, -1)
        ends = [*(start - 1 for start in BAND_STARTS[1:]), harmonics]
        self.group_names = tuple(
            f"harmonics {BAND_STARTS[b]} to {min(ends[b], harmonics)}" for b in range(int(band.max()) + 1)
        )

    def describe(self) -> dict[str, Any]:
        """See `AbstractFeatures.describe`."""
        return {"name": self.name, "harmonics": self.harmonics}

    def columns(self, q: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch dof columns"]:
        """All sines, sin(q) first, and then all cosines."""
        k = torch.arange(1, self.harmonics + 1, dtype=q.dtype, device=q.device)
        angle = (q[..., : len(self._rate)] * self._rate.to(q))[..., None] * k
        return torch.cat([angle.sin(), angle.cos()], -1)


class GravityTorques(AbstractFeatures):
    """What gravity turns a joint with, for masses that are not known: joints and gears give way to it.

    The torque on joint j is linear in the masses beyond it. For every moved row k from joint j on it has four
    columns, a mass in the origin p_k of the row's frame and first moments along its axes u [1/m, scaled by
    `ARM` as a usual distance]::

        z_j · ((p_k - p_j) × g) / reach        z_j · (u_k × g) · ARM

    with g the direction of gravity; a weight is then compliance times mass. On a prismatic joint, the force
    `z_j · g`. Taken on the nominal geometry.

    Source: Whitney, Lozinski and Rourke, ASME Journal of Dynamic Systems, Measurement, and Control 108(1),
    1986, 1-8; regressors linear in the masses as in Khalil and Dombre, "Modeling, Identification and Control
    of Robots", 2002, chapter 9.
    """

    name = "gravity"
    ARM = 0.2
    """Centres of mass lie about this share of the reach from the frames' origins."""
    group_names = ("gravity",)

    def __init__(self, robot: Robot, gravity: tuple[float, float, float] = (0.0, 0.0, -1.0)) -> None:
        """Prepare for a robot.

        Args:
            robot: the nominal robot; its base and tool do not matter.
            gravity: direction in which things fall, in the frame of the robot's first row.
        """
        norm = float(np.linalg.norm(gravity))
        if not norm > 0 or not np.isfinite(norm):
            raise ValueError(f"gravity needs a direction, got {gravity}.")
        unit = (
            abs(norm - 1) < 1e-12
        )  # kept as it is, so that features made again are the same to the last bit
        self.gravity = tuple(float(x if unit else x / norm) for x in gravity)
        self._robot = robot
        self.used = torch.ones(robot.dof, robot.dof, dtype=torch.bool).triu().repeat_interleave(4, 1)
        self.group = torch.zeros_like(self.used, dtype=torch.int64)

    def describe(self) -> dict[str, Any]:
        """See `AbstractFeatures.describe`."""
        return {"name": self.name, "gravity": list(self.gravity)}

    def columns(self, q: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch dof columns"]:
        """Torques of unit masses and moments over the reach; 0 for masses before the joint."""
        q = q[..., : self._robot.dof]
        z, p, carried = self._frames(q.reshape(-1, self._robot.dof))
        g, z = q.new_tensor(self.gravity), z * q.new_tensor(self._robot.directions)[:, None, None]
        lever = torch.linalg.cross(g[None, :, None].expand_as(z), z, dim=1)  # z · (a × g) = a · (g × z)
        cells = torch.stack([lever[:, c, None, None] * carried[:, :, c] for c in range(3)]).sum(0)
        origin = cells[:, :, :1] - (lever * p).sum(1)[:, None, None]
        cells = torch.cat([origin / self._robot.reach, cells[:, :, 1:] * self.ARM], 2)
        turning = torch.tensor(self._robot.revolute, device=q.device)[:, None, None, None]
        force = (z * g[:, None]).sum(1)[:, None, None] * q.new_tensor([1.0, 0.0, 0.0, 0.0])[:, None]
        cells = torch.where(turning, cells, force) * self.used.to(q).view(*cells.shape[:3], 1)
        return cells.flatten(1, 2).movedim(-1, 0).reshape(*q.shape, 4 * self._robot.dof)

    def _frames(self, q: Float[Tensor, "poses dof"]) -> tuple[Tensor, Tensor, Tensor]:
        """Per joint its axis and origin, and the origin and the axes of its row's frame; the pose index is last."""
        geometry = Geometry(self._robot.dh.tolist(), [0.0] * 6, [0.0] * 6)

        def vector(values: tuple[float | Tensor, ...]) -> Tensor:
            return torch.stack([value * torch.ones_like(q[:, 0]) for value in values])

        found = []
        columns = q.t().contiguous().unbind(0)
        for row, step in zip(self._robot.rows, iterate_rows(self._robot, geometry, columns), strict=True):
            if row.type != "fixed":
                carried = torch.stack([vector(part) for part in (step.after[3], *step.after[:3])])
                found.append((vector(step.before[2]), vector(step.before[3]), carried))
        z, p, carried = (torch.stack(part) for part in zip(*found, strict=True))
        return z, p, carried


class SharedFeatures(AbstractFeatures):
    """The same columns for every joint: scaled joints, sines and cosines of all joints, or the paper's inputs.

    Attributes:
        name: "joints": scaled joint values (0 in the middle of the limits, ±1 at them); "sin_cos": sine and
            cosine of every revolute joint, scaled value of every prismatic one; "pose": the nominal pose's x,
            y, z over the reach, and roll, pitch, yaw (Jeong et al. 1998, section 3.2) [rad].
    """

    CHOICES = ("joints", "sin_cos", "pose")

    def __init__(self, robot: Robot, name: str) -> None:
        """Choose the columns by name."""
        if name not in self.CHOICES:
            raise ValueError(f"shared features are {', '.join(self.CHOICES)}; got '{name}'.")
        self.name = name  # type: ignore[misc]
        self.periodic = name != "joints"
        self._robot = robot
        self._inputs = Inputs.of(robot, ("x", "y", "z", "roll", "pitch", "yaw")) if name == "pose" else None
        count = self._values(torch.zeros(robot.dof, dtype=torch.float64)).shape[-1]
        self.used = torch.ones(robot.dof, count, dtype=torch.bool)
        self.group = torch.zeros(robot.dof, count, dtype=torch.int64)
        self.group_names = (name,)

    def columns(self, q: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch dof columns"]:
        """The values, once for every joint."""
        q = q[..., : self._robot.dof]
        values = self._values(q)
        return values.unsqueeze(-2).expand(*q.shape, values.shape[-1])

    def _values(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch columns"]:
        if self._inputs is not None:
            T = forward_kinematics(self._robot, q)
            values = self._inputs(T, q)
            return values / values.new_tensor([self._robot.reach] * 3 + [1.0] * 3)
        if self.name == "joints":
            return scaled_joints(self._robot, q)
        return unit_inputs(self._robot, q)


class ConditionFeatures(AbstractFeatures):
    """Payload and temperature: each times 1, sine and cosine of the joint's own value (prismatic: scaled value).

    A condition counts in standard deviations from its mean over the measured rows, so that joint values alone stand
    for the usual conditions. The payload also goes with the gravity torques of a mass at the last row's frame.

    Attributes:
        names: of the conditions, in the order in which they stand behind the joint values.
        mean: over the measured rows [kg, deg C].
        spread: standard deviation over them.
    """

    name = "conditions"

    def __init__(
        self,
        robot: Robot,
        names: Sequence[str],
        mean: Sequence[float],
        spread: Sequence[float],
        gravity: tuple[float, float, float] = (0.0, 0.0, -1.0),
    ) -> None:
        """Take some conditions.

        Raises:
            ValueError: there is none, or one does not vary.
        """
        if not names or not len(names) == len(mean) == len(spread) or min(spread) <= 0:
            raise ValueError(
                f"conditions need names, means and positive spreads, got {tuple(names)}, {tuple(mean)}, "
                f"{tuple(spread)}."
            )
        self.names, self.mean, self.spread = tuple(names), tuple(mean), tuple(spread)
        self._robot = robot
        self._torques = GravityTorques(robot, gravity)
        self.gravity = self._torques.gravity
        loaded = 4 if "payload_kg" in self.names else 0
        self.used = torch.ones(robot.dof, 3 * len(self.names) + loaded, dtype=torch.bool)
        group = [k for k in range(len(self.names)) for _ in range(3)]
        group += [self.names.index("payload_kg")] * 4 if loaded else []
        self.group = torch.tensor(group).expand(self.used.shape)
        self.group_names = self.names

    def describe(self) -> dict[str, Any]:
        """See `AbstractFeatures.describe`."""
        values = {"mean": list(self.mean), "spread": list(self.spread), "gravity": list(self.gravity)}
        return {"name": self.name, "names": list(self.names), **values}

    def columns(self, q: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch dof columns"]:
        """The products; 0 under the usual conditions, and for conditions that are NaN or not there."""
        joints, found = q[..., : self._robot.dof], q[..., self._robot.dof :]
        if found.shape[-1] == 0:
            return joints.new_zeros((*joints.shape, self.count))
        scaled = (found - q.new_tensor(self.mean)) / q.new_tensor(self.spread)
        scaled = torch.where(torch.isfinite(scaled), scaled, 0.0)
        turning = torch.tensor(self._robot.revolute, device=q.device)
        sine = torch.where(turning, joints.sin(), scaled_joints(self._robot, joints))
        cosine = torch.where(turning, joints.cos(), torch.zeros_like(joints))
        own = torch.stack([torch.ones_like(joints), sine, cosine], -1)
        parts = [own * scaled[..., k, None, None] for k in range(len(self.names))]
        if "payload_kg" in self.names:
            torques = self._torques.columns(joints)[..., -4:]
            parts.append(torques * scaled[..., self.names.index("payload_kg"), None, None])
        return torch.cat(parts, -1)


def scaled_joints(robot: Robot, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
    """Joint values, 0 in the middle of the limits and ±1 at them; without limits over pi or the reach."""
    limited = np.isfinite(robot.limits).all(1)
    bounds = np.where(limited[:, None], robot.limits, 0.0)
    middle, half = bounds.mean(1), (bounds[:, 1] - bounds[:, 0]) / 2
    half = np.where(limited, half, np.where(robot.revolute, np.pi, robot.reach))
    return (q - q.new_tensor(middle)) / q.new_tensor(half)


def unit_inputs(robot: Robot, q: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch inputs"]:
    """What product units see: sines, then cosines of the revolute joints, then scaled prismatic joints."""
    q = q[..., : robot.dof]
    turning = torch.from_numpy(np.flatnonzero(robot.revolute)).to(q.device)
    sliding = torch.from_numpy(np.flatnonzero(~np.asarray(robot.revolute))).to(q.device)
    angle = q.index_select(-1, turning)
    parts = [angle.sin(), angle.cos()]
    if len(sliding):
        parts.append(scaled_joints(robot, q).index_select(-1, sliding))
    return torch.cat(parts, -1)
