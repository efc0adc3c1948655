"""Collision: ten positions show which joint of an RB5 a collision has turned, and recalibrate its model."""

from matplotlib.figure import Figure

from pisigma import CalibrationSettings, Robot, calibrate, recalibrate
from pisigma.simulation import SimulatedTracker, TrueRobot
from pisigma.simulation.errors.geometric import RandomGeometricDeviation
from pisigma.simulation.errors.joint_offset import JointOffset

robot = Robot.load("rb5")
errors = RandomGeometricDeviation(
    kind="geometric_random", distribution="normal", seed=1, length_mm=0.5, angle_deg=0.03
)
before = TrueRobot(robot, [errors])
after = TrueRobot(robot, [errors, JointOffset(kind="joint_offset", offset_deg={"theta_3": 0.15})])


def measure(true, count, seed):
    """Return simulated rows of a tracker with a noise of 0.03 mm."""
    section = {
        "poses": {"kind": "joints_random", "count": count, "seed": seed, "range_fraction": 0.4},
        "sensor": "position",
        "noise": {"position_mm": 0.03, "seed": seed},
    }
    return SimulatedTracker.model_validate(section).measure(true)


model = calibrate(robot, measure(before, 80, 1), CalibrationSettings(folds=0)).model
renewed = recalibrate(model, measure(after, 10, 2))
print(renewed.summary.change_sentence)
new = measure(after, 300, 3)

figure = Figure(figsize=(4, 3), layout="constrained")
axes = figure.subplots()
for name, one in (("old model", model), ("recalibrated with ten rows", renewed.model)):
    errors_mm = 1e3 * (one.forward(new.q)[:, :3, 3] - new.position).norm(dim=1)
    print(f"{name}: {errors_mm.square().mean().sqrt():.3f} mm RMS")
    axes.ecdf(errors_mm, label=name)
axes.set(
    xscale="log", xlabel="position error after the collision [mm]", ylabel="share of poses", title="Collision"
)
axes.legend()
figure.savefig("collision.png", dpi=100)
