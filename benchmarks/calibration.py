"""Compare the time and the held-out error of geometric calibration with other packages on one data set.

Install with `pip install -e ".[bench]"` in a separate environment (pybotics needs an older numpy), then run
`OMP_NUM_THREADS=1 python benchmarks/calibration.py`. A 6R arm (UR10) has errors of 0.5 mm and 1 mrad in all DH and
Hayati parameters, unknown base and tool, and position noise of 0.05 mm per axis. The printed errors are those of the
true tool position at 2000 new poses. The peers start from the true base and tool with errors of 10 mm and 10 mrad;
pisigma has no initial guess. Every fit runs several times, and the fastest run counts. pybotics is stopped after 3000
evaluations, which take about a minute, and runs once.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import Geometry, forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian

Calibrate = Callable[[Robot, np.ndarray, np.ndarray], Callable[[np.ndarray], np.ndarray]]

POSE = np.array([3.0, -1.0, 0.5, 0.4, 0.2, -0.7])
TOOL = np.array([0.02, -0.03, 0.15, 0.0, 0.0, 0.0])
LENGTH, ANGLE, NOISE = 0.5e-3, 1e-3, 0.05e-3


def make_true_robot(nominal: Robot, generator: np.random.Generator) -> Robot:
    """Return the nominal robot with errors in every parameter, on a base and with a tool."""
    sizes = np.array([ANGLE, LENGTH, LENGTH, ANGLE, ANGLE])
    return nominal.with_geometry(nominal.dh + sizes * generator.standard_normal(nominal.dh.shape), POSE, TOOL)


def calibrate_pisigma(nominal: Robot, q: np.ndarray, p: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Calibrate with pisigma's default."""
    result = GeometricCalibrator(nominal).fit(Measurements(torch.from_numpy(q), torch.from_numpy(p)))

    def predict(joints: np.ndarray) -> np.ndarray:
        rows = Measurements(torch.from_numpy(joints))
        return predicted_poses(result.robot, result.bases, result.tools, rows)[:, :3, 3].numpy()

    return predict


def calibrate_scipy(nominal: Robot, q: np.ndarray, p: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Calibrate with scipy's least_squares, with the same parameters and a Jacobian by finite differences."""
    from scipy.optimize import least_squares

    start = np.concatenate([nominal.dh.ravel(), POSE + 0.01, TOOL[:3] + 0.01])

    def predict_with(x: np.ndarray, joints: np.ndarray) -> np.ndarray:
        robot = nominal.with_geometry(x[:30].reshape(6, 5), x[30:36], np.concatenate([x[36:], np.zeros(3)]))
        return forward_kinematics(robot, torch.from_numpy(joints), Geometry.from_robot(robot))[
            :, :3, 3
        ].numpy()

    found = least_squares(lambda x: (predict_with(x, q) - p).ravel(), start, x_scale="jac", method="trf")
    return lambda joints: predict_with(found.x, joints)


def calibrate_pybotics(nominal: Robot, q: np.ndarray, p: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Calibrate with pybotics: modified DH without Hayati's angle, its error function, scipy's least_squares."""
    from pybotics.geometry import vector_2_matrix
    from pybotics.kinematic_chain import MDHKinematicChain
    from pybotics.optimization import OptimizationHandler, optimize_accuracy
    from pybotics.robot import Robot as Peer
    from pybotics.tool import Tool
    from scipy.optimize import least_squares

    theta, d, a, alpha = (nominal.dh[:, column] for column in range(4))
    shifted = [np.concatenate([[0.0], values[:-1]]) for values in (alpha, a)]
    chain = MDHKinematicChain.from_parameters(np.stack([*shifted, theta, d], axis=1))
    world = vector_2_matrix(np.concatenate([POSE[:3] + 0.01, (POSE[3:] + 0.01)[::-1]]))
    tool = Tool(matrix=vector_2_matrix(np.concatenate([TOOL[:3] + 0.01, np.zeros(3)])))
    handler = OptimizationHandler(
        Peer(chain, tool=tool, world_frame=world),
        kinematic_chain_mask=True,
        tool_mask=[True] * 3 + [False] * 3,
        world_mask=True,
    )
    found = least_squares(
        optimize_accuracy,
        handler.generate_optimization_vector(),
        args=(handler, q, p),
        method="lm",
        max_nfev=3000,
    )
    handler.apply_optimization_vector(found.x)
    return lambda joints: np.stack([handler.robot.fk(row)[:3, 3] for row in joints])


def calibrate_robotkinecal(
    nominal: Robot, q: np.ndarray, p: np.ndarray
) -> Callable[[np.ndarray], np.ndarray]:
    """Calibrate with robotkinecal: screw axes by Gauss-Newton (Li, Wu, Loewe and Li 2016), from nominal values."""
    import roboticstoolbox as rtb
    from robotkinecal import SerialRobotKineCal
    from spatialmath import SE3

    start = nominal.with_geometry(nominal.dh, POSE + 0.01, np.concatenate([TOOL[:3] + 0.01, np.zeros(3)]))
    zero = torch.zeros(nominal.dof, dtype=torch.float64)
    T, J = (values.numpy() for values in joint_jacobian(start, zero))
    axes = J[3:].T
    points = T[:3, 3] + np.cross(axes, J[:3].T)
    links = [rtb.PoERevolute(axis, point) for axis, point in zip(axes, points, strict=True)]
    peer = SerialRobotKineCal(rtb.PoERobot(links, SE3(T, check=False)))
    peer.joint_screw_axis = peer.joint_screw_axis[1:-1]  # the first and the last link are frames, not joints
    peer.N_JOINTS = nominal.dof
    peer.set_observations(list(q), list(p))
    peer.solve()
    return lambda joints: np.stack([peer.forward_kinematics(peer.N_JOINTS + 1, row).t for row in joints])


PEERS = {
    "pisigma": calibrate_pisigma,
    "robotkinecal": calibrate_robotkinecal,
    "scipy": calibrate_scipy,
    "pybotics": calibrate_pybotics,
}
REPEATS = 7
"""Number of fits of each peer that is faster than `QUICK`; the fastest fit counts."""
QUICK = 2.0
"""Duration of a fit below which it is repeated [s]."""


def timed(
    calibrate: Calibrate, nominal: Robot, q: np.ndarray, p: np.ndarray
) -> tuple[float, Callable[[np.ndarray], np.ndarray]]:
    """Return the time of the fastest fit [s] and its prediction of positions."""
    seconds: list[float] = []
    while len(seconds) < (REPEATS if not seconds or seconds[0] < QUICK else 1):
        started = time.perf_counter()
        predict = calibrate(nominal, q, p)
        seconds.append(time.perf_counter() - started)
    return min(seconds), predict


def main() -> None:
    """Run all installed peers on the same rows and print the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--poses", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    generator = np.random.default_rng(options.seed)
    nominal = Robot.load("ur10")
    true_robot = make_true_robot(nominal, generator)
    q, fresh = (generator.uniform(-np.pi, np.pi, (count, 6)) for count in (options.poses, 2000))
    truth, wanted = (
        forward_kinematics(true_robot, torch.from_numpy(joints))[:, :3, 3].numpy() for joints in (q, fresh)
    )
    measured = truth + NOISE * generator.standard_normal(truth.shape)
    calibrate_pisigma(nominal, q, measured)  # warm up
    reference: tuple[float, float] | None = None
    print(f"{options.poses} poses; held-out: mean true error of 2000 new poses")
    for name, calibrate in PEERS.items():
        try:
            seconds, predict = timed(calibrate, nominal, q, measured)
        except ImportError as problem:
            print(f"{name:12s} not installed ({problem.name})")
            continue
        error = float(np.linalg.norm(predict(fresh) - wanted, axis=1).mean()) * 1e3
        reference = reference or (seconds, error)
        print(
            f"{name:12s} {seconds:9.4f} s ({seconds / reference[0]:7.1f} x)   "
            f"{error:8.4f} mm ({error / reference[1]:6.2f} x)"
        )


if __name__ == "__main__":
    main()
