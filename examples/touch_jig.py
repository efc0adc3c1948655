"""Touch jig: a welding robot touches planes of two stepped jigs, whose placements are estimated too."""

from matplotlib.figure import Figure

from pisigma import CalibrationSettings, Robot, calibrate
from pisigma.simulation import JigPlacement, SimulatedTouches, TrueRobot
from pisigma.simulation.errors.geometric import GeometricDeviation

robot = Robot.load("welding")
rows = {
    "theta_1": {"a_mm": -4.72},
    "theta_2": {"a_mm": -1.73, "theta_deg": -0.24},
    "theta_3": {"a_mm": 1.05, "theta_deg": 0.48},
    "theta_4": {"d_mm": 2.8, "theta_deg": 0.21},
    "theta_5": {"theta_deg": -0.13},
}
errors = GeometricDeviation(kind="geometric", rows=rows, tool={"x_mm": 1.41, "y_mm": -0.14})
believed = ({"x_mm": 445, "y_mm": 1000, "roll_deg": -90}, {"x_mm": 1000, "y_mm": 445, "roll_deg": 180})
really = (
    {"x_mm": 439.4, "y_mm": 982.2, "z_mm": -0.5, "roll_deg": -89},
    {"x_mm": 981.1, "y_mm": 446.4, "z_mm": -1.5, "roll_deg": 180, "pitch_deg": -0.1, "yaw_deg": 0.04},
)
section = SimulatedTouches(
    kind="touches",
    placements=tuple(
        JigPlacement(name=f"jig_{number}", base=base, true_base=true_base)
        for number, (base, true_base) in enumerate(zip(believed, really, strict=True), 1)
    ),
    candidates={"count": 96, "seed": 100},
    noise={"sensor_mm": 0.2, "repeatability_mm": 0.05, "seed": 1000},
)
touches = section.measure(TrueRobot(robot, [errors]))
calibration = calibrate(robot, touches, CalibrationSettings(model="geometric", repeats=1))

figure = Figure(figsize=(4, 3), layout="constrained")
axes = figure.subplots()
found = calibration.validation.all_errors
names = list(found)
rms = [float(1e3 * found[name].position.square().mean().sqrt()) for name in names]
axes.bar_label(axes.bar(names, rms, color=["#b35806", "#1f5fa8"]), fmt="%.2f")
print({name: round(value, 3) for name, value in zip(names, rms, strict=True)})
axes.set(ylabel="RMS error of held-out touches [mm]", title="Touch jig")
figure.savefig("touch_jig.png", dpi=100)
