"""The clean inputs that hostile ones are made from: measurements, robots, URDFs, recipes, models and poses."""

import os
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from testing.calibrated_arm import calibrated_arm
from testing.calibrated_ur5 import calibrated_ur5
from testing.models import REPOSITORY, hand_made_model
from testing.outside_arm import SIMULATOR, sample_joints, simulator
from testing.sensors import joints, mixed_data, true_robot
from testing.simulated_arm import simulate

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, poses_of_rows
from pisigma.model.folder.model_folder import save_model
from pisigma.robot import Robot
from pisigma.robot.kernels.machine_code import load_kernels
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.writing import robot_to_urdf, robot_to_yaml

DATA = Path(os.environ.get("PISIGMA_DATA", REPOSITORY / ".." / "shared" / "data")).resolve()
NOISE = 5e-5
"""Standard deviation of a simulated coordinate [m]."""


@dataclass(frozen=True, eq=False)
class CleanRows:
    """Clean measurements of one robot.

    Attributes:
        robot: catalogue name or file.
        path: the file of the rows.
        other: further rows of the same robot, for evaluation; None where there are none with positions.
    """

    robot: str
    path: Path
    other: Measurements | None

    @property
    def nominal(self) -> Robot:
        """The nominal robot."""
        return Robot.load(self.robot)


@dataclass(frozen=True, eq=False)
class Clean:
    """All clean inputs.

    Attributes:
        rows: measurements by name.
        robots: robot files (YAML) with the name of rows that fit them.
        urdfs: the same in URDF.
        recipes: of all kinds.
        models: model folders with the file of rows that fit them.
        poses: a file of poses that the first model reaches.
    """

    rows: dict[str, CleanRows]
    robots: dict[Path, str]
    urdfs: dict[Path, str]
    recipes: tuple[Path, ...]
    models: dict[Path, Path]
    poses: Path


def write_clean(folder: Path) -> Clean:
    """Write all clean inputs into a folder; those of measured robots and of the external simulator if available."""
    load_kernels()  # compiles them on a new machine, which would count as time of the first input
    rows = {
        name: simulated_rows(folder, name, turn=turn)
        for name, turn in (("ur5", None), ("rb5", 1e-4), ("kiro3", None))
    }
    rows |= {"welding": _all_sensors(folder), **_measured(folder)}
    rows |= {name: outside_rows(folder, name) for name in ("kr10", "rail") if SIMULATOR.is_file()}
    robots, urdfs = {}, {}
    for name in ("ur5", "kiro3", "rb5"):
        robot = Robot.load(name)
        (path := folder / f"{name}.yaml").write_text(robot_to_yaml(robot), encoding="utf-8")
        robots[path] = name
        (path := folder / f"{name}.urdf").write_text(robot_to_urdf(robot), encoding="utf-8")
        urdfs[path] = name
    urdfs |= {Path(one.robot): name for name, one in rows.items() if one.robot.endswith(".urdf")}
    recipes = tuple(
        REPOSITORY / "training" / f"{name}.yaml"
        for name in ("kiro3", "kiro4", "rb5_redundancy", "rb5_hybrid", "kiro3_physical", "ur10_inverse")
    )
    models, poses = _models(folder)
    return Clean(rows, robots, urdfs, recipes, models, poses)


def simulated_rows(
    folder: Path, name: str, seed: int = 0, rows: int = 60, turn: float | None = None, noise: float = NOISE
) -> CleanRows:
    """Measurements of a robot of the catalogue with random errors of its geometry."""
    arm = simulate(name, seed, rows + 200, noise=noise, turn_noise=turn)
    path = folder / f"{name}.csv"
    arm.measurements.select(torch.arange(rows)).write_csv(path, arm.nominal)
    return CleanRows(name, path, arm.measurements.select(torch.arange(rows, rows + 200)))


def _all_sensors(folder: Path) -> CleanRows:
    """Write rows of a tracker, touches, sockets, a wire and pairs into one file."""
    q, path = joints(200, 77), folder / "welding.csv"
    T = forward_kinematics(true_robot().geometric_robot, q)
    mixed_data().write_csv(path, true_robot().nominal)
    return CleanRows("welding", path, Measurements(q=q, position=T[:, :3, 3].contiguous()))


def _measured(folder: Path) -> dict[str, CleanRows]:
    """Return a part of the files of measured robots, and the same number of other rows."""
    files = {
        "ur5 measured": ("ur5", "ur5/grid.csv", 12),
        "ur10 measured": ("ur10", "ur10/series_c_train.csv", 24),
        "fanuc measured": ("fanuc_r2000", "fanuc_r2000/positions.csv", 1),
        "panda measured": ("panda", "panda_sockets/panda_3.csv", 2),
    }
    rows = {}
    for name, (robot, file, every) in files.items() if DATA.is_dir() else ():
        header, *lines = (DATA / file).read_text(encoding="utf-8").splitlines()
        taken = lines[::every] if every > 1 else [line for i, line in enumerate(lines) if i // 3 % 5 < 1]
        path, others = folder / f"{robot}_measured.csv", folder / f"{robot}_others.csv"
        path.write_text("\n".join([header, *taken]) + "\n", encoding="utf-8")
        others.write_text("\n".join([header, *lines[every // 2 :: every]]) + "\n", encoding="utf-8")
        other = None if "socket" in header else Measurements.read_csv(others, Robot.load(robot))
        rows[name] = CleanRows(robot, path, other)
    return rows


def outside_rows(folder: Path, name: str, seed: int = 3, rows: int = 80) -> CleanRows:
    """Simulate an arm with gears and sag, described in URDF, without any code of the package."""
    outside, stem = simulator(), str(folder / name)
    outside.URDF[stem] = outside.URDF[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # it leaves the file to be closed by Python
        outside.write_urdf(stem)
    urdf, path = Path(f"{stem}.urdf"), folder / f"{name}.csv"
    urdf.write_text(urdf.read_text(encoding="utf-8").replace(stem, name), encoding="utf-8")
    true = outside.True_(name, seed=seed)
    q, others = sample_joints(true, rows, seed + 1000), sample_joints(true, 200, seed + 2000)
    outside.write_csv(path, true, q, true.measure(q, rng=np.random.default_rng(seed))[0])
    position = torch.from_numpy(true.measure(others, rng=np.random.default_rng(seed + 1))[0])
    return CleanRows(str(urdf), path, Measurements(q=torch.from_numpy(others), position=position))


def _explained_rows(folder: Path, model: CalibratedModel) -> Path:
    """Write positions that a model predicts at its stored joint values, with noise, next to its folder."""
    path, q = folder.with_suffix(".csv"), model.starts[:40]
    with torch.no_grad():
        position = poses_of_rows(model, Measurements(q=q))[:, :3, 3].contiguous()
    noise = NOISE * torch.from_numpy(np.random.default_rng(0).normal(size=position.shape))
    Measurements(q=q, position=position + noise).write_csv(path, model.robot)
    return path


def _models(folder: Path) -> tuple[dict[Path, Path], Path]:
    """Write a geometric, a hybrid and a network model, and poses of the first."""
    geometric, q, T = calibrated_ur5(40)
    models = {}
    for name, model in {
        "ur5": geometric,
        "rb5": calibrated_arm("rb5"),
        "kiro3": hand_made_model("kiro3"),
    }.items():
        (path := folder / f"{name}_model").mkdir()
        save_model(model, path)
        models[path] = _explained_rows(path, model)
    poses = folder / "poses.csv"
    position = T[:, :3, 3] * 1e3
    rotation = Measurements(q=q, rotation=T[:, :3, :3].contiguous())
    rotation.write_csv(poses, geometric.robot)
    header, *lines = poses.read_text(encoding="utf-8").splitlines()
    first = header.split(",").index("qx")
    written = [",".join(["x_mm", "y_mm", "z_mm", *header.split(",")[first : first + 4]])]
    for line, p in zip(lines, position.tolist(), strict=True):
        written.append(",".join([*map(repr, p), *line.split(",")[first : first + 4]]))
    poses.write_text("\n".join(written) + "\n", encoding="utf-8")
    return models, poses
