"""Ball in sockets: a Panda touches pairs of sockets 50 mm apart, without any instrument."""

from matplotlib.figure import Figure

from pisigma import CalibrationSettings, Robot, calibrate
from pisigma.simulation import SimulatedSockets, TrueRobot
from pisigma.simulation.errors.geometric import RandomGeometricDeviation

robot = Robot.load("panda")
errors = RandomGeometricDeviation(
    kind="geometric_random", distribution="normal", seed=1, length_mm=0.5, angle_deg=0.03
)
plates = {"near": (400, -200, 50), "mid": (500, 0, 150), "far": (550, 200, 50), "high": (450, 100, 350)}
section = SimulatedSockets.model_validate(
    {
        "kind": "sockets",
        "sockets": [
            {"name": f"{plate}/{k}", "point_mm": (x + 50 * k, y, z)}
            for plate, (x, y, z) in plates.items()
            for k in (0, 1)
        ],
        "poses_per_socket": 15,
        "orientation": {"home_rpy_deg": (0, 0, 180), "spread_deg": 25},
        "seed": 1,
        "branch": {"near_deg": {"theta_4": -120, "theta_6": 120}},
        "noise": {"sensor_mm": 0.05, "seed": 2},
    }
)
rows = section.measure(TrueRobot(robot, [errors]))
settings = CalibrationSettings(
    model="geometric", split="placement", repeats=1, socket_distances={("*/0", "*/1"): 0.05}
)
calibration = calibrate(robot, rows, settings)

figure = Figure(figsize=(4, 3), layout="constrained")
axes = figure.subplots()
for name, found in calibration.validation.all_errors.items():
    errors_mm = 1e3 * found.position
    print(f"{name}: {errors_mm.square().mean().sqrt():.3f} mm RMS about the common point of a socket")
    axes.ecdf(errors_mm, label=name)
axes.set(
    xscale="log", xlabel="error of held-out placements [mm]", ylabel="share of rows", title="Ball in sockets"
)
axes.legend()
figure.savefig("sockets.png", dpi=100)
