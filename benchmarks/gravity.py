"""Test with inclined simulated arms how accurately the hybrid calibration determines the direction of gravity.

Run `OMP_NUM_THREADS=1 python benchmarks/gravity.py FOLDER_OF_SIM [--arm irb120] [--incline 45] [--poses 60]`.

FOLDER_OF_SIM contains the independent simulator `sim.py` and its URDF files. The pedestal of the arm is inclined
towards a random side, which the nominal robot does not include; positions have 0.03 mm noise, and the repeatability is
0.02 mm.
"""

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from simulated_arm import import_simulator

from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.gravity import gravity_in_base
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot

DOWN = np.array([0.0, 0.0, -1.0])


def inclined_arm(sim: Any, name: str, incline: float, side: float, seed: int) -> Any:
    """Return a simulated arm whose pedestal is inclined by an angle [rad] about a horizontal axis."""
    (joint, kind, origin, _, axis, limits), *others = sim.URDF[name]
    turned = Rotation.from_rotvec(incline * np.array([math.cos(side), math.sin(side), 0.0]))
    sim.URDF["inclined"] = [(joint, kind, origin, tuple(turned.as_euler("xyz")), axis, limits), *others]
    return sim.True_("inclined", seed=seed), turned


def main() -> None:
    """Print the angle between the true and the estimated direction for every seed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--arm", default="kr10", choices=("kr10", "irb120", "arm7"))
    parser.add_argument("--incline", type=float, default=45.0, help="Inclination of the pedestal [deg].")
    parser.add_argument("--poses", type=int, default=60)
    parser.add_argument("--seeds", type=int, default=20)
    stated = parser.parse_args()
    sim, robot = import_simulator(stated.folder), Robot.load(stated.folder / f"{stated.arm}.urdf")
    errors = []
    print(f"{stated.arm}, inclined by {stated.incline:g} deg, {stated.poses} positions")
    print(f"{'seed':>4}  {'true direction':>22}  {'found':>22}  {'error':>10}")
    for seed in range(stated.seeds):
        side = float(np.random.default_rng(seed).uniform(0, 2 * math.pi))
        true, turned = inclined_arm(sim, stated.arm, math.radians(stated.incline), side, seed)
        q = true.sample(stated.poses, seed + 100)
        position, _ = true.measure(q, rng=np.random.default_rng(seed + 200))
        rows = Measurements(q=torch.from_numpy(q), position=torch.from_numpy(position))
        learned = HybridCalibrator(robot).fit(rows).learned
        found = gravity_in_base(robot, learned.correction.features) if learned is not None else None
        down = turned.inv().apply(DOWN)
        errors.append(math.inf if found is None else math.degrees(math.acos(min(1.0, float(down @ found)))))
        texts = [
            "(" + ", ".join(f"{x:5.2f}" for x in one) + ")" if one is not None else "none"
            for one in (down, found)
        ]
        print(f"{seed:4d}  {texts[0]:>22}  {texts[1]:>22}  {errors[-1]:6.1f} deg", flush=True)
    within = sum(one <= 5 for one in errors)
    print(f"within 5 deg: {within} of {len(errors)}; median {np.median(errors):.1f} deg")


if __name__ == "__main__":
    main()
