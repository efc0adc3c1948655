"""Share of reachable poses that the corrected inverse kinematics reaches, and its residuals, for kernels and torch.

Run `OMP_NUM_THREADS=1 python benchmarks/inverse_reach.py`, and with `--tasks` for tasks in which some axes of the tool
are ignored and for arms with fewer or more than six joints. Poses are those of random joint values within the joint
limits and the domain of the correction. kiro3 and kiro4 are the trained models of this repository, which correct
nominal joint values; the others are catalogue robots with the errors and the correction of `inverse_speed.py`, and a
UR5 as a URDF file whose right angles are rounded to 1.5708. Residuals are those of the calibrated model.
"""

import argparse
import math
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from inverse_speed import draw_joints, make_model

from pisigma.files.errors import ModelError
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model
from pisigma.model.inverse.compiled_ik import CompiledIK
from pisigma.model.inverse.numeric_arm import NumericArm
from pisigma.model.inverse.numeric_ik import NumericIK
from pisigma.robot import Robot
from pisigma.robot.kernels.array_kinematics import transform_of
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.task_axes import task_axes
from pisigma.robot.row import Row

MODELS = Path(__file__).parents[1] / "models"
NEAR = 0.3
"""Largest distance of `near` from the true joint values [rad; for prismatic joints, a tenth of this number in m]."""

ORIGINS = (
    ("0 0 0.089159", "0 0 0"),
    ("0 0 0", "1.5708 0 0"),
    ("-0.425 0 0", "0 0 0"),
    ("-0.39225 0 0.10915", "0 0 0"),
    ("0 -0.09465 0", "1.5708 0 0"),
    ("0 0.0823 0", "-1.5708 0 0"),
)


def rounded_urdf(folder: Path) -> str:
    """Write a UR5 as URDF with rounded angles, and return the file."""
    parts = ['<robot name="rounded"><link name="link_0"/>']
    for i, (xyz, rpy) in enumerate(ORIGINS):
        parts.append(
            f'<link name="link_{i + 1}"/><joint name="joint_{i + 1}" type="revolute"><parent link="link_{i}"/>'
            f'<child link="link_{i + 1}"/><origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 1"/>'
            '<limit lower="-6.28" upper="6.28" effort="1" velocity="1"/></joint>'
        )
    file = folder / "rounded.urdf"
    file.write_text("".join(parts) + "</robot>", encoding="utf-8")
    return str(file)


def joints_in_domain(model: CalibratedModel, rows: int, rng: np.random.Generator) -> torch.Tensor:
    """Return random joint values [rad or m] within the domain of the correction."""
    if model.network is None or model.domain is None:
        return draw_joints(model.robot, rows, rng)
    lower, upper = model.starts.aminmax(dim=0)
    drawn = torch.from_numpy(rng.uniform(size=(4 * rows, model.robot.dof)))
    q = lower + (upper - lower) * drawn
    T = model.forward(q)
    nominal = q - model.correction(T, q)
    inside = model.domain.contains(model.network.scaled_inputs(T, nominal)) & torch.isfinite(T).flatten(
        1
    ).all(1)
    return q[inside][:rows]


def report(name: str, model: CalibratedModel, rows: int) -> None:
    """Print the figures of one model."""
    rng = np.random.default_rng(1)
    q = joints_in_domain(model, rows, rng)
    T = model.forward(q)
    width = torch.tensor([NEAR if revolute else NEAR / 10 for revolute in model.robot.revolute])
    nearby = q + width * torch.from_numpy(rng.uniform(-1, 1, q.shape))
    for label, near in (("no near", None), (f"near within {NEAR} rad", nearby)):
        found = NumericIK(model).solve_batch(T, near=near)
        line = figures(found.status.numpy(), found.position_residual.numpy(), found.rotation_residual.numpy())
        print(f"{name:9s} {label:20s} torch     {len(T):6d} poses, {line}", flush=True)
        try:
            kernels = CompiledIK.from_model(model)
        except ModelError:
            continue
        done = kernels.solve_batch(T.numpy(), near=None if near is None else near.numpy())
        line = figures(done.status, done.position_residual, done.rotation_residual)
        print(f"{name:9s} {label:20s} kernels   {len(T):6d} poses, {line}", flush=True)


def figures(status: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> str:
    """Return the share of reached poses and the largest residuals."""
    reached = (status != Status.UNREACHABLE) & (status != Status.OUTSIDE_JOINT_LIMITS)
    return (
        f"reached inside the limits {100 * reached.mean():7.3f} %, largest residual "
        f"{np.nanmax(position, initial=0.0):.1e} m {np.nanmax(rotation, initial=0.0):.1e} rad"
    )


FIVE = Robot(
    "five",
    "",
    "made up: three parallel axes and a wrist of two",
    tuple(
        Row(f"theta_{i}", "revolute", lower=-half, upper=half)
        for i, half in enumerate((2.9, 1.5, 2.6, 2.1, 3.1), 1)
    ),
    np.array(
        [
            (0, 0.4, 0.1, math.pi / 2, 0),
            (0, 0, 0.45, 0, 0),
            (0, 0, 0.4, 0, 0),
            (math.pi / 2, 0, 0, math.pi / 2, 0),
            (0, 0.15, 0, 0, 0),
        ]
    ),
)


def on_rail(name: str) -> Robot:
    """Return a robot of the catalogue on a rail of 3 m."""
    arm = Robot.load(name)
    rows = (Row("rail", "prismatic", lower=0.0, upper=3.0), Row("upright", "fixed"), *arm.rows)
    dh = np.array([(0, 0, 0, -math.pi / 2, 0), (0, 0, 0, math.pi / 2, 0), *arm.dh.tolist()])
    return Robot("rail", arm.maker, arm.source, rows, dh)


TASKS: tuple[tuple[str, Robot | str, tuple[str, ...] | None], ...] = (
    ("SCARA, rounded to 1e-7 m", "kiro3", None),
    ("five axes", FIVE, None),
    ("torch on six", "ur10", ("yaw",)),
    ("rail + six", on_rail("ur10"), None),
    ("seven axes", "panda", None),
)
"""Name of the task, the robot, and the ignored axes of the tool; None for the default."""


def report_tasks(rows: int) -> None:
    """Print how many poses are reached in the constrained axes, and the time per pose on one thread."""
    for label, robot, ignored in TASKS:
        rng = np.random.default_rng(0)
        model = make_model(robot, 24, rng)
        kernels = CompiledIK.from_model(model)
        T = kernels.forward(draw_joints(model.robot, rows, rng).numpy())[0]
        axes = task_axes(kernels.task_axes, ignored)
        if "yaw" in axes.ignored:
            angles = rng.uniform(-math.pi, math.pi, rows)
            T = T @ np.stack([transform_of((0, 0, 0, angle, 0, 0)) for angle in angles])
        if "SCARA" in label:
            T = T.round(7)
        kernels.solve_batch(T[:10], axes=axes)
        start = time.perf_counter()
        found = kernels.solve_batch(T, axes=axes, threads=1)
        took = (time.perf_counter() - start) / rows * 1e6
        line = figures(found.status, found.position_residual, found.rotation_residual)
        print(f"{label:24s} {rows} poses, {line}, {took:.0f} us per pose", flush=True)


def report_branches(rows: int, starts: int = 40) -> None:
    """Print how many solutions that a search from random starts finds for a calibrated UR10 are among its branches."""
    rng = np.random.default_rng(0)
    model = make_model("ur10", 24, rng)
    kernels = CompiledIK.from_model(model)
    T = kernels.forward(draw_joints(model.robot, rows, rng).numpy())[0]
    start = time.perf_counter()
    every = kernels.all_branches(T, threads=1)
    took = (time.perf_counter() - start) / rows * 1e6
    begun = draw_joints(model.robot, rows * starts, rng).reshape(rows * starts, 6)
    arm = NumericArm(model.robot, model.identified, model.hybrid, kernels.task_axes)
    q, reached = arm.iterate_to_poses(torch.from_numpy(np.repeat(T, starts, 0)), begun)
    off = np.sin((q.numpy().reshape(rows, starts, 1, 6) - every.q[:, None]) / 2)
    missed = np.nan_to_num(np.abs(off).max(-1), nan=1.0).min(-1) > 1e-4
    searched = reached.numpy().reshape(rows, starts)
    print(
        f"all branches of a UR10: {100 * (1 - (missed & searched).sum() / searched.sum()):.2f} % of {searched.sum()} "
        f"solutions found by search are among them, {took:.0f} us per pose"
    )


def main() -> None:
    """Print the figures of all robots, or of the named robots."""
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "robots", nargs="*", default=["kiro3", "kiro4", "rb5", "panda", "ur5", "ur10", "urdf"]
    )
    parser.add_argument("--poses", type=int, default=10_000)
    parser.add_argument(
        "--tasks", action="store_true", help="Solve tasks with fewer degrees of freedom, 1,000 poses each."
    )
    options = parser.parse_args()
    if options.tasks:
        report_tasks(1_000)
        report_branches(200)
        return
    with tempfile.TemporaryDirectory() as folder:
        for name in options.robots:
            if (MODELS / name).is_dir():
                model = load_model(MODELS / name)
            else:
                robot = rounded_urdf(Path(folder)) if name == "urdf" else name
                model = make_model(robot, 24, np.random.default_rng(0))
            report(name, model, options.poses)


if __name__ == "__main__":
    main()
