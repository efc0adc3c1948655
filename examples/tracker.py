"""Laser tracker: 60 positions of a UR10 identify its geometry, and 300 new positions check it."""

from matplotlib.figure import Figure

from pisigma import CalibrationSettings, Robot, calibrate
from pisigma.simulation import SimulatedTracker, TrueRobot
from pisigma.simulation.errors.geometric import RandomGeometricDeviation

robot = Robot.load("ur10")
errors = RandomGeometricDeviation(
    kind="geometric_random", distribution="normal", seed=1, length_mm=0.5, angle_deg=0.03
)
true = TrueRobot(robot, [errors])


def measure(count, seed):
    """Return simulated rows of a tracker with a noise of 0.05 mm."""
    section = {
        "poses": {"kind": "joints_random", "count": count, "seed": seed, "range_fraction": 0.4},
        "sensor": "position",
        "noise": {"position_mm": 0.05, "seed": seed},
    }
    return SimulatedTracker.model_validate(section).measure(true)


calibration = calibrate(robot, measure(60, 1), CalibrationSettings(model="geometric", folds=0))
new = measure(300, 2)

figure = Figure(figsize=(4, 3), layout="constrained")
axes = figure.subplots()
for name, forward in (("nominal", TrueRobot(robot, []).forward), ("calibrated", calibration.model.forward)):
    errors_mm = 1e3 * (forward(new.q)[:, :3, 3] - new.position).norm(dim=1)
    print(f"{name}: {errors_mm.square().mean().sqrt():.3f} mm RMS")
    axes.ecdf(errors_mm, label=name)
axes.set(
    xscale="log", xlabel="position error of new poses [mm]", ylabel="share of poses", title="Laser tracker"
)
axes.legend()
figure.savefig("tracker.png", dpi=100)
