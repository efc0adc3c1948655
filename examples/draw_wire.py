"""Draw wire: lengths to three unknown anchors identify the geometry of a UR5."""

from matplotlib.figure import Figure

from pisigma import CalibrationSettings, Robot, calibrate
from pisigma.measurement import join
from pisigma.simulation import SimulatedDistances, TrueRobot
from pisigma.simulation.errors.geometric import RandomGeometricDeviation

robot = Robot.load("ur5")
errors = RandomGeometricDeviation(
    kind="geometric_random", distribution="normal", seed=1, length_mm=0.5, angle_deg=0.03
)
true = TrueRobot(robot, [errors])
anchors = {"wall": (1200, 300, 800), "floor": (-300, 900, 0), "column": (200, -1100, 600)}
parts = []
for seed, (name, point) in enumerate(anchors.items()):
    section = SimulatedDistances.model_validate(
        {
            "kind": "distances",
            "poses": {"kind": "joints_random", "count": 60, "seed": seed, "range_fraction": 0.4},
            "anchor": {"name": name, "point_mm": point, "zero_mm": 12},
            "noise": {"sensor_mm": 0.05, "seed": seed},
        }
    )
    parts.append(section.measure(true))
calibration = calibrate(robot, join(parts), CalibrationSettings(model="geometric", repeats=1))

figure = Figure(figsize=(4, 3), layout="constrained")
axes = figure.subplots()
for name, found in calibration.validation.all_errors.items():
    errors_mm = 1e3 * found.position
    print(f"{name}: {errors_mm.square().mean().sqrt():.3f} mm RMS of the length of the wire")
    axes.ecdf(errors_mm, label=name)
axes.set(xscale="log", xlabel="error of held-out lengths [mm]", ylabel="share of rows", title="Draw wire")
axes.legend()
figure.savefig("draw_wire.png", dpi=100)
