"""Feature for gravity torques of unknown masses, which deflect compliant joints and gears."""

from functools import lru_cache
from typing import Any, Literal, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.joint_correction.feature import AbstractFeature, FeatureOptions, FeatureSection
from pisigma.joint_correction.onnx_chain import add_joint_frames
from pisigma.joint_correction.onnx_graph import OnnxGraph
from pisigma.measurement.conditions import JointState
from pisigma.robot.description import Robot
from pisigma.robot.kernels.forms import CompiledForm
from pisigma.robot.kinematics.forward import Geometry, iterate_rows

Direction = tuple[float, float, float]
_STORED_ROWS = 1_000
"""Largest number of rows whose columns are stored."""


class GravitySection(FeatureSection):
    """Section of gravity torques in the description of a model."""

    name: Literal["gravity"]
    gravity: Direction


@no_type_check
def add_gravity(arms: Any, correction: Any, first_value_index: int, memory: Any, q: Any) -> None:
    """Add the deflections of the joints by the gravity torques of unknown masses.

    Torque j is `Σ_k z_j · (arm_jk × g)`, with the weights of row k in `arm_jk`, and `z · (a × g) = a · (g × z)`.
    `correction.values` contains g, and four weights for joint j and moved row k: the weight of the mass divided by
    the reach, and the weights of the first moments times `ARM`. `memory.frames` contains axis and origin of every
    joint, and axes and origin of its row.
    """
    gx, gy, gz = (
        correction.values[first_value_index],
        correction.values[first_value_index + 1],
        correction.values[first_value_index + 2],
    )
    dof = arms.dof
    for j in range(dof):
        own, sign = memory.frames[j], arms.direction[j]
        zx, zy, zz = sign * own[0], sign * own[1], sign * own[2]
        u, v, w = 0.0, 0.0, 0.0
        force = 0.0
        # Joint j carries the bodies from its own row on.
        for k in range(j, dof):
            start, frame = first_value_index + 3 + 4 * (dof * j + k), memory.frames[k]
            weight = correction.values[start : start + 4]
            force += weight[0]
            u += weight[0] * (frame[15] - own[3])
            v += weight[0] * (frame[16] - own[4])
            w += weight[0] * (frame[17] - own[5])
            u += weight[1] * frame[6] + weight[2] * frame[9] + weight[3] * frame[12]
            v += weight[1] * frame[7] + weight[2] * frame[10] + weight[3] * frame[13]
            w += weight[1] * frame[8] + weight[2] * frame[11] + weight[3] * frame[14]
        if arms.revolute[j]:
            memory.delta[j] += u * (gy * zz - gz * zy) + v * (gz * zx - gx * zz) + w * (gx * zy - gy * zx)
        else:
            memory.delta[j] += force * (zx * gx + zy * gy + zz * gz)


class GravityTorques(AbstractFeature):
    """Deflection of joints by gravity torques.

    The torque on joint j is linear in the masses that it carries. For every moved row k from joint j to the tool, there
    are four columns: a mass at the origin p_k of the row's frame, and first moments along the axes u of the frame [1/m,
    scaled by `ARM` as a typical distance]::

        z_j · ((p_k - p_j) × g) / reach        z_j · (u_k × g) · ARM

    with the direction of gravity g; a weight is then compliance times mass. For a prismatic joint, the first column is
    the force `z_j · g`. The nominal geometry is used.

    Source: Whitney, Lozinski and Rourke, ASME Journal of Dynamic Systems, Measurement, and Control 108(1),
    1986, 1-8; regressors linear in the masses as in Khalil and Dombre, "Modeling, Identification and Control
    of Robots", 2002, chapter 9.
    """

    name = "gravity"
    section = GravitySection
    compiled = CompiledForm(add_gravity, frames=True)
    ARM = 0.2
    """Typical distance of centres of mass from the origins of the frames, as a share of the reach."""
    group_names = ("gravity",)
    usual_sizes = (3e-4,)
    """Prior standard deviation of the weights [rad]: 1.8e-4 for simulated arms with a payload, 8.6e-4 for the measured
    UR10 and 1.7e-4 for the UR5."""

    def __init__(self, robot: Robot, gravity: Direction = (0.0, 0.0, -1.0)) -> None:
        """Create the feature for a robot and a direction of gravity.

        Args:
            robot: the nominal robot; base and tool are not used.
            gravity: direction of gravity in the frame of the robot's first row.
        """
        super().__init__(robot)
        norm = float(np.linalg.norm(gravity))
        if not norm > 0 or not np.isfinite(norm):
            raise ValueError(f"expected a finite, non-zero direction of gravity, got {gravity}.")
        # A unit vector is not renormalised, so that restored features are identical to the last bit.
        scale = 1.0 if abs(norm - 1) < 1e-12 else norm
        x, y, z = (float(value / scale) for value in gravity)
        self.gravity: Direction = (x, y, z)
        self.used = torch.ones(robot.dof, robot.dof, dtype=torch.bool).triu().repeat_interleave(4, 1)
        self.group = torch.zeros_like(self.used, dtype=torch.int64)

    @classmethod
    def candidates(
        cls, robot: Robot, options: FeatureOptions, state: JointState
    ) -> tuple["GravityTorques", ...]:
        """Return the feature, with the direction of gravity of the options."""
        return (GravityTorques(robot, options.gravity),)

    def columns(self, state: JointState) -> Float[Tensor, "*batch dof columns"]:
        """Return the columns: torques of unit masses and moments; 0 for masses that the joint does not carry."""
        q = state.q
        z, p, carried = self._frames(q.reshape(-1, self.robot.dof))
        g, z = q.new_tensor(self.gravity), z * q.new_tensor(self.robot.directions)[:, None, None]
        lever = torch.linalg.cross(g[None, :, None].expand_as(z), z, dim=1)  # z · (a × g) = a · (g × z)
        cells = torch.stack([lever[:, c, None, None] * carried[:, :, c] for c in range(3)]).sum(0)
        origin = cells[:, :, :1] - (lever * p).sum(1)[:, None, None]
        cells = torch.cat([origin / self.robot.reach, cells[:, :, 1:] * self.ARM], 2)
        turning = torch.tensor(self.robot.revolute, device=q.device)[:, None, None, None]
        force = (z * g[:, None]).sum(1)[:, None, None] * q.new_tensor([1.0, 0.0, 0.0, 0.0])[:, None]
        cells = torch.where(turning, cells, force) * self.used.to(q).view(*cells.shape[:3], 1)
        return cells.flatten(1, 2).movedim(-1, 0).reshape(*q.shape, 4 * self.robot.dof)

    def columns_of_rows(self, state: JointState) -> Float[Tensor, "rows dof columns"]:
        """Return the columns of measured rows, stored because a calibration needs those of the same rows many times."""
        q = state.q
        is_stored_type = q.dtype == torch.float64 and q.device.type == "cpu" and not q.requires_grad
        if not (is_stored_type and 0 < len(q) <= _STORED_ROWS):
            return self.columns(state)
        return _stored_columns(self.robot, self.gravity, q.numpy().tobytes())

    def _frames(self, q: Float[Tensor, "poses dof"]) -> tuple[Tensor, Tensor, Tensor]:
        """Return axis and origin of every joint, and origin and axes of its row's frame; the pose index is last."""
        geometry = Geometry(self.robot.dh.tolist(), [0.0] * 6, [0.0] * 6)
        columns = q.t().contiguous().unbind(0)
        values: list[float | Tensor] = []
        for row, step in zip(self.robot.rows, iterate_rows(self.robot, geometry, columns), strict=True):
            if row.type != "fixed":
                for part in (*step.before[2:], step.after[3], *step.after[:3]):
                    values += part
        whole = [value if isinstance(value, Tensor) else q.new_full(q.shape[:1], value) for value in values]
        frames = torch.stack(whole).view(self.robot.dof, 6, 3, len(q))
        return frames[:, 0], frames[:, 1], frames[:, 2:]

    def pack(self, weight: Float64[np.ndarray, "dof columns"]) -> Float64[np.ndarray, " values"]:
        """Return the direction of gravity, and the scaled weights of every joint and moved row."""
        dof, slides = self.robot.dof, ~np.array(self.robot.revolute)
        masses = (weight * self.used.numpy()).reshape(dof, dof, 4)
        scale = np.where(slides[:, None], [1.0, 0.0, 0.0, 0.0], [1 / self.robot.reach, *[self.ARM] * 3])
        return np.concatenate([self.gravity, (masses * scale[:, None]).ravel()])

    def add_onnx(self, graph: OnnxGraph, weight: Float64[np.ndarray, "dof columns"], q: str) -> str:
        """Add the deflections due to gravity torques to an ONNX graph; see `AbstractFeature.add_onnx`."""
        node, dof, g = graph.add_node, self.robot.dof, np.array(self.gravity)
        axes, origins, carried = add_joint_frames(graph, self.robot, q)
        z = node("Mul", axes, self.robot.directions[:, None])
        across = np.array([[0, -g[2], g[1]], [g[2], 0, -g[0]], [-g[1], g[0], 0]])
        lever = node("MatMul", z, across.T)
        cells = node("MatMul", lever, node("Transpose", carried, perm=[0, 2, 1]))
        own = graph.reshape(graph.add_sum(node("Mul", lever, origins), 2), [dof, 1])
        origin = np.tile([1.0, 0.0, 0.0, 0.0], dof)
        scale = np.tile([1 / self.robot.reach, *[self.ARM] * 3], dof)
        turns = np.array(self.robot.revolute, dtype=np.float64)
        weight = weight * self.used.numpy()
        torques = node("Mul", node("Sub", cells, node("Mul", own, origin)), scale * weight * turns[:, None])
        force = node("Mul", graph.add_sum(node("Mul", z, g), 2), (weight * origin).sum(1) * (1 - turns))
        return node("Add", graph.add_sum(torques, 2), force)


@lru_cache(maxsize=32)
def _stored_columns(robot: Robot, gravity: Direction, q: bytes) -> Float64[Tensor, "rows dof columns"]:
    """Return the columns of the feature at joint values [rad or m], which are the bytes of an array `(rows, dof)`."""
    rows = torch.from_numpy(np.frombuffer(q).reshape(-1, robot.dof).copy())
    return GravityTorques(robot, gravity).columns(JointState(rows))
