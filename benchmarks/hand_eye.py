"""Tool, base and hand-eye as small jobs: accuracy against the Cramér-Rao bound and OpenCV, and named causes.

    OMP_NUM_THREADS=1 python benchmarks/hand_eye.py [hand-eye] [causes] [frames] [--seeds 20] [--images 50]

Tool and base: a UR5 as drawn touches one unknown point 6 times, or 8 points at measured positions; the noise is
0.05 mm per coordinate. Errors are RMS over 200 data sets, relative to the bound that numpy computes. In a copy of every
data set, one row is wrong by 5 mm.

Hand-eye: true arms differ from the drawn UR5 by 0.3 mm and 0.05 deg in every parameter. OpenCV projects the corners of
a board of 9 x 6 corners 30 mm apart, seen from 0.3 to 0.7 m, into a camera of 1920 x 1200 px; the noise is 0.3 px and
the repeatability of the arm 0.02 mm and 0.01 deg. The intrinsics have the errors of a typical calibration, the same for
all. Errors are those of the camera's position in the frame of the board over 400 postures of the
whole joint space. The solvers of OpenCV are part of opencv-python-headless 4, not of 5:

    pip install --target cv4 "opencv-python-headless<5" && PYTHONPATH=cv4:$PYTHONPATH python benchmarks/hand_eye.py

Causes: the same with 14 images and exactly one wrong thing: the arm as above, intrinsics by 15 times the error of a
typical calibration, a board larger by 0.5 %, joint zeros off by 0.1 deg, joint readings with noise of 0.05 deg, or
nothing.
"""

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import torch
from camera import BOARD, CAMERA, IN_BASE, ON_FLANGE, views
from torch import Tensor

from pisigma.calibration.frames.frame_fit import FrameFit, fit_frames
from pisigma.calibration.frames.misfit_causes import misfit_causes
from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.measurement.camera.camera import USUAL_DEVIATIONS, Camera
from pisigma.measurement.camera.camera_files import Repeatability
from pisigma.measurement.camera.image_rows import Images, image_measurements
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.closed_form.registry import closed_form_solver
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.robot.se3 import (
    invert,
    rotation_from_vector,
    transform,
    transform_from_xyz_zyx,
    xyz_zyx_from_transform,
)
from pisigma.simulation.camera.simulated_images import select_far_apart

NOMINAL = Robot.load("ur5")
LENGTH, ANGLE = 3e-4, np.deg2rad(0.05)
NOISE, CORNER_NOISE, OFF = 5e-5, 0.3, 5e-3
TIP = np.array([0.05, -0.03, 0.2, 0.0, 0.0, 0.0])
BASE = np.array([1.0, 0.2, -0.3, 0.5, -0.2, 0.3])
DATA_SETS, POSTURES, FEW_IMAGES = 200, 400, 14
HAND_EYE = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")
ROBOT_WORLD = ("SHAH", "LI")
REPEATABILITY = Repeatability()
KINDS = ("arm", "camera", "board", "joint zeros", "joint noise", "nothing")


def touching_joints(count: int) -> Tensor:
    """Return joint values [rad] that hold the tip on a point with different orientations."""
    rng, solver, chosen = np.random.default_rng(0), closed_form_solver(NOMINAL), list[Tensor]()
    assert solver is not None
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    while len(chosen) < count:
        R = rotation_from_vector(torch.from_numpy(rng.uniform(-0.7, 0.7, 3))) @ down
        T = transform(R, torch.tensor([0.4, 0.1, 0.3], dtype=torch.float64))
        q = solver.solve(T @ invert(transform_from_xyz_zyx(torch.from_numpy(TIP)))).q
        reached = q[torch.isfinite(q).all(-1)]
        if len(reached):
            chosen.append(reached[0])
    return torch.stack(chosen)


def against_bound(
    what: str, fit: Callable[[np.ndarray], FrameFit], rows: int, true: np.ndarray, X: np.ndarray
) -> None:
    """Print RMS errors over the bound of `X`, over the stated standard errors, and how often a wrong row is named."""
    bound = (NOISE**2 * np.linalg.inv(X.T @ X)).diagonal()[: len(true)]
    errors, stated, named, wrongly = [], [], 0, 0
    for seed in range(DATA_SETS):
        rng = np.random.default_rng(seed)
        noise, direction = rng.normal(0, NOISE, (rows, 3)), rng.normal(size=3)
        found = fit(noise)
        wrongly += len(found.wrong_rows)
        errors.append(found.estimates - true)
        stated.append(found.covariance.diagonal())
        noise[seed % rows] += OFF * direction / np.linalg.norm(direction)
        named += fit(noise).wrong_rows == (seed % rows,)
    ratio = np.sqrt((np.square(errors).mean(0) / bound).mean())
    printed = np.sqrt((np.mean(stated, 0) / bound).mean())
    print(
        f"{what}: RMS error {ratio:.3f} x bound, stated standard error {printed:.3f} x bound; wrong row named in "
        f"{named} of {DATA_SETS}, a right row in {wrongly}"
    )


def small_jobs() -> None:
    """Print the accuracy of a tool by 6 touches and of a base by 8 points."""
    q, tipped = touching_joints(6), NOMINAL.with_geometry(tool=TIP)
    J = torch.linalg.pinv(joint_jacobian(tipped, q)[1][:, :3])

    def tool(missed: np.ndarray) -> FrameFit:
        moved = (J @ torch.from_numpy(missed)[..., None])[..., 0]
        return fit_frames(NOMINAL, Measurements(q=q + moved, socket=("point",) * len(q)), "tool")

    R = forward_kinematics(NOMINAL, q)[:, :3, :3].numpy()
    X = np.concatenate([R, np.tile(-np.eye(3), (len(q), 1, 1))], 2).reshape(-1, 6)
    against_bound("tool by 6 touches", tool, 6, TIP[:3], X)
    points = torch.from_numpy(np.random.default_rng(1).uniform(-2, 2, (8, 6)))

    def positions(base: np.ndarray) -> np.ndarray:
        return forward_kinematics(tipped.with_geometry(base=base), points)[:, :3, 3].numpy()

    def base(missed: np.ndarray) -> FrameFit:
        rows = Measurements(q=points, position=torch.from_numpy(positions(BASE) + missed))
        return fit_frames(tipped, rows, "base")

    steps = 1e-6 * np.eye(6)
    X = np.stack([(positions(BASE + s) - positions(BASE - s)).ravel() / 2e-6 for s in steps], 1)
    against_bound("base by 8 points", base, 8, BASE, X)


def true_arm(rng: np.random.Generator, is_wrong: bool) -> Robot:
    """Return an arm with base in the frame of the board and tool at the camera."""
    errors = rng.standard_normal(NOMINAL.dh.shape) * [ANGLE, LENGTH, LENGTH, ANGLE, ANGLE]
    base = xyz_zyx_from_transform(invert(transform_from_xyz_zyx(IN_BASE))).numpy()
    return NOMINAL.with_geometry(NOMINAL.dh + errors * is_wrong, base=base, tool=ON_FLANGE.numpy())


def projected_images(true: Robot, q: Tensor, rng: np.random.Generator, size: float = 1.0) -> Images:
    """Return the corners that OpenCV projects, with noise of the corners and of the arm; `size` scales the board."""
    turn = rotation_from_vector(torch.from_numpy(rng.normal(0, REPEATABILITY.angle, (len(q), 3))))
    shift = torch.from_numpy(rng.normal(0, REPEATABILITY.length, (len(q), 3)))
    T = invert(forward_kinematics(true, q) @ transform(turn, shift)).numpy()
    matrix, distortion = matrix_and_distortion(CAMERA)
    pixels = []
    for one in T:
        seen = cv2.projectPoints(
            BOARD.corners * size, cv2.Rodrigues(one[:3, :3])[0], one[:3, 3], matrix, distortion
        )
        pixels.append(seen[0].reshape(-1, 2) + rng.normal(0, CORNER_NOISE, (len(BOARD.corners), 2)))
    count = len(q)
    names = tuple(f"{number:04d}" for number in range(count))
    every = tuple(np.arange(len(BOARD.corners)) for _ in range(count))
    return Images("projected", names, q, tuple(range(count)), every, tuple(pixels))


def stated_camera(rng: np.random.Generator, factor: float = 1.0) -> Camera:
    """Return intrinsics with the errors of a typical calibration, times a factor."""
    off = factor * rng.standard_normal(len(USUAL_DEVIATIONS)) * USUAL_DEVIATIONS
    return CAMERA.with_intrinsics(CAMERA.intrinsics + off)


def matrix_and_distortion(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the intrinsics of a camera as OpenCV takes them."""
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    return matrix, np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])


def opencv_poses(images: Images, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations and translations of the board in the camera by OpenCV's solvePnP."""
    matrix, distortion = matrix_and_distortion(camera)
    R, t = [], []
    for pixels in images.pixels:
        _, turn, shift = cv2.solvePnP(BOARD.corners, pixels, matrix, distortion)
        turn, shift = cv2.solvePnPRefineLM(BOARD.corners, pixels, matrix, distortion, turn, shift)
        R.append(cv2.Rodrigues(turn)[0])
        t.append(shift[:, 0])
    return np.array(R), np.array(t)


def opencv_robots(images: Images, camera: Camera) -> dict[str, Robot]:
    """Return the drawn arm with base and tool by every solver of OpenCV."""
    R, t = opencv_poses(images, camera)
    flange = forward_kinematics(NOMINAL, images.q).numpy()
    found = {}
    for name in HAND_EYE:
        method = getattr(cv2, f"CALIB_HAND_EYE_{name}")
        solve = getattr(cv2, "calibrateHandEye")  # noqa: B009  # not in the stubs
        turn, shift = solve(flange[:, :3, :3], flange[:, :3, 3], R, t, method=method)
        tool = transform(torch.from_numpy(turn), torch.from_numpy(shift[:, 0]))
        found[name] = _with_mean_base(flange, R, t, tool)
    back = np.linalg.inv(flange)
    for name in ROBOT_WORLD:
        method = getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name}")
        solve = getattr(cv2, "calibrateRobotWorldHandEye")  # noqa: B009  # not in the stubs
        world = solve(R, t, back[:, :3, :3], back[:, :3, 3], method=method)
        to_base, to_flange = (
            transform(torch.from_numpy(world[k]), torch.from_numpy(world[k + 1][:, 0])) for k in (0, 2)
        )
        found[name] = NOMINAL.with_geometry(
            base=xyz_zyx_from_transform(to_base).numpy(),
            tool=xyz_zyx_from_transform(invert(to_flange)).numpy(),
        )
    return found


def _with_mean_base(flange: np.ndarray, R: np.ndarray, t: np.ndarray, tool: Tensor) -> Robot:
    """Return the drawn arm with a tool and the mean base in the frame of the board."""
    board = transform(torch.from_numpy(R), torch.from_numpy(t))
    each = invert(torch.from_numpy(flange) @ tool @ board)
    U, _, V = torch.linalg.svd(each[:, :3, :3].mean(0))
    base = transform(U @ V, each[:, :3, 3].mean(0))
    return NOMINAL.with_geometry(
        base=xyz_zyx_from_transform(base).numpy(), tool=xyz_zyx_from_transform(tool).numpy()
    )


def hand_eye(seeds: int, images: int) -> None:
    """Print errors over the joint space with the drawn arm, and with the arm calibrated at the same time."""
    q = select_far_apart(views(NOMINAL, 8 * images, np.random.default_rng(0)), images)
    everywhere = torch.from_numpy(np.random.default_rng(1).uniform(-np.pi, np.pi, (POSTURES, 6)))
    errors: dict[str, list[float]] = {}
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        true = true_arm(rng, True)
        seen = projected_images(true, q, rng)
        camera = stated_camera(rng)
        rows = image_measurements(seen, camera, BOARD, False, REPEATABILITY)
        robots = opencv_robots(seen, camera) if hasattr(cv2, "calibrateHandEye") else {}
        robots["pisigma, drawn arm"] = fit_frames(NOMINAL, rows, "hand-eye").solved.geometry.robot
        robots["pisigma, arm calibrated along"] = GeometricCalibrator(NOMINAL).fit(rows).robot
        for name, robot in robots.items():
            off = (
                forward_kinematics(robot, everywhere)[:, :3, 3]
                - forward_kinematics(true, everywhere)[:, :3, 3]
            )
            errors.setdefault(name, []).append(float(off.square().sum(-1).mean().sqrt()) * 1e3)
    print(f"camera in the board's frame over the joint space, {images} images, {seeds} arms [mm]")
    for name, values in sorted(errors.items(), key=lambda item: -np.median(item[1])):
        print(f"  {name}: median RMS {np.median(values):.3f}, worst {max(values):.3f}")
    *others, own = errors.values()
    ratio = np.min(others, axis=0) / np.array(own)
    print(
        f"  best solver with the drawn arm over this: median {np.median(ratio):.1f}, least {ratio.min():.1f}"
    )


def causes(seeds: int) -> None:
    """Print how often every cause is named first."""
    for kind in KINDS:
        named = Counter[str]()
        for seed in range(seeds):
            rng = np.random.default_rng(1000 + seed)
            q = views(NOMINAL, FEW_IMAGES, rng)
            true = true_arm(rng, kind == "arm")
            seen = projected_images(true, q, rng, 1.005 if kind == "board" else 1.0)
            moved = {
                "joint zeros": rng.normal(0, np.deg2rad(0.1), 6),
                "joint noise": rng.normal(0, np.deg2rad(0.05), q.shape),
            }
            seen = replace(seen, q=q + torch.from_numpy(moved.get(kind, np.zeros(6))))
            camera = stated_camera(rng, 15.0 if kind == "camera" else 1.0)
            rows = image_measurements(seen, camera, BOARD, False, REPEATABILITY)
            first = [
                one.name for one in misfit_causes(fit_frames(NOMINAL, rows, "hand-eye")) if one.is_supported
            ]
            named[first[0] if first else "nothing"] += 1
        print(
            f"{kind} wrong: named {', '.join(f'{name} {count}' for name, count in named.most_common())} of {seeds}"
        )


def main() -> None:
    """Run the comparisons, all or those that are named."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--images", type=int, default=50)
    parser.add_argument("parts", nargs="*", default=("hand-eye", "causes", "frames"))
    arguments = parser.parse_args()
    if "hand-eye" in arguments.parts:
        hand_eye(arguments.seeds, arguments.images)
    if "causes" in arguments.parts:
        causes(arguments.seeds)
    if "frames" in arguments.parts:
        small_jobs()


if __name__ == "__main__":
    main()
