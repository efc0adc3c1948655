"""Exact touches, sockets, wires and pairs of one true welding robot, without an inverse solution."""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor

from pisigma.measurement.dataset import Measurements, join
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import transform_from_xyz_zyx

ARM = ["a_1", "a_2", "a_3", "d_4", "theta_2", "theta_3", "theta_4", "theta_5"]
TRUE_BASES = {
    "right": np.array([0.4394, 0.9822, -0.0005, math.radians(-89), 0, 0]),
    "left": np.array([0.9811, 0.4464, -0.0015, math.pi, math.radians(-0.1), math.radians(0.04)]),
    "back": np.array([0.2, -0.7, 0.1, 0.7, 0.02, -0.01]),
}
"""T_jig_base of Lim et al., Table 2, and of a third placement."""


@dataclass(frozen=True)
class TrueArm:
    nominal: Robot
    geometric_robot: Robot


@cache
def true_robot() -> TrueArm:
    """Return the welding robot with the errors of Lim et al., Table 2, "both"."""
    nominal = Robot.load("welding")
    dh, tool = nominal.dh.copy(), nominal.tool.copy()
    dh[:3, 2] += [-4.72e-3, -1.73e-3, 1.05e-3]
    dh[3, 1] += 2.8e-3
    dh[1:5, 0] += np.deg2rad([-0.24, 0.48, 0.21, -0.13])
    tool[:2] += [1.41e-3, -0.14e-3]
    return TrueArm(nominal, nominal.with_geometry(dh=dh, tool=tool))


def joints(count: int, seed: int) -> Tensor:
    """Draw joint values over a part of their ranges."""
    limits = torch.from_numpy(true_robot().nominal.limits).clamp(-2.0, 2.0)
    u = torch.rand(count, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return limits[:, 0] + (limits[:, 1] - limits[:, 0]) * u


def touch_data(
    frames: tuple[str, ...] = ("right", "left"), count: int = 60, noise: float = 0.0, axes: str = "xyz"
) -> Measurements:
    """Return touches of faces at the positions of the tip, with alternating axes."""
    parts = []
    for number, frame in enumerate(frames):
        q = joints(count, 10 + number)
        T = transform_from_xyz_zyx(torch.from_numpy(TRUE_BASES[frame])) @ forward_kinematics(
            true_robot().geometric_robot, q
        )
        axis = torch.arange(count) % len(axes)
        k = torch.tensor(["xyz".index(name) for name in axes])[axis]
        generator = torch.Generator().manual_seed(50 + number)
        off = noise * torch.randn(count, generator=generator, dtype=torch.float64)
        parts.append(
            Measurements(
                q=q,
                frame=(frame,) * count,
                touch_axis=tuple("xyz"[i] for i in k.tolist()),
                touch=T[torch.arange(count), k, 3] + off,
            )
        )
    return join(parts)


def wire_data(count: int = 80, known: bool = False) -> Measurements:
    """Return rows of a draw wire with a zero of 12 mm."""
    q, place = joints(count, 3), torch.tensor([1.5, -0.2, 0.9], dtype=torch.float64)
    p = forward_kinematics(true_robot().geometric_robot, q)[:, :3, 3]
    return Measurements(
        q=q,
        distance=(p - place).norm(dim=-1) + 0.012,
        anchor=("wire",) * count,
        anchor_place=place.expand(count, 3).clone() if known else None,
    )


def pair_data(count: int = 120) -> Measurements:
    """Return distances between pairs of poses."""
    q = joints(count, 4)
    p = forward_kinematics(true_robot().geometric_robot, q)[:, :3, 3]
    distance = (p[::2] - p[1::2]).norm(dim=-1).repeat_interleave(2)
    return Measurements(q=q, distance=distance, pair=tuple(f"pair {row // 2}" for row in range(count)))


@cache
def socket_data() -> Measurements:
    """Return rows of a ball in three pairs of sockets 50 mm apart, with orientations over a cone."""
    from pisigma.simulation import SimulatedSockets
    from pisigma.simulation.true_robot import TrueRobot

    places = {"plate": (600, 100, 100), "low": (500, -250, 60), "high": (550, 150, 400)}
    sockets = tuple(
        {"name": f"{name}/{k}", "point_mm": (x + 50 * k, y, z)}
        for name, (x, y, z) in places.items()
        for k in (0, 1)
    )
    section = SimulatedSockets(
        kind="sockets",
        sockets=sockets,  # type: ignore[arg-type]
        poses_per_socket=12,
        orientation={"home_rotation": ((1, 0, 0), (0, -1, 0), (0, 0, -1)), "spread_deg": 20},  # type: ignore[arg-type]
        seed=1,
        branch={"near_deg": {}},  # type: ignore[arg-type]
    )
    return section.measure(TrueRobot(true_robot().geometric_robot))


def mixed_data() -> Measurements:
    """Return one data set of all sensors: tracker, touches, sockets, wire and pairs, in four frames."""
    q = joints(20, 5)
    T = transform_from_xyz_zyx(torch.tensor([2.0, -1, 0.5, 1, 0.1, -0.2], dtype=torch.float64))
    T = T @ forward_kinematics(true_robot().geometric_robot, q)
    tracker = Measurements(q=q, position=T[:, :3, 3].contiguous(), frame=("tracker",) * 20)
    return join([tracker, touch_data(), socket_data(), wire_data(), pair_data(40)])
