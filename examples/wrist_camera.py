"""Camera on the wrist: 40 images of a board identify the geometry of a UR5 and the camera's pose on its flange."""

from pathlib import Path

import yaml
from matplotlib.figure import Figure

from pisigma import CalibrationSettings, Robot, calibrate
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.simulation import TrueRobot
from pisigma.simulation.camera.simulated_images import SimulatedImages
from pisigma.simulation.errors.geometric import GeometricDeviation, RandomGeometricDeviation
from pisigma.simulation.poses import JointsRandom

robot = Robot.load("ur5")
camera = {"name": "camera", "width": 1920, "height": 1200, "fx": 1400, "fy": 1400, "cx": 960, "cy": 600}
board = {"rows": 6, "columns": 9, "square_mm": 30}
errors = RandomGeometricDeviation(
    kind="geometric_random", distribution="normal", seed=0, length_mm=0.5, angle_deg=0.05
)
places = GeometricDeviation(
    kind="geometric",
    base={"x_mm": -420, "y_mm": 80, "z_mm": 50, "yaw_deg": 180},
    tool={"x_mm": 30, "y_mm": 20, "z_mm": 60, "roll_deg": 6},
)
section = SimulatedImages.model_validate(
    {
        "kind": "images",
        "poses": {"count": 40, "seed": 1},
        "camera": {**camera},
        "board": board,
        "noise": {"corner_px": 0.2, "seed": 2},
    }
)
true = TrueRobot(robot, [errors, places])
rows = section.measure(true)
for name, content in (("camera", camera), ("board", board)):
    Path(f"{name}.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
files = CameraFiles(("camera.yaml",), ("board.yaml",), intrinsics="fixed")
settings = CalibrationSettings(model="geometric", folds=0, cameras=files)
model = calibrate(robot, rows, settings).model
q = JointsRandom(kind="joints_random", count=300, seed=3).joints(robot)
position = true.forward(q)[:, :3, 3]

figure = Figure(figsize=(4, 3), layout="constrained")
axes = figure.subplots()
for name, forward in (("nominal arm", TrueRobot(robot, [places]).forward), ("calibrated", model.forward)):
    errors_mm = 1e3 * (forward(q)[:, :3, 3] - position).norm(dim=1)
    print(f"{name}: {errors_mm.square().mean().sqrt():.3f} mm RMS")
    axes.ecdf(errors_mm, label=name)
axes.set(
    xscale="log", xlabel="position error at any posture [mm]", ylabel="share", title="Camera on the wrist"
)
axes.legend()
figure.savefig("wrist_camera.png", dpi=100)
