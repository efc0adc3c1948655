"""Rail: a UR5 on a rail of 3 m, whose direction is identified together with the geometry of the arm."""

from pathlib import Path

import yaml
from matplotlib.figure import Figure

from pisigma import CalibrationSettings, Robot, calibrate
from pisigma.simulation import SimulatedTracker, TrueRobot
from pisigma.simulation.errors.geometric import GeometricDeviation, RandomGeometricDeviation

source = {"maker": "Universal Robots", "source": "Nominal values of the maker, on a rail."}
rail = {"name": "rail", "type": "prismatic", "limits_mm": [-1500, 1500], "alpha_deg": 90}
turn = {"name": "theta_1", "type": "revolute", "limits_deg": [-180, 180], "theta_deg": 0, "alpha_deg": 90}
links = [(0, -425, 0), (0, -392.25, 0), (109.15, 0, 90), (94.65, 0, -90), (82.3, 0, 0)]
arm = [
    {
        "name": f"theta_{number}",
        "type": "revolute",
        "limits_deg": [-180, 180],
        "d_mm": d,
        "a_mm": a,
        "alpha_deg": alpha,
    }
    for number, (d, a, alpha) in enumerate(links, 2)
]
text = yaml.safe_dump({"name": "ur5_on_rail", **source, "rows": [rail, {**turn, "d_mm": 89.159}, *arm]})
Path("ur5_on_rail.yaml").write_text(text, encoding="utf-8")
robot = Robot.load("ur5_on_rail.yaml")
errors = RandomGeometricDeviation(
    kind="geometric_random", distribution="normal", seed=1, length_mm=0.3, angle_deg=0.03
)
tilted = GeometricDeviation(kind="geometric", rows={"rail": {"alpha_deg": 0.2}})
true = TrueRobot(robot, [errors, tilted])


def measure(count, seed):
    """Return simulated rows of a tracker with a noise of 0.05 mm."""
    section = {
        "poses": {"kind": "joints_random", "count": count, "seed": seed, "range_fraction": 0.8},
        "sensor": "position",
        "noise": {"position_mm": 0.05, "seed": seed},
    }
    return SimulatedTracker.model_validate(section).measure(true)


calibration = calibrate(robot, measure(80, 1), CalibrationSettings(model="geometric", folds=0))
new = measure(300, 2)
figure = Figure(figsize=(4, 3), layout="constrained")
axes = figure.subplots()
for name, forward in (("nominal", TrueRobot(robot, []).forward), ("calibrated", calibration.model.forward)):
    errors_mm = 1e3 * (forward(new.q)[:, :3, 3] - new.position).norm(dim=1)
    print(f"{name}: {errors_mm.square().mean().sqrt():.3f} mm RMS")
    axes.semilogy(1e3 * new.q[:, 0], errors_mm, ".", markersize=3, label=name)
axes.set(xlabel="position on the rail [mm]", ylabel="position error [mm]", title="Rail")
axes.legend()
figure.savefig("rail.png", dpi=100)
