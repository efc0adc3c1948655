"""Fleet: a prior from five robots of one type, with which eight rows suffice to calibrate a sixth robot."""

import shutil

from matplotlib.figure import Figure

from pisigma import Cell, Robot, estimate_fleet_prior, recalibrate
from pisigma.simulation import SimulatedTracker, TrueRobot
from pisigma.simulation.errors.geometric import RandomGeometricDeviation

robot = Robot.load("rb5")


def errors(size, seed):
    """Return random errors of the geometry."""
    return RandomGeometricDeviation(
        kind="geometric_random", distribution="normal", seed=seed, length_mm=size, angle_deg=0.06 * size
    )


def measure(number, count, seed):
    """Return simulated rows of a robot with the errors of its type, and individual errors a fifth as large."""
    section = {
        "poses": {"kind": "joints_random", "count": count, "seed": seed, "range_fraction": 0.4},
        "sensor": "position",
        "noise": {"position_mm": 0.03, "seed": seed},
    }
    true = TrueRobot(robot, [errors(1.0, 0), errors(0.2, number)])
    return SimulatedTracker.model_validate(section).measure(true)


shutil.rmtree("cells", ignore_errors=True)
for number in range(1, 6):
    Cell.create(f"cells/rb5_{number}", "rb5").add_session(measure(number, 50, number))
prior = estimate_fleet_prior("cells")
few, new = measure(6, 8, 20), measure(6, 300, 21)
models = {
    "nominal": TrueRobot(robot, []),
    "type": prior.model,
    "type and eight rows": recalibrate(prior, few).model,
}

figure = Figure(figsize=(4, 3), layout="constrained")
axes = figure.subplots()
for name, model in models.items():
    errors_mm = 1e3 * (model.forward(new.q)[:, :3, 3] - new.position).norm(dim=1)
    print(f"{name}: {errors_mm.square().mean().sqrt():.3f} mm RMS")
    axes.ecdf(errors_mm, label=name)
axes.set(xscale="log", xlabel="position error of new poses [mm]", ylabel="share of poses", title="Fleet")
axes.legend()
figure.savefig("fleet.png", dpi=100)
