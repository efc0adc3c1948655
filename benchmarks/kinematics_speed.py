"""Poses per second of forward kinematics and joint Jacobian, compared with pytorch-kinematics in one run.

Both packages compute the same joint values in float64 on one thread, alternately, and the fastest round of each counts.
The peer's chain is built in float64 from the rows of the robot (a chain converted with ``.to(torch.float64)`` has
errors of 2e-8 m), and the results are compared before the measurement starts.

Then forward kinematics of NumPy arrays, which uses compiled kernels, is compared with Robotics Toolbox's
``ets.eval`` (C++) if ``roboticstoolbox`` can be imported.

Run ``python benchmarks/kinematics_speed.py [--poses 10000] [--rounds 30]``.
"""

import argparse
import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from pytorch_kinematics import SerialChain
from pytorch_kinematics.chain import Chain
from pytorch_kinematics.frame import Frame, Joint, Link
from pytorch_kinematics.transforms import Transform3d
from torch import Tensor

import pisigma
from pisigma.robot import Robot, catalogue
from pisigma.robot.kinematics.components import (
    IDENTITY,
    as_transform,
    compose_xyz_zyx,
    rotate_x,
    rotate_y,
    rotate_z,
    translate,
)
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian


def build_peer(robot: Robot) -> SerialChain:
    """Return the same robot as a pytorch-kinematics chain in float64.

    A frame of the peer first rotates about its z axis, so the fixed part of a row belongs to the next frame.
    """
    like = torch.zeros((), dtype=torch.float64)
    fixed = compose_xyz_zyx(IDENTITY, robot.base.tolist())
    root = Frame("root", Link("root"), Joint("root", dtype=torch.float64))
    parent = root
    for row, (theta, d, a, alpha, beta) in zip(robot.rows, robot.dh.tolist(), strict=True):
        if row.type != "fixed":
            frame = _frame(row.name, as_transform(fixed, like), row.type, row.direction)
            parent.add_child(frame)
            parent, fixed = frame, IDENTITY
        fixed = rotate_y(rotate_x(translate(rotate_z(fixed, theta), a, 0.0, d), alpha), beta)
    tool = as_transform(compose_xyz_zyx(fixed, robot.tool.tolist()), like)
    parent.add_child(_frame("tool", tool, "fixed", 1))
    return SerialChain(Chain(root, dtype=torch.float64), "tool", dtype=torch.float64)


def _frame(name: str, offset: Tensor, joint_type: str, direction: int) -> Frame:
    placed = Transform3d(matrix=offset[None], dtype=torch.float64)
    joint = Joint(name, placed, joint_type, axis=(0.0, 0.0, float(direction)), dtype=torch.float64)
    return Frame(f"{name}_frame" if joint_type != "fixed" else name, Link(name), joint)


def time_alternately(
    first: Callable[[], object], second: Callable[[], object], rounds: int
) -> tuple[float, float]:
    """Return the shortest time [s] of two functions, called alternately after one call to warm up."""
    best = [float("inf"), float("inf")]
    first(), second()
    for _ in range(rounds):
        for index, function in enumerate((first, second)):
            start = time.perf_counter()
            function()
            best[index] = min(best[index], time.perf_counter() - start)
    return best[0], best[1]


def compare(name: str, poses: int, rounds: int) -> None:
    """Print one line for forward kinematics and one for the Jacobian of a catalogue robot."""
    robot = Robot.load(name)
    chain = build_peer(robot)
    q = (
        torch.rand((poses, robot.dof), dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 2
        - 1
    )
    T, J = joint_jacobian(robot, q)
    difference = max(
        (forward_kinematics(robot, q) - chain.forward_kinematics(q).get_matrix()).abs().max().item(),
        (T - chain.forward_kinematics(q).get_matrix()).abs().max().item(),
        (J - chain.jacobian(q)).abs().max().item(),
    )
    if difference > 1e-12:
        raise SystemExit(f"{name}: the two disagree by {difference:.1e}, so their times mean nothing.")
    pairs = {
        "forward kinematics": (
            lambda: forward_kinematics(robot, q),
            lambda: chain.forward_kinematics(q).get_matrix(),
        ),
        "pose and Jacobian": (lambda: joint_jacobian(robot, q), lambda: chain.jacobian(q, ret_eef_pose=True)),
    }
    for what, (ours, theirs) in pairs.items():
        own, peer = time_alternately(ours, theirs, rounds)
        rates = f"{poses / own:14,.0f} {poses / peer:18,.0f} {peer / own:7.1f}"
        print(f"{name:12s} {what:19s} {rates}   {difference:.0e}")


def toolbox_chain(robot: Robot) -> Any:
    """Return the same robot as elementary transforms of Robotics Toolbox, between base and tool."""
    from roboticstoolbox import ET, ETS

    chain = ETS()
    for row, (theta, d, a, alpha, beta) in zip(robot.rows, robot.dh.tolist(), strict=True):
        chain = chain * ET.Rz(theta)
        if row.type == "revolute":
            chain = chain * ET.Rz(flip=row.direction < 0)
        elif row.type == "prismatic":
            chain = chain * ET.tz(flip=row.direction < 0)
        chain = chain * ET.tz(d) * ET.tx(a) * ET.Rx(alpha) * ET.Ry(beta)
    return chain.compile()


def compare_arrays(name: str, poses: int, rounds: int) -> None:
    """Print a line for arrays of many poses and one for a single pose."""
    robot = Robot.load(name).with_geometry(base=np.zeros(6), tool=np.zeros(6))
    many = np.random.default_rng(0).uniform(-1, 1, (poses, robot.dof))
    chain = toolbox_chain(robot) if find_spec("roboticstoolbox") else None
    if chain is not None and abs(chain.eval(many) - pisigma.forward_kinematics(robot, many)).max() > 1e-12:
        raise SystemExit(f"{name}: Robotics Toolbox disagrees, so its times mean nothing.")
    for q, times in ((many, rounds), (many[0], 100 * rounds)):
        own, peer = time_alternately(
            lambda q=q: pisigma.forward_kinematics(robot, q),  # type: ignore[misc]
            lambda q=q: None if chain is None else chain.eval(q),  # type: ignore[misc]
            times,
        )
        peer_time = (
            ""
            if chain is None
            else f"; Robotics Toolbox {peer * 1e6:,.1f} us, {peer / own:.1f} times as long"
        )
        print(f"{name:12s} array of {np.size(q) // robot.dof} poses: {own * 1e6:,.1f} us{peer_time}")


def main() -> None:
    """Print the table for all robots of the catalogue, or for the named robots."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "robots", nargs="*", default=list(catalogue()), help="Catalogue names (default: all)."
    )
    parser.add_argument("--poses", type=int, default=10_000)
    parser.add_argument("--rounds", type=int, default=30)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(
        f"{arguments.poses} poses, float64, 1 thread, torch {torch.__version__}, best of {arguments.rounds}"
    )
    head = f"{'pisigma':>14s} {'pytorch-kinematics':>18s} {'ratio':>7s}"
    print(f"{'robot':12s} {'poses/s':19s} {head}   largest difference")
    with torch.no_grad():
        for name in arguments.robots:
            compare(name, arguments.poses, arguments.rounds)
    for name in arguments.robots:
        compare_arrays(name, arguments.poses, arguments.rounds)


if __name__ == "__main__":
    main()
