"""SCARA: the errors of a SCARA robot over its workspace, before and after a calibration with 40 poses."""

from matplotlib.figure import Figure

from pisigma import CalibrationSettings, Robot, calibrate
from pisigma.simulation import SimulatedTracker, TrueRobot
from pisigma.simulation.errors.geometric import RandomGeometricDeviation

robot = Robot.load("kiro3")
errors = RandomGeometricDeviation(
    kind="geometric_random", distribution="normal", seed=3, length_mm=0.3, angle_deg=0.05
)
true = TrueRobot(robot, [errors])


def measure(count, seed):
    """Return simulated poses of a tracker with a noise of 0.02 mm and 0.005 deg."""
    section = {
        "poses": {"kind": "joints_random", "count": count, "seed": seed, "range_fraction": 0.9},
        "noise": {"position_mm": 0.02, "orientation_deg": 0.005, "seed": seed},
    }
    return SimulatedTracker.model_validate(section).measure(true)


calibration = calibrate(robot, measure(40, 1), CalibrationSettings(model="geometric", folds=0))
new = measure(600, 2)

figure = Figure(figsize=(4, 3), layout="constrained")
x_mm, y_mm, _ = 1e3 * new.position.T
for axes, name, forward in zip(
    figure.subplots(1, 2, sharey=True),
    ("nominal", "calibrated"),
    (TrueRobot(robot, []).forward, calibration.model.forward),
    strict=True,
):
    errors_mm = 1e3 * (forward(new.q)[:, :3, 3] - new.position).norm(dim=1)
    print(f"{name}: {errors_mm.square().mean().sqrt():.3f} mm RMS")
    dots = axes.scatter(x_mm, y_mm, c=errors_mm, s=3, vmin=0, vmax=1.5)
    axes.set(title=name, xlabel="x [mm]", aspect="equal")
figure.colorbar(dots, ax=figure.axes, label="error [mm]", shrink=0.6)
figure.savefig("scara.png", dpi=100)
