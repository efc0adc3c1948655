"""Small real inputs of the commands in `options.txt`: rows, images, programs, controllers' files and exports."""

import re
import shutil
import socket
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from testing.board_images import CAMERA as SMALL_CAMERA
from testing.board_images import cv2, draw_board, view
from testing.camera_cell import BOARD, CAMERA, camera_cell, corner_lines
from testing.identified import hybrid_model
from testing.lerobot_arm import DATA_SETS, SO101, so101_model
from testing.models import hand_made_model, joints_around, no_type_checker
from testing.simulated_arm import simulate
from testing.two_arms import UR5, measured_positions
from testing.urdf import UrdfJoint, urdf_text

from pisigma.deployment.export.rsi import rsi_configuration
from pisigma.joint_correction.conditions import ConditionFeatures
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.measurement.camera.board import Board
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.foreign.lerobot_motors import motors_text
from pisigma.model.folder.model_folder import save_model
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import xyz_zyx_from_transform

REPOSITORY = Path(__file__).parents[2]


def prepare(folder: Path) -> None:
    """Write all inputs into an empty folder."""
    with no_type_checker():
        _rows(folder)
        _sockets(folder)
        _arms(folder)
        _corners(folder)
        _images(folder)
        _models(folder)
        _programs(folder)
    _plugins(folder)
    copy_files(folder)


def copy_files(folder: Path) -> None:
    """Copy exports of instruments, a data set and a calibration file of LeRobot, and recipes; name a free RSI port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        (folder / "here.xml").write_text(rsi_configuration(*free.getsockname()))
    shutil.copytree(DATA_SETS / "v3.0", folder / "lerobot_data")
    (folder / "follower.json").write_text(motors_text(SO101))
    shutil.copytree(REPOSITORY / "tests" / "measurement" / "foreign" / "exports", folder / "exports")
    shorter = {"poses: {count: 50,": "poses: {count: 4,", "rows: [30, 50, 100, 300]": "rows: [16]"}
    for recipe in ("kiro3", "rb5_redundancy", "ur5_camera", "ur5_hybrid"):
        text = (REPOSITORY / "training" / f"{recipe}.yaml").read_text(encoding="utf-8")
        for long, short in shorter.items():
            text = text.replace(long, short)
        (folder / f"{recipe}.yaml").write_text(text)


def _rows(folder: Path) -> None:
    """Write rows of a UR5 with a tracker (calibration, test, months later), of a fleet, and of an arm of a URDF."""
    arm = simulate("ur5", rows=96, noise=3e-5, turn_noise=1e-4, length=3e-4, angle=5e-4)
    parts = {
        "tracker": (0, 40),
        "check": (40, 60),
        "new": (60, 72),
        "2026-01-05": (72, 84),
        "2026-02-05": (84, 96),
    }
    for name, (begin, end) in parts.items():
        arm.measurements.select(torch.arange(begin, end)).write_csv(folder / f"{name}.csv", arm.nominal)
    manifest = ["id,robot,data,date"]
    for number in range(5):
        one = simulate("ur5", seed=number, rows=45, noise=3e-5, length=3e-4, angle=5e-4)
        for session, (begin, end) in enumerate(((0, 30), (30, 45)), 1):
            name = f"cell{number}_{session}.csv"
            one.measurements.select(torch.arange(begin, end)).write_csv(folder / name, one.nominal)
            manifest.append(f"cell{number},ur5,{name},2026-0{session}-01")
    (folder / "fleet.csv").write_text("\n".join(manifest[:5]) + "\n")
    (folder / "one_session.csv").write_text("\n".join([manifest[0], *manifest[1::2]]) + "\n")
    (folder / "nameless.csv").write_text("id,robot,data\ncell0,,cell0_1.csv\n")
    drawn = [
        UrdfJoint("fixed", (0, 0, 0.1), (0, 0, 0)),
        UrdfJoint("revolute", (0, 0, 0.3), (0, 0, 0)),
        UrdfJoint("revolute", (0.4, 0, 0), (0, 0, 0)),
        UrdfJoint("prismatic", (0.3, 0, 0), (np.pi, 0, 0)),
        UrdfJoint("fixed", (0, 0, 0.05), (0, 0, 0)),
    ]
    (folder / "arm.urdf").write_text(urdf_text(drawn))
    box = '<link name="l1"><visual><geometry><box size="0.1 0.1 0.3"/></geometry></visual></link>'
    (folder / "drawn.urdf").write_text(urdf_text(drawn).replace('<link name="l1"/>', box))
    joints = '<DH index="0"/>' * 6
    (folder / "arm.cfx").write_text(f'<Arm><DhArray name="dhOffset">{joints}</DhArray></Arm>')
    seven = simulate("panda", rows=30, noise=3e-5, turn_noise=1e-4)
    seven.measurements.write_csv(folder / "panda.csv", seven.nominal)
    _write_poses(folder / "poses7.csv", forward_kinematics(seven.true, seven.measurements.q[:1]))
    robot = Robot.load(folder / "arm.urdf", "l0", "l5")
    q = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (30, robot.dof)))
    p = forward_kinematics(robot.with_geometry(robot.dh + 3e-4), q)[:, :3, 3]
    Measurements(q=q, position=p + 2e-5 * torch.randn(30, 3).double()).write_csv(folder / "arm.csv", robot)
    rows = arm.measurements.select(torch.arange(30))
    moved = replace(rows, position=rows.position + torch.tensor([0.2, 0.1, 0.0]).double()).select(
        torch.arange(15, 30)
    )
    text = rows.select(torch.arange(15))
    text.write_csv(folder / "first.csv", arm.nominal)
    moved.write_csv(folder / "moved.csv", arm.nominal)
    lines = (folder / "first.csv").read_text() + "".join(
        (folder / "moved.csv").read_text().splitlines(True)[1:]
    )
    (folder / "moved.csv").write_text(lines)


def _arms(folder: Path) -> None:
    """Write a cell of two arms that were measured in the same frames."""
    (folder / "arms" / "sessions").mkdir(parents=True)
    lines = ["arms:"]
    for number, name in enumerate(("left", "right")):
        measured_positions(number, 0).write_csv(folder / "arms" / "sessions" / f"{name}.csv", UR5)
        lines.append(f"  {name}: {{robot: ur5, sessions: [sessions/{name}.csv]}}")
    (folder / "arms" / "cell.yaml").write_text("\n".join(lines) + "\n")


def _sockets(folder: Path) -> None:
    """Write rows of a SCARA robot with its ball in pairs of sockets 50 mm apart, in many wrist orientations."""
    robot = Robot.load("ur5")
    arm = simulate("ur5", rows=1, length=3e-4, angle=5e-4)
    rng, lines = np.random.default_rng(1), []
    from pisigma.robot.kinematics.numeric import solve_numeric
    from pisigma.robot.se3 import rotation_from_zyx, transform

    tool = arm.true.with_geometry(arm.true.dh, base=np.zeros(6), tool=np.array([0.06, -0.04, 0.13, 0, 0, 0]))
    for place, corner in (("a", (0.45, 0.1, 0.3)), ("b", (0.1, 0.5, 0.2)), ("c", (-0.4, 0.2, 0.4))):
        for ball_seat in (0, 1):
            ball = torch.tensor([[corner[0] + 0.05 * ball_seat, corner[1], corner[2]]]).double()
            found = 0
            while found < 8:
                R = rotation_from_zyx(torch.from_numpy(rng.uniform((-3, -0.6, 2.6), (3, 0.6, 3.6), (1, 3))))
                start = torch.from_numpy(rng.uniform(-2, 2, (1, 1, 6)))
                solved = solve_numeric(tool, transform(R, ball), start)
                q = solved.q.reshape(-1, 6)[0]
                if not bool(torch.isfinite(q).all()):
                    continue
                found += 1
                lines.append(
                    ",".join(f"{value:.8f}" for value in torch.rad2deg(q).tolist()) + f",{place}/{ball_seat}"
                )
    header = ",".join([*(f"q{k}_deg" for k in range(1, robot.dof + 1)), "socket"])
    (folder / "sockets.csv").write_text("\n".join([header, *lines]) + "\n")


def _corners(folder: Path) -> None:
    """Write corners of a board in the images of a camera on the flange, and of a fixed one."""
    for name, count, fixed in (
        ("corners", 40, False),
        ("corners_new", 12, False),
        ("fixed", 40, True),
        ("fixed_new", 12, True),
    ):
        images = camera_cell(count, 1, is_fixed=fixed).images
        (folder / f"{name}.csv").write_text("\n".join(corner_lines(images)) + "\n")
    (folder / "photos").mkdir()
    Image.new("L", (CAMERA.width, CAMERA.height), 128).save(folder / "photos" / f"{images.names[0]}.png")
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "width", "height", "name")
    (folder / "camera.yaml").write_text("".join(f"{name}: {getattr(CAMERA, name)}\n" for name in names))
    (folder / "board.yaml").write_text(f"rows: 6\ncolumns: 9\nsquare_mm: {BOARD.square * 1e3}\n")
    tool, seen = "tool: {x_mm: 30, y_mm: 20, z_mm: 60}", "near_mm: 300, far_mm: 700, oblique_deg: 45"
    for name, frame in (
        ("view", "x_mm: 420, y_mm: -120, z_mm: 50"),
        ("above", "x_mm: 450, y_mm: -100, z_mm: 900"),
    ):
        (folder / f"{name}.yaml").write_text(f"{tool}\nview: {{frame: {{{frame}, yaw_deg: 180}}, {seen}}}\n")


def _images(folder: Path) -> None:
    """Write six images of a board by a small camera, with joint values and times."""
    board = Board("small_board", 4, 5, 0.03)
    (folder / "images").mkdir()
    lines = ["image,time,q1_deg,q2_deg"]
    for number in range(6):
        R, t = view(board, 0.33, (0.9 * number, 0.5 * np.cos(1.3 * number), 0.5 * np.sin(1.3 * number)))
        t[:2] += 0.02 * np.cos(2 * number), 0.01 * np.sin(2 * number)
        cv2.imwrite(str(folder / "images" / f"{number:02d}.png"), draw_board(board, R, t))
        lines.append(f"{number:02d}.png,{number},{number},{2 * number}")
    (folder / "joints.csv").write_text("\n".join(lines) + "\n")
    (folder / "small_board.yaml").write_text("rows: 4\ncolumns: 5\nsquare_mm: 30\n")
    camera = SMALL_CAMERA
    (folder / "small_camera.yaml").write_text(
        f"width: {camera.width}\nheight: {camera.height}\nfx: 500\nfy: 500\ncx: 320\ncy: 200\n"
    )


def _models(folder: Path) -> None:
    """Write models of a UR10 with effects of payload and temperature, of a SCARA robot and of an SO-101."""
    robot = Robot.load("ur10")
    learned = ConditionFeatures(
        robot, ("payload_kg", "temperature_c"), (2.0, 22.0), (1.5, 3.0), ((0.0, 5.0), (15.0, 30.0))
    )
    arm10 = hand_made_model("ur10")
    names = {"bases": {"cell": arm10.robot.base}, "tools": {"torch": arm10.robot.tool}}
    for name, model in (
        ("loaded", hybrid_model("ur10", [FourierSeries(robot, 2), learned])),
        ("scara", hand_made_model("kiro3")),
        ("so101", so101_model()),
        ("arm10", replace(arm10, **names)),
    ):
        (folder / name).mkdir()
        save_model(model, folder / name)


def _write_poses(path: Path, T: torch.Tensor) -> list[list[float]]:
    """Write poses as a table, and return them [mm, deg]."""
    values = xyz_zyx_from_transform(T)
    poses = torch.cat([values[:, :3] * 1e3, torch.rad2deg(values[:, 3:])], 1).tolist()
    lines = [",".join(map(str, one)) for one in poses]
    path.write_text("\n".join(["x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg", *lines]) + "\n")
    return poses


def _programs(folder: Path) -> None:
    """Write poses, and programs with them."""
    near = {name: joints_around(name, 3, seed=6, spread=0.1) for name in ("ur10", "kiro3")}
    poses = _write_poses(folder / "poses.csv", forward_kinematics(Robot.load("ur10"), near["ur10"]))
    _write_poses(folder / "poses3.csv", forward_kinematics(Robot.load("kiro3"), near["kiro3"]))
    letters = [", ".join(f"{a} {v:.3f}" for a, v in zip("XYZABC", one, strict=True)) for one in poses]
    moves = "".join(f"LIN {{{one}}}\n" for one in letters)
    (folder / "cell.src").write_text(f"DEF cell()\n$BASE = BASE_DATA[1]\n$TOOL = $NULLFRAME\n{moves}END\n")
    (folder / "frames.yaml").write_text("frames:\n  BASE_DATA[1]: {x_mm: 0, y_mm: 0, z_mm: 0}\n")
    (folder / "task.csv").write_text(
        "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n10,-70,80,-30,-60,20\n20,-60,70,-40,-70,10\n"
    )
    joints = torch.rad2deg(joints_around("ur10", 40, seed=2, spread=0.1)).tolist()
    (folder / "region.csv").write_text(
        "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n"
        + "".join(",".join(map(str, one)) + "\n" for one in joints)
    )
    (folder / "cell.yaml").write_text("floor_mm: -200\n")
    (folder / "token.txt").write_text("a-long-secret-of-this-cell\n")


def _plugins(folder: Path) -> None:
    """Write the plug-ins of the documentation's pages."""
    pages = {"belt": "add-a-feature", "limits": "add-an-export", "hanging_play": "add-an-error-source"}
    pages |= {"mast": "add-a-closed-form", "plumb": "add-a-sensor"}
    for name, page in pages.items():
        text = (REPOSITORY / "docs" / "how-to" / f"{page}.md").read_text(encoding="utf-8")
        first = re.search(r"<!-- runs -->\n+```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
        assert first is not None
        (folder / f"{name}.py").write_text(first[1], encoding="utf-8")
