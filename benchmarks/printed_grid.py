"""Calibrate an arm of servos with a printed grid or a ruler: true and predicted errors.

    OMP_NUM_THREADS=1 python benchmarks/printed_grid.py [--draws 20]

The arms are SO-101 with zeros off by 5 to 17 deg, links by 1 mm (standard deviation), and servos that repeat to 0.5
deg. In the part "grid", the tip touches 40 crossings of a grid of 20 mm on one sheet, each within 0.5 mm. In the part
"ruler", it touches pairs of points on the sheet and up to 100 mm above it, of which only the 40 lengths between them
are known, which are at least 100 mm, to 0.5 mm; the position of the arm stays unknown, so errors are those after the
best rigid alignment. Errors are those of the tip at 100 random points over the sheet, up to 100 mm above it, without
the noise of the servos. The predicted RMS is that of the posterior.
"""

import argparse
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

import pisigma
from pisigma.calibration.geometric.calibrator import CalibrationResult
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.measurement.conditions import JointState
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.robot.se3 import skew

ROWS, JUDGED = 40, 100
SERVO, TOUCH = np.deg2rad(0.5), 5e-4
ZEROS, LINKS = np.deg2rad((5.0, 17.0)), 1e-3
SHEET = np.array([[0.16, -0.12, 0.0], [0.3, 0.12, 0.0]])
"""Corners of the sheet in the frame of the arm [m]; the frame of the measurements is that of the sheet."""
MESH, HEIGHT, SHORTEST = 0.02, 0.1, 0.1
POSTURE = 1.7
"""Largest joint value of a posture [rad]."""
DAMPING, STEPS, TRIES = 1e-3, 40, 60


@dataclass(frozen=True, eq=False)
class Draw:
    """An arm and the joint values at which its tip is at given points.

    Attributes:
        nominal: the arm as described.
        true: the arm as built.
        random: generator of this draw.
    """

    nominal: Robot
    true: Robot
    random: np.random.Generator

    @staticmethod
    def of(seed: int) -> "Draw":
        """Draw an arm."""
        random, nominal = np.random.default_rng(seed), Robot.load("so101")
        dh = nominal.dh.copy()
        dh[:, 0] += random.uniform(ZEROS[0], ZEROS[1], 5) * random.choice([-1, 1], 5)
        dh[:, 1:3] += random.normal(0, LINKS, (5, 2))
        return Draw(nominal, nominal.with_geometry(dh), random)

    def at_points(self, count: int, height: float) -> tuple[Tensor, np.ndarray]:
        """Return joint values and random points, crossings of the grid if the height is 0, that the tip reaches."""
        low, high = (torch.from_numpy(one) for one in np.clip(self.true.limits, -POSTURE, POSTURE).T)
        found, points = list[Tensor](), list[np.ndarray]()
        for _ in range(TRIES):
            there = self.random.uniform(SHEET[0], SHEET[1] + np.array([0, 0, height]), (count, 3))
            there[:, :2] = there[:, :2] if height else np.round(there[:, :2] / MESH) * MESH
            wanted = torch.from_numpy(there)
            q = low + (high - low) * torch.from_numpy(self.random.uniform(size=(count, 5)))
            for _ in range(STEPS):
                T, J = joint_jacobian(self.true, q)
                J = J[:, :3]
                damped = J @ J.mT + DAMPING**2 * torch.eye(3, dtype=torch.float64)
                step = J.mT @ torch.linalg.solve(damped, (wanted - T[:, :3, 3])[..., None])
                q = (q + step[..., 0].clamp(-0.5, 0.5)).clamp(low, high)
            reached = (positions(self.true, q) - wanted).norm(dim=1) < 1e-6
            found.append(q[reached])
            points.append(there[reached.numpy()])
            if sum(map(len, found)) >= count:
                break
        return torch.cat(found)[:count], np.concatenate(points)[:count]

    def logged(self, q: Tensor) -> Tensor:
        """Return joint values as servos report them."""
        return q + torch.from_numpy(SERVO * self.random.normal(size=q.shape))

    def touched(self) -> pisigma.Measurements:
        """Return rows of touched crossings, whose coordinates are those on the sheet."""
        q, points = self.at_points(ROWS, 0.0)
        points = points + TOUCH * self.random.normal(size=points.shape)
        return pisigma.Measurements(self.logged(q), torch.from_numpy(points))

    def by_ruler(self) -> pisigma.Measurements:
        """Return rows of pairs of touched points, up to 100 mm above the sheet, with the length between them."""
        q, points = self.at_points(8 * ROWS, HEIGHT)
        length = np.linalg.norm(points[::2] - points[1::2], axis=1)
        chosen = np.flatnonzero(length > SHORTEST)[:ROWS]
        q = q.unflatten(0, (-1, 2))[torch.from_numpy(chosen)].flatten(0, 1)
        length = length[chosen] + TOUCH * self.random.normal(size=ROWS)
        pairs = tuple(f"pair {number}" for number in range(ROWS) for _ in range(2))
        return pisigma.Measurements(
            self.logged(q), distance=torch.from_numpy(length).repeat_interleave(2), pair=pairs
        )


def positions(robot: Robot, q: Tensor) -> Tensor:
    """Return the positions of the tip [m]."""
    return forward_kinematics(robot, q)[:, :3, 3]


def rigid_motions(points: Tensor) -> Tensor:
    """Return an orthonormal basis `(3 points, 6)` of the motions of rigid points."""
    shift = torch.eye(3, dtype=torch.float64).expand(len(points), 3, 3)
    return torch.linalg.qr(torch.cat([shift, skew(points - points.mean(0))], 2).flatten(0, 1)).Q


def rms_mm(error: Tensor) -> float:
    """Return the RMS length of errors [mm]."""
    return 1e3 * float(error.square().sum(-1).mean().sqrt())


def errors(draw: Draw, rows: pisigma.Measurements, q: Tensor, aligned: bool) -> tuple[float, float, float]:
    """Return the RMS error of the nominal and of the calibrated arm, and the predicted one [mm]."""
    settings = pisigma.CalibrationSettings(model="geometric", folds=0)
    calibration = pisigma.calibrate(draw.nominal, rows, settings)
    result, true = calibration.result, positions(draw.true, q)
    assert isinstance(result, CalibrationResult)
    before, after = (positions(one, q) for one in (draw.nominal, calibration.model.identified))
    root = CovarianceRoot(result.solved.covariance_root)
    known = PositionUncertainty(result.solved.problem.space, result.solved.geometry, (), root, 1.0)
    spread = root.left_multiply(known.pose_derivatives(JointState(q), q)[:, :3]).flatten(0, 1)
    if aligned:
        Q = rigid_motions(true)
        spread = spread - Q @ (Q.mT @ spread)
        before, after = (best_aligned(one, true) for one in (before, after))
    predicted = 1e3 * float((spread.square().sum() / len(q)).sqrt())
    return rms_mm(before - true), rms_mm(after - true), predicted


def best_aligned(points: Tensor, other: Tensor) -> Tensor:
    """Move points rigidly onto others (Kabsch 1976)."""
    a, b = points - points.mean(0), other - other.mean(0)
    U, _, Vh = torch.linalg.svd(a.mT @ b)
    sign = torch.ones(3, dtype=torch.float64)
    sign[2] = torch.linalg.det(U @ Vh)
    return a @ (U * sign @ Vh) + other.mean(0)


def main(draws: int) -> None:
    """Print the errors of every part."""
    for part, limit in (("grid", 3.0), ("ruler", 6.0)):
        found, refused = list[tuple[float, float, float]](), 0
        for seed in range(draws):
            draw = Draw.of(seed)
            rows = draw.touched() if part == "grid" else draw.by_ruler()
            q, _ = draw.at_points(JUDGED, HEIGHT)
            try:
                found.append(errors(draw, rows, q, part == "ruler"))
            except pisigma.PisigmaError as refusal:
                refused += 1
                print(f"{part}, seed {seed}: {refusal}")
        before, after, predicted = np.array(found).T
        ratio = predicted / after
        print(
            f"{part}: RMS {np.sqrt(np.mean(after**2)):.2f} mm of {len(after)} arms, largest {after.max():.2f} mm, "
            f"nominal {np.sqrt(np.mean(before**2)):.1f} mm; at most {limit:g} mm: {(after <= limit).sum()} of {draws}, "
            f"{refused} refused; predicted over true {np.sqrt(np.mean(predicted**2) / np.mean(after**2)):.2f} "
            f"(median {np.median(ratio):.2f}, {ratio.min():.2f} to {ratio.max():.2f})"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=20)
    main(parser.parse_args().draws)
