"""Two arms of one torso, and two arms that touch one another: errors of their bases and bounds, and what moved.

    OMP_NUM_THREADS=1 python benchmarks/torso_and_touches.py [torso] [zero] [touches] [--sets 100] [--still 40]

Torso: a URDF tree with a waist that turns and two arms of six joints, whose tools a tracker measures in one frame (60
positions of each, noise 0.05 mm). Every determined parameter of the arms has errors of 0.3 mm and 0.3 mrad. The figures
are those of the one base of the torso, and of the angle and height of the branch to the right arm, which contain the
difference of its zero. Zero: the same arms with 8 new positions of each, in cells where nothing moved, and where the
zero of the waist, the base or the frame moved.

Touches: two UR5s that a tracker measured in a frame each (60 positions, 0.05 mm), and whose tips, at unknown positions
on the flanges, touched one another 20 times (0.05 mm per axis).

The bounds are those of one fit of all rows, by differences of the forward kinematics and independently of the
derivatives and equations of the package.
"""

import argparse
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from pisigma.calibration.frames.arm_bases import ArmBases, fit_arm_bases
from pisigma.calibration.frames.shared_objects import ArmPosterior, Postures, Touches, uncertainty_of
from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.estimation.loss import SquaredLoss
from pisigma.lifetime.comparison.moved_bases import RemeasuredArm, find_moved_bases
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements
from pisigma.model.frame_model import frames_of_model
from pisigma.model.geometric_model import model_of_calibration
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.robot.row import DH_COLUMNS
from pisigma.robot.se3 import invert, pose_error, rotation_from_vector, transform, transform_from_xyz_zyx

ARMS, NOISE, SIZE, STEP, ROWS, FEW, TOUCHES = ("left", "right"), 5e-5, 3e-4, 1e-6, 60, 8, 20
IN_HALL = np.array([0.4, -0.7, 0.1, 0.5, 0.05, -0.1])
SECOND = np.array([1.1, 0.1, 0.05, 2.8, 0.1, -0.2])
TOOL, TIP = np.array([0.05, -0.03, 0.12, 0.0, 0.0, 0.0]), np.array([-0.02, 0.04, 0.15])
SHOULDER = {"left": ("0.02 0.2 0.3", "-0.9 0.1 0"), "right": ("0.02 -0.2 0.3", "0.9 0.1 0")}
LINKS = ("0 0.1 0.1", "0 0 0.4", "0 0 0.35", "0 0.1 0", "0 0 0.1")
AXES = ("0 0 1", "0 1 0", "0 1 0", "0 1 0", "0 0 1", "0 1 0")


def torso_urdf() -> str:
    """Return a waist with two arms of six joints."""
    text = '<robot name="torso"><link name="root"/>\n'

    def joint(name: str, parent: str, xyz: str, rpy: str, axis: str) -> str:
        return (
            f'<link name="{name}_link"/><joint name="{name}" type="revolute"><origin xyz="{xyz}" rpy="{rpy}"/>'
            f'<parent link="{parent}"/><child link="{name}_link"/><axis xyz="{axis}"/>'
            '<limit lower="-3.2" upper="3.2" effort="1" velocity="1"/></joint>\n'
        )

    text += joint("waist", "root", "0 0 0.3", "0 0 0", "0 0 1")
    for side in ARMS:
        parent = "waist_link"
        for number, axis in enumerate(AXES):
            xyz, rpy = SHOULDER[side] if number == 0 else (LINKS[number - 1], "0 0 0")
            text += joint(f"{side}_{number + 1}", parent, xyz, rpy, axis)
            parent = f"{side}_{number + 1}_link"
    return text + "</robot>\n"


def with_values(nominal: Robot, free: tuple[str, ...], values: np.ndarray, base: np.ndarray) -> Robot:
    """Return an arm with errors of its free parameters."""
    dh = nominal.dh.copy()
    for name, value in zip(free, values, strict=True):
        column, joint = name.split("_")
        dh[int(joint) - 1, DH_COLUMNS.index(column)] += value
    return nominal.with_geometry(dh, base=base, tool=TOOL)


def positions(robot: Robot, q: torch.Tensor) -> np.ndarray:
    """Return positions of the tool."""
    return forward_kinematics(robot, q)[:, :3, 3].numpy()


def measured(robot: Robot, q: torch.Tensor, frame: str, rng: np.random.Generator) -> Measurements:
    """Return measured positions."""
    there = positions(robot, q) + rng.normal(0, NOISE, (len(q), 3))
    return Measurements(q=q, position=torch.from_numpy(there), frame=(frame,) * len(q))


def postures(robot: Robot, rng: np.random.Generator, count: int = ROWS) -> torch.Tensor:
    """Return random joint values."""
    return torch.from_numpy(rng.uniform(-2.2, 2.2, (count, robot.dof)))


def bound_of(
    values: Callable[[np.ndarray], np.ndarray], unknowns: int, wanted: np.ndarray | slice
) -> np.ndarray:
    """Return the Cramér-Rao bound of some unknowns of measured values with the noise of a position."""
    steps = STEP * np.eye(unknowns)
    X = np.stack([(values(step) - values(-step)) / (2 * STEP * NOISE) for step in steps], -1)
    return np.sqrt(np.diag(np.linalg.inv(X.T @ X)))[wanted]


def stepped(T: torch.Tensor, step: np.ndarray) -> torch.Tensor:
    """Return a pose shifted along and rotated about the axes of its frame."""
    R = rotation_from_vector(torch.from_numpy(step[3:].copy())) @ T[:3, :3]
    return transform(R, T[:3, 3] + torch.from_numpy(step[:3].copy()))


def calibrator_of(nominal: Robot, free: tuple[str, ...] | str = "identifiable") -> GeometricCalibrator:
    """Return a calibrator without prior."""
    return GeometricCalibrator(nominal, free=free, prior=None, loss=SquaredLoss(), tool="position")


def free_of(nominal: Robot, q: torch.Tensor, base: np.ndarray) -> tuple[str, ...]:
    """Return the parameters of an arm that its rows determine, in addition to base and tool."""
    rows = measured(nominal.with_geometry(base=base, tool=TOOL), q, "hall", np.random.default_rng(0))
    every = calibrator_of(nominal).fit(rows).free_parameters
    return tuple(name for name in every if name.split("_")[0] in DH_COLUMNS)


def show(names: str, errors: list[np.ndarray], stated: list[np.ndarray], bounds: list[np.ndarray]) -> None:
    """Print RMS errors and stated standard errors relative to the bound."""
    root = np.sqrt(np.mean(np.square(bounds), 0))
    print(names)
    print("bound [um, urad]     ", *(f"{one:8.2f}" for one in root * 1e6))
    print("RMS error / bound    ", *(f"{one:8.3f}" for one in np.sqrt(np.mean(np.square(errors), 0)) / root))
    print("stated / bound       ", *(f"{one:8.3f}" for one in np.sqrt(np.mean(np.square(stated), 0)) / root))
    print("all, RMS error / bound", f"{np.sqrt(np.mean(np.square(np.array(errors) / root))):.3f}")


class Torso:
    """The arms of a torso, with the parameters that have errors."""

    def __init__(self) -> None:
        """Read the tree."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "torso.urdf"
            path.write_text(torso_urdf())
            self.nominal = [Robot.load(path, tip=f"{side}_6_link") for side in ARMS]
        rng = np.random.default_rng(0)
        self.q = [postures(one, rng) for one in self.nominal]
        self.later = [postures(one, rng, FEW) for one in self.nominal]
        self.free = [free_of(one, q, IN_HALL) for one, q in zip(self.nominal, self.q, strict=True)]
        self.branch = ("theta_1", "d_1")

    def drawn(self, rng: np.random.Generator) -> list[np.ndarray]:
        """Return random errors; the last two of the right arm are those of its branch."""
        sizes = (len(self.free[0]), len(self.free[1]) + 2)
        return [SIZE * rng.standard_normal(size) for size in sizes]

    def true(self, values: list[np.ndarray], base: np.ndarray) -> list[Robot]:
        """Return the arms with errors."""
        free = (self.free[0], (*self.free[1], *self.branch))
        return [with_values(*one, base) for one in zip(self.nominal, free, values, strict=True)]

    def fitted(
        self, true: list[Robot], rng: np.random.Generator
    ) -> tuple[list[Measurements], list[CalibrationResult], ArmBases]:
        """Return rows, fits and bases."""
        rows = [measured(one, q, "hall", rng) for one, q in zip(true, self.q, strict=True)]
        fits = [
            calibrator_of(*one).fit(own)
            for one, own in zip(zip(self.nominal, self.free, strict=True), rows, strict=True)
        ]
        arms = [
            ArmPosterior(name, uncertainty_of(fit), torso_joints=("waist",))
            for name, fit in zip(ARMS, fits, strict=True)
        ]
        return rows, fits, fit_arm_bases(arms)

    def bound(self, values: list[np.ndarray]) -> np.ndarray:
        """Return the bound of the base and of the branch."""
        sizes = [len(one) for one in values]
        T = transform_from_xyz_zyx(torch.from_numpy(IN_HALL))

        def of_all(u: np.ndarray) -> np.ndarray:
            own = np.split(u[12:], [sizes[0]])
            base = stepped(T, u[:6])
            arms = self.true([a + b for a, b in zip(values, own, strict=True)], np.zeros(6))
            return np.concatenate(
                [
                    (
                        positions(arm.with_geometry(tool=TOOL + np.pad(u[6 + 3 * k : 9 + 3 * k], (0, 3))), q)
                        @ base[:3, :3].numpy().T
                        + base[:3, 3].numpy()
                    ).ravel()
                    for k, (arm, q) in enumerate(zip(arms, self.q, strict=True))
                ]
            )

        count = 12 + sum(sizes)
        return bound_of(of_all, count, np.array([*range(6), count - 2, count - 1]))


def compare_torso(sets: int) -> None:
    """Print errors of the base of a torso and of the branch to its right arm."""
    torso = Torso()
    errors, stated, bounds = [], [], []
    where = transform_from_xyz_zyx(torch.from_numpy(IN_HALL))
    for seed in range(sets):
        rng = np.random.default_rng(seed)
        values = torso.drawn(rng)
        _, _, found = torso.fitted(torso.true(values, IN_HALL), rng)
        right = found.updated_arms[1]
        base = list(right.base_indices("hall"))
        J = torch.func.jacrev(lambda one: pose_error(transform_from_xyz_zyx(one), where))(right.values[base])
        names = [right.space.index(name) for name in torso.branch]
        offsets = right.values[names].numpy() - torso.nominal[1].dh[0, :2] - values[1][-2:]
        errors.append(np.r_[pose_error(transform_from_xyz_zyx(right.values[base]), where).numpy(), offsets])
        stated.append(
            torch.cat([J @ right.covariance_root[base], right.covariance_root[names]]).norm(dim=1).numpy()
        )
        bounds.append(torso.bound(values))
    print(f"{sets} sets; free parameters of the arms: {len(torso.free[0])} and {len(torso.free[1])}")
    show(
        "                            x        y        z  about x  about y  about z    angle   height",
        errors,
        stated,
        bounds,
    )


def find_zero(still: int) -> None:
    """Print what is named if nothing, the zero of the waist, the base or the frame moved."""
    torso, named, counts = Torso(), Counter[tuple[str, str]](), Counter[str]()
    bump = transform(
        rotation_from_vector(torch.tensor([0, 3e-4, -4e-4]).double()), torch.tensor([4e-4, 0, 3e-4]).double()
    )
    T_hall = transform_from_xyz_zyx(torch.from_numpy(IN_HALL))
    turn = transform(rotation_from_vector(torch.tensor([0, 0, 5e-4]).double()), torch.zeros(3).double())
    for seed in range(still):
        rng = np.random.default_rng(1000 + seed)
        values = torso.drawn(rng)
        rows, fits, found = torso.fitted(torso.true(values, IN_HALL), rng)
        known = found.updated_arms
        models = []
        for arm, fit, own, nominal in zip(known, fits, rows, torso.nominal, strict=True):
            geometry = arm.uncertainty.geometry
            made = model_of_calibration(arm.name, nominal, fit, own)
            models.append(
                replace(
                    made,
                    calibrated=geometry.robot,
                    robot=nominal.with_geometry(base=geometry.robot.base, tool=geometry.robot.tool),
                    bases=geometry.bases,
                    tools=geometry.tools,
                    uncertainty=arm.uncertainty,
                )
            )
        for body in ("nothing",) if seed % 2 else ("nothing", "waist", "base or hall"):
            motion = {"waist": T_hall @ turn @ invert(T_hall), "nothing": torch.eye(4).double()}.get(
                body, bump
            )
            now = []
            for k, robot in enumerate(torso.true(values, IN_HALL)):
                p = torch.from_numpy(positions(robot, torso.later[k])) @ motion[:3, :3].mT + motion[:3, 3]
                p = p + torch.from_numpy(rng.normal(0, NOISE, p.shape))
                later = Measurements(q=torso.later[k], position=p, frame=("hall",) * FEW)
                now.append(frames_of_model(models[k], later, "base"))
            T = torch.stack([found.relative(0, k)[0] for k in range(2)])
            what = find_moved_bases([RemeasuredArm(*one) for one in zip(known, T, now, strict=True)])
            text = " or ".join(f"{one.kind} {one.name}" for one in what.likely_bodies) or "nothing"
            named[body, text if what.is_one_body else f"more than {text}"] += 1
            counts[body] += 1
    for (body, text), count in sorted(named.items()):
        print(f"{body} moved: named {text} in {count} of {counts[body]}")


def reached(robot: Robot, wanted: np.ndarray, rng: np.random.Generator) -> torch.Tensor:
    """Return joint values at which the tool is at points."""
    q = torch.from_numpy(np.array([0, -1.5, 1.5, 0, 1.5, 0]) + rng.uniform(-1, 1, (len(wanted), 6)))
    q[:, 0] = torch.from_numpy(np.arctan2(wanted[:, 1], wanted[:, 0])) + np.pi
    for _ in range(60):
        T, J = joint_jacobian(robot, q)
        step = torch.linalg.pinv(J[:, :3]) @ (torch.from_numpy(wanted) - T[:, :3, 3])[..., None]
        q = q + step[..., 0].clamp(-0.3, 0.3)
    return q


def compare_touches(sets: int) -> None:
    """Print errors of the base of an arm in that of another arm, which touched it."""
    nominal = Robot.load("ur5")
    rng = np.random.default_rng(0)
    q = [postures(nominal, rng) for _ in ARMS]
    free = [free_of(nominal, one, IN_HALL) for one in q]
    T_second = transform_from_xyz_zyx(torch.from_numpy(SECOND))
    points = rng.uniform([0.4, -0.25, -0.1], [0.7, 0.3, 0.3], (TOUCHES, 3))
    errors, stated, bounds = [], [], []
    for seed in range(sets):
        rng = np.random.default_rng(seed)
        values = [SIZE * rng.standard_normal(len(one)) for one in free]
        arms: list[ArmPosterior] = []
        touching: list[torch.Tensor] = []
        for k, name in enumerate(ARMS):
            robot = with_values(nominal, free[k], values[k], IN_HALL)
            fit = calibrator_of(nominal, free[k]).fit(measured(robot, q[k], name, rng))
            tipped = robot.with_geometry(base=np.zeros(6), tool=np.pad(TIP, (0, 3)))
            there = invert(T_second).numpy() if k else np.eye(4)
            wanted = points @ there[:3, :3].T + there[:3, 3] + rng.normal(0, NOISE * k, points.shape)
            touching.append(reached(tipped, wanted, rng))
            names = tuple(f"touch {n}" for n in range(TOUCHES))
            sigma = torch.full((TOUCHES,), NOISE / np.sqrt(2), dtype=torch.float64)
            state = Postures(JointState.from_measurements(Measurements(q=touching[k])), touching[k])
            touches = Touches(names, ("tip",) * TOUCHES, sigma, state)
            arms.append(ArmPosterior(name, uncertainty_of(fit), touches))
        T, covariance = fit_arm_bases(arms).relative(0, 1)
        errors.append(pose_error(T_second, T).numpy())
        stated.append(covariance.diagonal().sqrt().numpy())
        sizes = [len(one) for one in free]

        def of_all(
            u: np.ndarray,
            values: list[np.ndarray] = values,
            touching: list[torch.Tensor] = touching,
            sizes: list[int] = sizes,
        ) -> np.ndarray:
            split = np.split(u[30:], [sizes[0]])
            parts, tips = [], []
            for k in range(2):
                own = with_values(nominal, free[k], values[k] + split[k], np.zeros(6))
                base = stepped(
                    transform_from_xyz_zyx(torch.from_numpy(IN_HALL)), u[6 + 6 * k : 12 + 6 * k]
                ).numpy()
                tool = TOOL + np.pad(u[18 + 3 * k : 21 + 3 * k], (0, 3))
                parts.append(positions(own.with_geometry(tool=tool), q[k]) @ base[:3, :3].T + base[:3, 3])
                tip = np.pad(TIP + u[24 + 3 * k : 27 + 3 * k], (0, 3))
                second = stepped(T_second, u[:6]).numpy() if k else np.eye(4)
                tips.append(
                    positions(own.with_geometry(tool=tip), touching[k]) @ second[:3, :3].T + second[:3, 3]
                )
            return np.concatenate([*parts, tips[1] - tips[0]]).ravel()

        bounds.append(bound_of(of_all, 30 + sum(sizes), slice(6)))
    print(f"{sets} sets; free parameters of the arms: {len(free[0])} and {len(free[1])}")
    show("                            x        y        z  about x  about y  about z", errors, stated, bounds)


def main() -> None:
    """Run the comparisons, all or those that are named."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--still", type=int, default=40)
    parser.add_argument("parts", nargs="*", default=("torso", "zero", "touches"))
    arguments = parser.parse_args()
    if "torso" in arguments.parts:
        compare_torso(arguments.sets)
    if "zero" in arguments.parts:
        find_zero(arguments.still)
    if "touches" in arguments.parts:
        compare_touches(arguments.sets)


if __name__ == "__main__":
    main()
