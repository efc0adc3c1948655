"""True and predicted errors of calibrations from planned images of a board, compared with random views.

    OMP_NUM_THREADS=1 python benchmarks/plan_camera.py [--draws 5] [--candidates 3000] [--images 25 50]

A UR5 with errors of 1 mm and 0.3 deg in every parameter carries a camera (1920 x 1200 px, f = 1400 px, 0.3 px per
corner, intrinsics known) that views a board of 9 x 6 corners 30 mm apart, sharp from 0.3 to 0.7 m, up to 45 deg
oblique; the repeatability of the arm is 0.02 mm and 0.01 deg. Errors are those of the camera centre's position over 400
postures of the whole joint space, after the best rigid alignment. Random views are drawn from the same candidates as
the planned ones, which are chosen by either criterion, for the geometry alone or for the hybrid, as by `pisigma plan`.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import get_args

import numpy as np
import torch
import yaml
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.parameters import Prior
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.image_rows import image_measurements
from pisigma.planning.expected_accuracy import rms_of
from pisigma.planning.plan_inputs import find_candidates, instrument_of, views_of
from pisigma.planning.plan_settings import CameraSettings, Criterion, PlanSettings
from pisigma.planning.pose_selection import select_poses
from pisigma.planning.robot_posterior import RobotPosterior
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.planning.surroundings.surroundings import Surroundings
from pisigma.planning.task import TASK_POSES
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import invert, skew, xyz_zyx_from_transform
from pisigma.simulation.camera.simulated_images import ImageNoise, simulate_images

LENGTH, ANGLE, POSTURES = 1e-3, np.deg2rad(0.3), 400
PRIOR = Prior(theta=ANGLE, d=LENGTH, a=LENGTH, alpha=ANGLE, beta=ANGLE)
CELL = Surroundings.model_validate(
    {
        "tool": {"x_mm": 30, "y_mm": 20, "z_mm": 60, "roll_deg": 5.7, "pitch_deg": 1.1, "yaw_deg": -1.7},
        "view": {
            "frame": {"x_mm": 420, "y_mm": -120, "z_mm": 50, "yaw_deg": 180},
            "near_mm": 300,
            "far_mm": 700,
        },
    }
)
CAMERA = {"name": "wrist", "width": 1920, "height": 1200, "fx": 1400, "fy": 1400, "cx": 960, "cy": 600}
BOARD = {"name": "board", "rows": 6, "columns": 9, "square_mm": 30}


@dataclass(frozen=True, eq=False)
class Bench:
    """The arm, the candidates, and the prior."""

    arm: ArmInSurroundings
    settings: PlanSettings
    q: Tensor
    task: Tensor
    posterior: dict[str, RobotPosterior]
    camera: Camera
    board: Board

    @staticmethod
    def with_candidates(candidates: int) -> "Bench":
        """Draw the candidates."""
        with TemporaryDirectory() as folder:
            camera_file, board_file = Path(folder, "camera.yaml"), Path(folder, "board.yaml")
            for file, content in ((camera_file, CAMERA), (board_file, BOARD)):
                file.write_text(yaml.safe_dump(content))
            settings = PlanSettings(
                sensor="camera",
                camera=CameraSettings(str(camera_file), str(board_file)),
                candidates=candidates,
            )
            arm, instrument = ArmInSurroundings.from_robot(Robot.load("ur5"), CELL), instrument_of(settings)
            drawn, views = find_candidates(settings, arm), views_of(settings, arm)
        assert views is not None
        base = xyz_zyx_from_transform(invert(views.T_cell_frame)).numpy()
        robot = arm.robot.with_geometry(base=base)
        posterior = {
            name: RobotPosterior.from_robot(robot, instrument, hybrid=name == "hybrid")
            for name in ("geometric", "hybrid")
        }
        camera, board = views.sight.camera, views.sight.board
        return Bench(arm, settings, drawn.q, drawn.workspace_q[:TASK_POSES], posterior, camera, board)

    def figures(self, draw: int, q: Tensor, judged: Tensor) -> tuple[float, float]:
        """Return true and predicted error [mm] of a calibration of one true arm with images at joint values."""
        nominal, rng = self.posterior["geometric"].uncertainty.geometry.robot, np.random.default_rng(draw)
        errors = rng.standard_normal(nominal.dh.shape) * [ANGLE, LENGTH, LENGTH, ANGLE, ANGLE]
        true, noise = nominal.with_geometry(nominal.dh + errors), ImageNoise()
        images = simulate_images(true, q, self.camera, self.board, noise, torch.Generator().manual_seed(draw))
        rows = image_measurements(images, self.camera, self.board, False, noise.repeatability, "fixed")
        robot = GeometricCalibrator(self.arm.robot, prior=PRIOR).fit(rows).robot
        points, estimated = (forward_kinematics(one, judged)[:, :3, 3] for one in (true, robot))
        predicted = rms_of(self.posterior["geometric"].after_measuring(q).tool_derivatives(judged))
        return 1e3 * aligned_error(points, estimated), 1e3 * predicted


def aligned_error(true: Tensor, estimated: Tensor) -> float:
    """Return the RMS distance [m] of points after the best rigid alignment, for errors small compared with the arm."""
    shifts = torch.eye(3, dtype=torch.float64).expand(len(true), 3, 3)
    basis = torch.linalg.qr(torch.cat([shifts, skew(true - true.mean(0))], -1).flatten(0, 1)).Q
    off = (true - estimated).flatten()
    off = off - basis @ (basis.T @ off)
    return float((off.square().sum() / len(true)).sqrt())


def main(draws: int, candidates: int, counts: list[int]) -> None:
    """Print root mean squares over all draws."""
    bench = Bench.with_candidates(candidates)
    judged = torch.from_numpy(np.random.default_rng(0).uniform(-np.pi, np.pi, (POSTURES, 6)))
    for count in counts:
        ways = {
            "random": [
                torch.randperm(candidates, generator=torch.Generator().manual_seed(draw))[:count]
                for draw in range(draws)
            ]
        }
        for name, posterior in bench.posterior.items():
            for criterion in get_args(Criterion):
                chosen = select_poses(
                    posterior.sensitivities(bench.q), posterior.tool_derivatives(bench.task), count, criterion
                )
                ways[f"{criterion}, {name}"] = [chosen] * draws
        pooled = {}
        for way, choices in ways.items():
            pairs = [bench.figures(draw, bench.q[chosen], judged) for draw, chosen in enumerate(choices)]
            pooled[way], predicted = np.sqrt(np.mean(np.square(pairs), 0)).tolist()
            print(
                f"{count} images, {way}: {pooled[way]:.4f} mm ({pooled[way] / pooled['random']:.2f} of random), "
                f"predicted {predicted:.4f} mm ({predicted / pooled[way]:.2f} of true)",
                flush=True,
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--candidates", type=int, default=3000)
    parser.add_argument("--images", type=int, nargs="+", default=[25, 50])
    arguments = parser.parse_args()
    main(arguments.draws, arguments.candidates, arguments.images)
