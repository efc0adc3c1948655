"""Files and models that the calls of README and docs name, created when they are missing."""

import functools
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from click.testing import CliRunner
from gate.option_inputs import REPOSITORY, prepare
from testing.aged import original_model, rows_after_change
from testing.models import no_type_checker
from testing.phone_arm import write_video
from testing.simulated_arm import simulate
from typer.main import get_command

from pisigma.cli.main import app
from pisigma.deployment.export.programs.text import (
    format_numbers,
    metres_and_rotation_vector,
    millimetres_and_euler,
)
from pisigma.deployment.export.rewriting.frame_file import FrameFile
from pisigma.measurement.dataset import Measurements
from pisigma.model.folder.model_folder import save_model
from pisigma.planning.plan_file import read_plan
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import xyz_zyx_from_transform

Maker = Callable[[Path, Path], None]
"""Creates a file or folder from the folder of small inputs."""
_MOVED = (0.0, 0.0, 0.004, 0.0, 0.0, 0.0)


@functools.cache
def small_inputs(folder: Path) -> Path:
    """Return a folder of the inputs of `options.txt`."""
    folder.mkdir()
    prepare(folder)
    return folder


def command(*words: str) -> None:
    """Run a command that has to succeed."""
    with no_type_checker():
        done = CliRunner().invoke(get_command(app), list(words), catch_exceptions=False)
    assert done.exit_code == 0, f"pisigma {' '.join(words)}: {done.output[-500:]}"


def copy(name: str) -> Maker:
    """Copy one of the small inputs."""

    def made(path: Path, small: Path) -> None:
        (shutil.copytree if (small / name).is_dir() else shutil.copy)(small / name, path)

    return made


def measured(robot: str, begin: int = 0, end: int = 40, seed: int = 0) -> Maker:
    """Write some of 60 simulated rows of a robot, in its base frame."""

    def made(path: Path, small: Path) -> None:
        drawn = str(path.with_name(robot)) if path.with_name(robot).is_file() else robot
        errors = {"noise": 3e-5, "turn_noise": 1e-4, "length": 3e-4, "angle": 5e-4}
        arm = simulate(drawn, seed, 60, **errors, base=np.zeros(6), tool=np.zeros(6))
        arm.measurements.select(torch.arange(begin, end)).write_csv(path, arm.nominal)

    return made


def calibrated(robot: str, *options: str, rows: Maker | None = None) -> Maker:
    """Calibrate a robot."""

    def made(path: Path, small: Path) -> None:
        rows_file = path.with_name(f"{path.name}_rows.csv")
        path.parent.mkdir(parents=True, exist_ok=True)
        (rows or measured(robot))(rows_file, small)
        drawn = str(small / robot) if (small / robot).is_file() else robot
        command("calibrate", drawn, str(rows_file), "--out", str(path), "--folds", "0", *options)

    return made


def fleet(path: Path, small: Path) -> None:
    """Write a fleet of five UR10, each measured once."""
    lines = ["id,robot,data,date"]
    for seed in range(5):
        measured("ur10", 0, 30, seed)(path.with_name(f"cell{seed}.csv"), small)
        lines.append(f"cell{seed},ur10,cell{seed}.csv,2026-03-01")
    path.write_text("\n".join(lines) + "\n")


def later(seed: int, moved: tuple[float, ...] = (0.0,) * 6) -> Maker:
    """Write rows of the RB5 of `original_model`."""
    return lambda path, small: rows_after_change(30, seed, moved).write_csv(path, original_model().robot)


def before(path: Path, small: Path) -> None:
    """Write the model of the RB5."""
    path.mkdir(parents=True)
    save_model(original_model(), path)


def renewed(path: Path, small: Path) -> None:
    """Write the model of the RB5 after a joint has moved."""
    before(path.with_name("aged"), small)
    later(7, _MOVED)(path.with_name("aged.csv"), small)
    command("recalibrate", str(path.with_name("aged")), str(path.with_name("aged.csv")), "--out", str(path))


def poses_near(robot: str, q_deg: tuple[float, ...], count: int = 3) -> Maker:
    """Write poses of a robot near some joint values."""

    def made(path: Path, small: Path) -> None:
        values = xyz_zyx_from_transform(_near(robot, q_deg, count))
        rows = torch.cat([1e3 * values[:, :3], torch.rad2deg(values[:, 3:])], 1).tolist()
        lines = [",".join(map(str, row)) for row in rows]
        path.write_text("\n".join(["x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg", *lines]) + "\n")

    return made


def joints_near(q_deg: tuple[float, ...], count: int = 6) -> Maker:
    """Write joint values near some others."""

    def made(path: Path, small: Path) -> None:
        rows = np.asarray(q_deg) + 5 * np.random.default_rng(1).normal(size=(count, len(q_deg)))
        head = ",".join(f"q{k + 1}_deg" for k in range(len(q_deg)))
        path.write_text("\n".join([head, *(",".join(map(str, row)) for row in rows)]) + "\n")

    return made


def _near(robot: str, q_deg: tuple[float, ...], count: int) -> torch.Tensor:
    steps = 2 * torch.arange(count).double()[:, None]
    return forward_kinematics(Robot.load(robot), torch.deg2rad(torch.tensor(q_deg).double() + steps))


def text(content: str) -> Maker:
    """Write a text file."""
    return lambda path, small: path.write_text(content, encoding="utf-8") and None


def ur_program(path: Path, small: Path) -> None:
    """Write a URScript program of a UR5."""
    poses = [
        format_numbers(metres_and_rotation_vector(T), 9) for T in _near("ur5", (10, -80, 90, -60, -70, 20), 2)
    ]
    moves = "".join(f"  movel(p[{one}], a=0.5, v=0.1)\n" for one in poses)
    path.write_text(f"def cell():\n  set_tcp(p[0, 0, 0.1, 0, 0, 0])\n{moves}end\n")


def fanuc_program(path: Path, small: Path) -> None:
    """Write a FANUC program of the arm with six joints."""
    robot = Robot.load(small / "six.urdf", "base_link", "tool0")
    T = forward_kinematics(robot, torch.tensor([[0.2, 0.3, -0.4, 0.5, 0.6, 0.7]]).double())
    stated = FrameFile.read(path.with_name("frames.yaml"))
    frame, tool = stated.frame("UFRAME 1"), stated.tool("UTOOL 2")
    x, y, z, r, p, w = millimetres_and_euler(torch.linalg.inv(frame) @ T[0] @ tool).tolist()
    lines = [
        "/PROG WELD",
        "/MN",
        "   1:L P[1] 100mm/sec FINE ;",
        "/POS",
        "P[1]{",
        "   GP1:",
        "    UF : 1, UT : 2,     CONFIG : 'N U T, 0, 0, 0',",
        f"    X = {x:.4f} mm, Y = {y:.4f} mm, Z = {z:.4f} mm,",
        f"    W = {w:.4f} deg, P = {p:.4f} deg, R = {r:.4f} deg",
        "};",
        "/END",
    ]
    path.write_text("\n".join([*lines, ""]))


def tracked_plan(path: Path, small: Path) -> None:
    """Write what a tracker measures at all poses of the latest plan."""
    plan = read_plan(path.with_name("poses.csv"))
    true = simulate("ur10", rows=1, length=3e-4, angle=5e-4).true
    noise = torch.from_numpy(np.random.default_rng(3).normal(scale=3e-5, size=(len(plan.q), 3)))
    position = forward_kinematics(true, plan.q)[:, :3, 3] + noise
    Measurements(q=plan.q, position=position).write_csv(path, plan.arm.robot)


def by_ruler(path: Path, small: Path) -> None:
    """Write lengths between touched points of an SO-101 whose zeros are wrong."""
    robot, random = Robot.load("so101"), np.random.default_rng(0)
    q = torch.from_numpy(random.uniform(-1.2, 1.2, (80, 5)))
    dh = robot.dh.copy()
    dh[:, 0] += 0.1
    points = forward_kinematics(robot.with_geometry(dh), q)[:, :3, 3]
    lengths = (points[::2] - points[1::2]).norm(dim=1).repeat_interleave(2)
    noisy = q + 5e-3 * torch.from_numpy(random.normal(size=q.shape))
    pairs = tuple(f"p{number}" for number in range(40) for _ in range(2))
    Measurements(noisy, distance=lengths, pair=pairs).write_csv(path, robot)


def with_plumb(path: Path, small: Path) -> None:
    """Write positions of a UR5, and distances of other rows from the z axis."""
    measured("ur5", 0, 60)(path, small)
    header, *lines = path.read_text().splitlines()
    x, y = (header.split(",").index(name) for name in ("x_mm", "y_mm"))
    rows = [line.split(",") for line in lines]
    table = [f"{line}," for line in lines[:40]]
    table += [
        ",".join([*row[:6], *[""] * (len(row) - 6), str(np.hypot(*map(float, (row[x], row[y]))))])
        for row in rows[40:]
    ]
    path.write_text("\n".join([f"{header},plumb_mm", *table]) + "\n")


def images(part: str, seed: int = 1) -> Maker:
    """Write the rendered images of the camera tutorial, or one file next to them."""

    def made(path: Path, small: Path) -> None:
        folder = small / f"cell{seed}"
        if not folder.exists():
            recipe = (REPOSITORY / "training" / "ur5_camera.yaml").read_text(encoding="utf-8")
            recipe = recipe.replace("poses: {count: 50, seed: 1}", f"poses: {{count: 24, seed: {seed}}}")
            (small / f"cell{seed}.yaml").write_text(recipe, encoding="utf-8")
            command("simulate", str(small / f"cell{seed}.yaml"), "--images", str(folder))
        if part.startswith("corners"):
            files = [
                part for name in ("board", "camera") for part in (f"--{name}", str(folder / f"{name}.yaml"))
            ]
            command("detect", str(folder), *files, "--joints", str(folder / "joints.csv"), "--out", str(path))
        else:
            (shutil.copytree if not part else shutil.copy)(folder / part, path)

    return made


def phone_video(path: Path, small: Path) -> None:
    """Write the video of an arm in front of a phone, the joint values of its stops, and the board in its gripper."""
    write_video(path, 24)
    path.with_name("board.yaml").write_text(
        "kind: charuco\nrows: 4\ncolumns: 6\nsquare_mm: 18\nmarker_mm: 13\ndictionary: 4x4_50\n"
    )


def exported(model: Maker, form: str) -> Maker:
    """Export a model as a file."""

    def made(path: Path, small: Path) -> None:
        source = path.parent / "exported_model"
        if not source.exists():
            model(source, small)
        path.parent.mkdir(parents=True, exist_ok=True)
        command("export", str(source), "--format", form, "--out", str(path))

    return made


def six_joints(path: Path, small: Path) -> None:
    """Write a URDF file of an arm with six joints."""
    if not (small / "six.urdf").exists():
        rows = [
            ("0 0 0.4", "0 0 1"),
            ("0.15 0 0", "0 1 0"),
            ("0 0 0.6", "0 1 0"),
            ("0.6 0 0.1", "1 0 0"),
            ("0.1 0 0", "0 1 0"),
            ("0.1 0 0", "1 0 0"),
        ]
        names = ["base_link", *(f"link_{k}" for k in range(1, 6)), "tool0"]
        limit = '<limit lower="-3" upper="3" effort="1" velocity="1"/>'
        joints = "".join(
            f'<joint name="joint_{k + 1}" type="revolute"><origin xyz="{xyz}" rpy="0 0 0"/><parent link="{names[k]}"/>'
            f'<child link="{names[k + 1]}"/><axis xyz="{axis}"/>{limit}</joint>\n'
            for k, (xyz, axis) in enumerate(rows)
        )
        links = "".join(f'<link name="{name}"/>\n' for name in names)
        (small / "six.urdf").write_text(f'<robot name="six">\n{links}{joints}</robot>\n')
        robot = Robot.load(small / "six.urdf", "base_link", "tool0")
        q = torch.from_numpy(np.random.default_rng(0).uniform(-2, 2, (40, 6)))
        true = robot.with_geometry(
            robot.dh + np.random.default_rng(1).normal(scale=3e-4, size=robot.dh.shape)
        )
        T = forward_kinematics(true, q)
        noise = 3e-5 * torch.randn(40, 3, generator=torch.Generator().manual_seed(2)).double()
        Measurements(q=q, position=T[:, :3, 3] + noise, rotation=T[:, :3, :3]).write_csv(
            small / "six.csv", robot
        )
    shutil.copy(small / "six.urdf", path)


def six_rows(path: Path, small: Path) -> None:
    """Write measurements of that arm."""
    six_joints(path.with_name("six.urdf"), small)
    shutil.copy(small / "six.csv", path)


def six_calibrated(path: Path, small: Path) -> None:
    """Write the model of that arm."""
    six_joints(path.with_name("six.urdf"), small)
    calibrated("six.urdf", "--model", "geometric", "--tip", "tool0", rows=six_rows)(path, small)


def mast(path: Path, small: Path) -> None:
    """Write the robot of the page on closed forms."""
    rows = (
        "{name: lift, type: prismatic, limits_mm: [0, 2000], d_mm: 100}",
        "{name: turn, type: revolute, d_mm: 200}",
    )
    path.write_text("\n- ".join(["name: mast\nmaker: example\nsource: made up\nrows:", *rows]) + "\n")


RB5_NEAR = (20.0, -30.0, 90.0, 30.0, -80.0, 10.0)
UR5_NEAR = (10.0, -80.0, 90.0, -60.0, -70.0, 20.0)
T_NEAR = forward_kinematics(Robot.load("ur5"), torch.deg2rad(torch.tensor(UR5_NEAR).double()))
MY_UR5, MY_UR10 = calibrated("ur5"), calibrated("ur10")
EVERYWHERE: Mapping[str, Maker] = {
    **{name: copy(name) for name in ("board.yaml", "camera.yaml", "cell.yaml", "token.txt")},
    "tracker.csv": measured("ur5"),
    "touches.csv": measured("so101"),
    "lengths.csv": by_ruler,
    **{name: measured("ur5", 40, 60) for name in ("check.csv", "new_measurements.csv")},
    **{f"{name}.py": copy(f"{name}.py") for name in ("belt", "limits", "hanging_play", "mast", "plumb")},
    "models/my_ur5": MY_UR5,
    "models/my_rb5": before,
    "models/my_rb5_november": renewed,
    "square.csv": poses_near("rb5", RB5_NEAR),
    "task.csv": joints_near(RB5_NEAR, 40),
    "poses.csv": poses_near("ur5", UR5_NEAR),
    "my_ur5.yaml": copy("ur5_hybrid.yaml"),
    "recipe.yaml": copy("rb5_redundancy.yaml"),
    "both.csv": with_plumb,
    "calibration.conf": exported(MY_UR5, "ur-calibration"),
    "arm.urdf": six_joints,
    "poses.mp4": phone_video,
    "lerobot_data": copy("lerobot_data"),
    "follower.json": copy("follower.json"),
    "models/so101": copy("so101"),
}
"""How to create the files that pages name, except those below."""
OF_RB5 = {
    **{
        name: later(seed)
        for seed, name in enumerate(("new.csv", "check.csv", "rows.csv", "2026-10-25.csv"), 3)
    },
    "2026-11-22.csv": later(9, _MOVED),
    "cell7.csv": joints_near(RB5_NEAR),
}
