"""Calibrate a simulated SO-101 that holds a ChArUco board in its gripper, with images of a phone beside it.

    OMP_NUM_THREADS=1 python benchmarks/phone.py [--seeds 4] [--first 0] [--images 40] [--drawn rendered opencv]

The zeros of the true arm are off by 5 to 17 deg, its lengths by 1 mm and its axes by 2.5 mrad; every servo repeats to
0.5 deg. The phone stands 0.6 m in front of the arm. Its intrinsics are unknown and found together with the arm: first
from the images alone by `calibrate_camera`, then by `calibrate` with intrinsics "free". Images are rendered with lens
distortion, blur, defocus, uneven light, noise, and a rolling shutter while the arm still moves by 1 mm and 0.2 deg; in
the set "opencv" OpenCV draws the board and finds the corners, without any code of pisigma.

Errors are those of corner 0 of the board in 400 other poses in which the phone sees the board: the error before is
that of the nominal arm, with the true base and tool, or with the best-fitting ones; the error after is that of the
poses that the servos really reach, compared with the error that a perfect model would have because of the noise of the
servos. The errors of the zeros are those of the shoulder lift, the elbow and the wrist flex; the zeros of the first and
the last joint cannot be distinguished from the poses of the phone and of the board.
"""

import argparse
import csv
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import yaml
from PIL import Image
from simulated_arm import rms_after_fit
from torch import Tensor

import pisigma
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.board_pose import MIN_CORNERS
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.camera.detection.markers import dictionary_of
from pisigma.measurement.dataset import Measurements
from pisigma.model.accuracy import sigma_of_rows
from pisigma.model.calibrated_model import poses_of_rows
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import invert, transform_from_xyz_zyx, xyz_zyx_from_transform
from pisigma.simulation.camera.rendering import Exposure, TrueBoard, render_image
from pisigma.simulation.camera.simulated_images import project_corners, select_far_apart
from pisigma.workflow.images.calibrate_camera import calibrate_camera
from pisigma.workflow.images.detect import detect
from pisigma.workflow.settings.images import IntrinsicsSettings

SERVO = np.deg2rad(0.5)
PHONE = Camera("phone", 1920, 1440, 1420.0, 1425.0, 965.0, 712.0, 0.06, -0.12, 3e-4, -4e-4)
BOARD = {"kind": "charuco", "rows": 4, "columns": 6, "square_mm": 18, "marker_mm": 13, "dictionary": "4x4_50"}
MOTION = np.array([1e-3] * 3 + [np.deg2rad(0.2)] * 3) / 3**0.5
"""Motion of the board while an image is read out [m and rad]; every component has a random sign."""
LIGHT = Exposure(
    blur_in_focus=1.0, focus_distance=0.6, aperture_diameter=0.002, vignetting=0.3, gradient=0.5, noise=4.0
)
OBLIQUE, NEAREST = np.deg2rad(50), 0.25
CANDIDATES, POSES, OTHERS = 8, 400, 4000
IDENTIFIABLE = slice(1, 4)
DOT, MARGIN, FINER = 1e-4, 60, 4
"""Size of a pixel of the drawn board [m], margin of the board [px], and oversampling of images that OpenCV draws."""
LIMITS = {"ratio": (0.0, 1.3), "zeros": (0.0, 0.3), "predicted": (0.8, 1.3)}


def phone_in_base() -> Tensor:
    """Return T_base_phone [m] of a phone on the table that looks at the middle of the workspace."""
    eye, middle = np.array([0.85, 0.12, 0.35]), np.array([0.25, 0.0, 0.2])
    z = (middle - eye) / np.linalg.norm(middle - eye)
    x = np.cross(z, [0, 0, 1])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], 1), eye
    return torch.from_numpy(T)


@dataclass(frozen=True, eq=False)
class Arm:
    """A true arm with base and tool of the nominal one, in the frame of the phone, and its images.

    Attributes:
        nominal: the nominal arm with the true base and tool.
        true: the true arm.
        q: commanded joint values of the images [rad].
        others: joint values of the other poses [rad].
        rng: source of all noise.
    """

    nominal: Robot
    true: Robot
    q: Tensor
    others: Tensor
    rng: np.random.Generator

    @staticmethod
    def draw(seed: int, board: Board, count: int) -> "Arm":
        """Draw an arm and poses in which the phone sees the board."""
        rng, nominal = np.random.default_rng(seed), Robot.load("so101")
        dh = nominal.dh.copy()
        dh[:, 0] += np.deg2rad(rng.uniform(5, 17, 5)) * rng.choice([-1, 1], 5)
        dh[:, 1:3] += rng.normal(0, 1e-3, (5, 2))
        dh[:, 3:] += rng.normal(0, 2.5e-3, (5, 2))
        T_tool_board = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
        T_tool_board[:3, 3] = -T_tool_board[:3, :3] @ torch.tensor(board.corners.mean(0))
        base = invert(phone_in_base()) @ transform_from_xyz_zyx(torch.tensor(nominal.base))
        tool = transform_from_xyz_zyx(torch.tensor(nominal.tool)) @ T_tool_board
        frames = {"base": xyz_zyx_from_transform(base).numpy(), "tool": xyz_zyx_from_transform(tool).numpy()}
        true = nominal.with_geometry(dh, **frames)
        many, others = (visible(true, board, rng, wanted) for wanted in (CANDIDATES * count, POSES))
        return Arm(nominal.with_geometry(**frames), true, select_far_apart(many, count), others, rng)

    def reached(self, q: Tensor) -> Tensor:
        """Return the joint values that the servos reach [rad]."""
        return q + SERVO * torch.from_numpy(self.rng.standard_normal(q.shape))

    def positions(self, q: Tensor) -> np.ndarray:
        """Return the positions of corner 0 in the frame of the phone [m]."""
        return forward_kinematics(self.true, q)[:, :3, 3].numpy()


def visible(arm: Robot, board: Board, rng: np.random.Generator, count: int) -> Tensor:
    """Draw joint values [rad] in which the phone sees the whole board, not too obliquely."""
    chosen = torch.empty(0, arm.dof, dtype=torch.float64)
    while len(chosen) < count:
        q = torch.from_numpy(rng.uniform(arm.limits[:, 0], arm.limits[:, 1], (OTHERS, arm.dof)))
        T = forward_kinematics(arm, q)
        inside = torch.from_numpy(project_corners(PHONE, board, T)[1].all(1))
        middle = T[:, :3, 3] + T[:, :3, :3] @ torch.tensor(board.corners.mean(0))
        facing = (T[:, :3, 2] * middle).sum(1) / middle.norm(dim=1)
        chosen = torch.cat([chosen, q[inside & (facing > np.cos(OBLIQUE)) & (middle[:, 2] > NEAREST)]])
    return chosen[:count]


def rendered(arm: Arm, board: Board, folder: Path) -> CameraFiles:
    """Render the images, calibrate the phone with them, and write corners.csv with our detection."""
    lines = [["image", *(f"q{joint + 1}_deg" for joint in range(arm.q.shape[1]))]]
    poses = forward_kinematics(arm.true, arm.reached(arm.q)).numpy()
    (folder / "images").mkdir()
    for number, (T, q) in enumerate(zip(poses, arm.q, strict=True)):
        motion = MOTION * arm.rng.choice([-1, 1], 6)
        image = render_image(PHONE, TrueBoard(board), T, LIGHT, arm.rng, motion)
        Image.fromarray(image).save(folder / "images" / f"{number}.png", compress_level=1)
        lines.append([str(number), *(f"{value:.6f}" for value in torch.rad2deg(q).tolist())])
    write(folder / "joints.csv", lines)
    images, stated, phone = [folder / "images"], folder / "board.yaml", folder / "phone.yaml"
    calibrate_camera(images, stated, IntrinsicsSettings(name="phone")).save(phone)
    detect(images, stated, phone, folder / "joints.csv").save(folder / "corners.csv")
    return CameraFiles((str(phone),), (str(stated),), is_fixed=True, intrinsics="free")


def opencv(arm: Arm, board: Board, folder: Path) -> CameraFiles:
    """Draw the images, find corners and calibrate the phone with OpenCV, and write corners.csv."""
    size = (board.columns + 1, board.rows + 1)
    printed = cv2.aruco.CharucoBoard(size, board.square, board.marker, dictionary_of(board))
    detector, found = cv2.aruco.CharucoDetector(printed), list[tuple[np.ndarray, np.ndarray]]()
    for T in forward_kinematics(arm.true, arm.reached(arm.q)).numpy():
        corners, numbers, _, _ = detector.detectBoard(drawn(printed, board, T, arm.rng))
        if numbers is None or len(numbers) < MIN_CORNERS:
            numbers, corners = np.zeros(0, dtype=np.int64), np.zeros((0, 2))
        found.append((np.asarray(numbers).ravel(), np.asarray(corners).reshape(-1, 2)))
    points = [board.corners[numbers].astype(np.float32) for numbers, _ in found if len(numbers)]
    pixels = [at.astype(np.float32) for _, at in found if len(at)]
    none = np.zeros((3, 3)), np.zeros(5)
    _, K, lens, _, _ = cv2.calibrateCamera(points, pixels, (PHONE.width, PHONE.height), *none)
    values = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *lens.ravel()[:5]])
    phone, stated = folder / "phone.yaml", folder / "board.yaml"
    phone.write_text(PHONE.with_intrinsics(values).to_yaml())
    lines = [["image", "corner", "u_px", "v_px", *(f"q{joint + 1}_deg" for joint in range(arm.q.shape[1]))]]
    for image, (numbers, at) in enumerate(found):
        q = [f"{value:.6f}" for value in torch.rad2deg(arm.q[image]).tolist()]
        lines += [
            [str(image), str(n), f"{u:.4f}", f"{v:.4f}", *q] for n, (u, v) in zip(numbers, at, strict=True)
        ]
    write(folder / "corners.csv", lines)
    return CameraFiles((str(phone),), (str(stated),), is_fixed=True, intrinsics="free")


def drawn(
    printed: cv2.aruco.CharucoBoard, board: Board, T: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return an image of a board as OpenCV draws and distorts it."""
    K = np.array([[PHONE.fx, 0, PHONE.cx], [0, PHONE.fy, PHONE.cy], [0, 0, 1]])
    lens = np.array([PHONE.k1, PHONE.k2, PHONE.p1, PHONE.p2])
    sides = np.array([board.columns + 1, board.rows + 1]) * board.square
    sheet = printed.generateImage(tuple(int(n) for n in sides / DOT + 2 * MARGIN), marginSize=MARGIN)
    corners = cv2.projectPoints(board.corners, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], K, lens)[0]
    edge = 3 * np.ptp(corners[:, 0], axis=0).max() / board.columns
    left, top = np.floor(corners[:, 0].min(0) - edge).astype(int)
    width, height = np.ceil(corners[:, 0].max(0) + edge).astype(int) - (left, top)
    u, v = ((np.arange(n * FINER) + 0.5) / FINER - 0.5 for n in (width, height))
    pixels = np.stack(np.meshgrid(left + u, top + v), -1).reshape(-1, 1, 2)
    rays = np.concatenate([cv2.undistortPoints(pixels, K, lens)[:, 0], np.ones((len(pixels), 1))], 1)
    rays *= (T[:3, 2] @ T[:3, 3]) / (rays @ T[:3, 2])[:, None]
    on_board = (rays - T[:3, 3]) @ T[:3, :2]
    at = ((on_board + board.square) / DOT + MARGIN - 0.5).astype(np.float32).reshape(height * FINER, -1, 2)
    fine = cv2.remap(
        sheet, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=110
    )
    patch = cv2.resize(fine.astype(np.float32), (int(width), int(height)), interpolation=cv2.INTER_AREA)
    image = np.full((PHONE.height + 2 * height, PHONE.width + 2 * width), 110, dtype=np.float32)
    image[top + height : top + 2 * height, left + width : left + 2 * width] = patch
    image = image[height:-height, width:-width]
    image = cv2.GaussianBlur(image, (0, 0), LIGHT.blur_in_focus) * np.linspace(
        0.5, 1.0, PHONE.width, dtype=np.float32
    )
    noisy: np.ndarray = image + LIGHT.noise * rng.standard_normal(image.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def write(path: Path, lines: list[list[str]]) -> None:
    """Write a CSV file."""
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(lines)


def rms(errors: np.ndarray) -> float:
    """Return the root mean square of the lengths of errors [m], in mm."""
    return float(1e3 * np.sqrt(np.square(errors).sum(1).mean()))


def judge(arm: Arm, cameras: CameraFiles, corners: Path) -> dict[str, float]:
    """Calibrate, and return errors [mm], their ratio to the noise of the servos, zeros [deg], and predicted / true."""
    model = pisigma.calibrate(
        "so101", str(corners), pisigma.CalibrationSettings(folds=0, cameras=cameras)
    ).model
    count = len(arm.others)
    at = Measurements(q=arm.others, frame=("phone",) * count, target=("board",) * count)
    estimated, true = poses_of_rows(model, at)[:, :3, 3].numpy(), arm.positions(arm.others)
    nominal = forward_kinematics(arm.nominal, arm.others)[:, :3, 3].numpy()
    really = arm.positions(arm.reached(arm.others))
    error = rms(estimated - true)
    return {
        "before": rms(nominal - true),
        "aligned": rms_after_fit(nominal, true),
        "servos": rms(really - true),
        "after": rms(estimated - really),
        "model": error,
        "ratio": rms(estimated - really) / rms(really - true),
        "zeros": float(np.rad2deg(np.abs(model.identified.dh - arm.true.dh))[IDENTIFIABLE, 0].max()),
        "predicted": rms(sigma_of_rows(model, at).numpy()) / error,
    }


def results(seeds: range, images: int, way: str) -> Iterator[dict[str, float]]:
    """Calibrate one arm per seed, and print its figures."""
    for seed in seeds:
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch)
            (folder / "board.yaml").write_text(yaml.safe_dump(BOARD))
            board = Board.load(folder / "board.yaml")
            arm = Arm.draw(seed, board, images)
            cameras = {"rendered": rendered, "opencv": opencv}[way](arm, board, folder)
            figures = judge(arm, cameras, folder / "corners.csv")
        print(
            f"{way}, seed {seed}: " + ", ".join(f"{name} {one:.2f}" for name, one in figures.items()),
            flush=True,
        )
        yield figures


def main(seeds: range, images: int, ways: list[str]) -> None:
    """Print the figures of every arm, and how many arms are within the limits."""
    for way in ways:
        every = list(results(seeds, images, way))
        for name, (low, high) in LIMITS.items():
            held = sum(low <= one[name] <= high for one in every)
            print(f"{way}: {name} from {low:g} to {high:g} in {held} of {len(every)} arms")
        pooled = {name: float(np.sqrt(np.mean([one[name] ** 2 for one in every]))) for name in every[0]}
        predicted = np.array([one["predicted"] * one["model"] for one in every])
        pooled["predicted"] = float(np.sqrt(np.square(predicted).mean())) / pooled["model"]
        print(f"{way}, RMS of all arms: " + ", ".join(f"{name} {one:.2f}" for name, one in pooled.items()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--images", type=int, default=40)
    parser.add_argument("--drawn", nargs="+", choices=["rendered", "opencv"], default=["rendered", "opencv"])
    arguments = parser.parse_args()
    main(range(arguments.first, arguments.first + arguments.seeds), arguments.images, arguments.drawn)
