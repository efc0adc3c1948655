"""Seven axes: a calibrated Panda reaches one pose with every elbow angle, and the nominal Panda misses it."""

import numpy as np
import torch
from matplotlib.figure import Figure

from pisigma import CalibrationSettings, CorrectedIK, Robot, calibrate
from pisigma.simulation import SimulatedTracker, TrueRobot
from pisigma.simulation.errors.geometric import RandomGeometricDeviation

robot = Robot.load("panda")
errors = RandomGeometricDeviation(
    kind="geometric_random", distribution="normal", seed=1, length_mm=0.3, angle_deg=0.05
)
true = TrueRobot(robot, [errors])
section = {
    "poses": {"kind": "joints_random", "count": 80, "seed": 1, "range_fraction": 0.7},
    "noise": {"position_mm": 0.03, "orientation_deg": 0.005, "seed": 1},
}
rows = SimulatedTracker.model_validate(section).measure(true)
model = calibrate(robot, rows, CalibrationSettings(model="geometric", folds=0)).model

home = torch.tensor([0.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8], dtype=torch.float64)
T = model.forward(home).detach().numpy()
figure = Figure(figsize=(4, 3), layout="constrained")
axes = figure.subplots()
angles = np.radians(np.arange(-60, 61, 4))
solutions = [CorrectedIK(model)(T, near=home.numpy(), elbow_angle=angle, throw=False) for angle in angles]
for name, values in (
    ("nominal", np.array([one.q_nominal for one in solutions])),
    ("corrected", np.array([one.q for one in solutions])),
):
    reached = true.forward(torch.from_numpy(values))[:, :3, 3].numpy()
    errors_mm = 1e3 * np.linalg.norm(reached - T[:3, 3], axis=1)
    print(f"{name}: at most {np.nanmax(errors_mm):.3f} mm from the pose")
    axes.semilogy(np.degrees(angles), errors_mm, ".-", label=name)
axes.set(xlabel="elbow angle [deg]", ylabel="distance from the pose [mm]", title="Seven axes")
axes.legend()
figure.savefig("seven_axes.png", dpi=100)
