"""How many reachable poses the corrected inverse kinematics reaches, and how exactly, by both routes.

Run `OMP_NUM_THREADS=1 python benchmarks/inverse_reach.py`. Poses are those of random joint values, inside the joint
limits and where the model says that its correction holds. kiro3 and kiro4 are the trained models of this repository,
which correct nominal joint values; the others are catalogue robots with the errors and the correction of
`inverse_speed.py`, and a UR5 as a URDF file whose right angles are rounded to 1.5708. Residuals are those of the
calibrated model.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch
from inverse_speed import draw_joints, make_model

from pisigma.errors import ModelError
from pisigma.inverse.compiled_ik import CompiledIK
from pisigma.inverse.reference import ReferenceIK
from pisigma.kinematics.status import Status
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model

MODELS = Path(__file__).parents[1] / "models"
NEAR = 0.3
"""[rad or, a tenth, m] How far joint values to be near to are off the truth at most."""

ORIGINS = (
    ("0 0 0.089159", "0 0 0"),
    ("0 0 0", "1.5708 0 0"),
    ("-0.425 0 0", "0 0 0"),
    ("-0.39225 0 0.10915", "0 0 0"),
    ("0 -0.09465 0", "1.5708 0 0"),
    ("0 0.0823 0", "-1.5708 0 0"),
)


def rounded_urdf(folder: Path) -> str:
    """Write a UR5 as URDF with rounded angles, and give the file."""
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
    """Random joint values [rad or m] where the correction holds."""
    if model.network is None:
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
    beside = q + width * torch.from_numpy(rng.uniform(-1, 1, q.shape))
    for label, near in (("no near", None), (f"near within {NEAR} rad", beside)):
        found = ReferenceIK(model)(T, near=near)
        line = figures(found.status.numpy(), found.position_residual.numpy(), found.rotation_residual.numpy())
        print(f"{name:9s} {label:20s} reference {len(T):6d} poses, {line}", flush=True)
        try:
            kernels = CompiledIK.of(model)
        except ModelError:
            continue
        done = kernels.solve_batch(T.numpy(), near=None if near is None else near.numpy())
        line = figures(done.status, done.position_residual, done.rotation_residual)
        print(f"{name:9s} {label:20s} kernels   {len(T):6d} poses, {line}", flush=True)


def figures(status: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> str:
    """Share reached and largest residuals."""
    reached = (status != Status.UNREACHABLE) & (status != Status.OUTSIDE_JOINT_LIMITS)
    return (
        f"reached inside the limits {100 * reached.mean():7.3f} %, largest residual "
        f"{np.nanmax(position, initial=0.0):.1e} m {np.nanmax(rotation, initial=0.0):.1e} rad"
    )


def main() -> None:
    """Print the figures of all robots, or of those named."""
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "robots", nargs="*", default=["kiro3", "kiro4", "rb5", "panda", "ur5", "ur10", "urdf"]
    )
    parser.add_argument("--poses", type=int, default=10_000)
    options = parser.parse_args()
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
