"""How much joint torques measured in MuJoCo improve on modelled gravity torques if the payload is unknown.

`python benchmarks/joint_torques.py [--arm ur5] [--seeds 3] [--rows 60]`

MuJoCo's proportional controllers drive the arm of `closed_loop.py` with elastic gears to random poses, with another
payload (0 to 5 kg) in every row; a tracker measures the reflector with a noise of 0.03 mm per axis. The rows state the
torques of the drives (`qfrc_actuator`), with a noise of 1 % of their spread, and no payload. A hybrid is calibrated
with and without the torques. 100 other poses, also with other payloads, are left out and predicted. The program needs
the extra `bench`.
"""

import argparse
from dataclasses import replace

import numpy as np
import torch
from closed_loop import ARMS, NOISE_MM, rms
from mujoco_arm import ArmErrors, DrawnArm, PerturbedArm

import pisigma
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.measurement.dataset import Measurements
from pisigma.planning.candidates import draw_candidates
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings

PAYLOADS_KG = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
LEFT_OUT = 100
TORQUE_NOISE = 0.01


def measured(drawn: DrawnArm, robot: pisigma.Robot, seed: int, rows: int) -> Measurements:
    """Drive an arm with errors, with the payloads of `PAYLOADS_KG` in groups of rows."""
    rng = np.random.default_rng([seed, 11])
    arm = ArmInSurroundings.from_robot(robot)
    q = draw_candidates(arm, rows, 500 + seed).q[:rows].numpy()
    position, torque = np.empty((rows, 3)), np.empty_like(q)
    for k, payload in enumerate(PAYLOADS_KG):
        some = slice(k, rows, len(PAYLOADS_KG))
        driven = PerturbedArm(drawn, ArmErrors(elastic=drawn.elastic), seed, payload).drive(q[some])
        position[some], torque[some] = driven.position, driven.torque
    position += rng.normal(0, NOISE_MM * 1e-3, position.shape)
    torque += rng.normal(size=torque.shape) * TORQUE_NOISE * torque.std(0)
    return Measurements(torch.from_numpy(q), torch.from_numpy(position), torque=torch.from_numpy(torque))


def left_out_mm(robot: pisigma.Robot, rows: Measurements, test: Measurements) -> tuple[float, str]:
    """Return the RMS error [mm] of left-out rows, and the features that were kept."""
    result = HybridCalibrator(robot).fit(rows)
    kept = () if result.learned is None else result.learned.correction.features
    errors = result.errors_of(test)["position"].norm(dim=1).numpy() * 1e3
    return rms(errors), ", ".join(one.name for one in kept) or "geometry only"


def main() -> None:
    """Print the left-out errors of every arm."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arm", choices=ARMS, default="ur5")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--rows", type=int, default=60)
    stated = parser.parse_args()
    torch.set_num_threads(1)
    drawn = ARMS[stated.arm]
    robot = pisigma.Robot.load(str(drawn.urdf), base=drawn.base, tip=drawn.tip)
    for seed in range(stated.seeds):
        every = measured(drawn, robot, seed, stated.rows + LEFT_OUT)
        rows, test = (
            every.select(torch.arange(*ends)) for ends in ((0, stated.rows), (stated.rows, every.rows))
        )
        modelled, kept = left_out_mm(robot, replace(rows, torque=None), test)
        with_torques, with_kept = left_out_mm(robot, rows, test)
        print(
            f"{stated.arm} {seed}: {modelled:.3f} mm with modelled gravity ({kept}), {with_torques:.3f} mm with "
            f"measured torques ({with_kept})",
            flush=True,
        )


if __name__ == "__main__":
    main()
