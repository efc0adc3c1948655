"""Realistic mistakes in measured files: 30 in the positions of a UR5, 30 in the poses of a UR10.

`python tests/hostile/mistakes.py` calibrates with all of them, and prints each result: refused (2), not to be trusted
(3) or accepted (0), and whether the cause was named.
"""

import argparse
import math
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.files.errors import PisigmaError
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.workflow.calibrate import calibrate
from pisigma.workflow.settings.calibration import CalibrationSettings

Change = Callable[[Measurements, Robot], Measurements]


@dataclass(frozen=True)
class Mistake:
    """One mistake in a clean file.

    Attributes:
        name: description of the mistake.
        change: function that puts the mistake into clean measurements of a robot.
        words: pattern of the names and technical terms by which the cause is recognised.
        robot: robot to calibrate, where it is not the measured one.
    """

    name: str
    change: Change
    words: str
    robot: str | None = None


def _joints(factor: object = 1.0, order: Sequence[int] | None = None, offset: object = 0.0) -> Change:
    def change(clean: Measurements, robot: Robot) -> Measurements:
        q = clean.q if order is None else clean.q[:, list(order)]
        return replace(clean, q=q * torch.as_tensor(factor).double() + torch.as_tensor(offset).double())

    return change


def _sign(*joints: int) -> Mistake:
    factor = [-1.0 if joint + 1 in joints else 1.0 for joint in range(6)]
    listed = " and ".join(str(joint) for joint in joints)
    words = rf"sign.* joint {joints[0]}\b" if len(joints) == 1 else r"signs.* joints"
    return Mistake(f"sign of q{listed}", _joints(factor), words)


def _swap(first: int, second: int) -> Mistake:
    order = list(range(6))
    order[first - 1], order[second - 1] = second - 1, first - 1
    words = rf"joints {first} and {second} .*swapped"
    return Mistake(f"q{first} and q{second} swapped", _joints(order=order), words)


def _column(joint: int, values: Callable[[Tensor], Tensor], name: str, words: str) -> Mistake:
    def change(clean: Measurements, robot: Robot) -> Measurements:
        q = clean.q.clone()
        q[:, joint - 1] = values(clean.q)
        return replace(clean, q=q)

    return Mistake(name, change, words)


def _constant(joint: int) -> Mistake:
    words = rf"joint {joint} .*(constant|one value|same value)"
    return _column(
        joint, lambda q: q[:, joint - 1].median().expand(len(q)), f"joint {joint} logged constant", words
    )


def _coupled(joint: int, other: int, factor: float) -> Mistake:
    return _column(
        joint,
        lambda q: q[:, joint - 1] + factor * q[:, other - 1],
        f"q{joint} logged as q{joint} {factor:+g} q{other}",
        rf"joint {joint} .*joint {other}|joints {min(joint, other)} and {max(joint, other)} are coupled",
    )


def _copied(joint: int, other: int) -> Mistake:
    words = rf"joint {joint} .*joint {other}|joints {min(joint, other)} and {max(joint, other)}"
    return _column(joint, lambda q: q[:, other - 1], f"q{other} in the column of q{joint}", words)


def _zero(joint: int, degrees: float) -> Mistake:
    offset = [math.radians(degrees) if other + 1 == joint else 0.0 for other in range(6)]
    return Mistake(
        f"zero of joint {joint} off by {degrees:g} deg",
        _joints(offset=offset),
        rf"joint {joint} .*moved",
    )


def _positions(matrix: object, name: str, words: str) -> Mistake:
    def change(clean: Measurements, robot: Robot) -> Measurements:
        assert clean.position is not None
        return replace(clean, position=clean.position @ torch.as_tensor(matrix).double().mT)

    return Mistake(name, change, words)


def _scaled(factor: float, name: str, words: str) -> Mistake:
    return _positions(factor * torch.eye(3), name, words)


def _rotations(turn: Callable[[Rotation], Rotation], name: str, words: str) -> Mistake:
    def change(clean: Measurements, robot: Robot) -> Measurements:
        assert clean.rotation is not None
        turned = turn(Rotation.from_matrix(clean.rotation.numpy())).as_matrix()
        return replace(clean, rotation=torch.from_numpy(turned))

    return Mistake(name, change, words)


def _shifted(by: int, start: float = 0.0, what: str = "rows") -> Change:
    """Combine the joint values of row `i + by` with the measurement of row `i`, after a fraction of the file."""

    def change(clean: Measurements, robot: Robot) -> Measurements:
        here = torch.arange(max(0, -by), clean.rows - max(0, by))
        logged = torch.where(here >= start * clean.rows, here + by, here)
        shifted = clean.select(here)
        if what == "rotations":
            assert clean.rotation is not None
            return replace(shifted, rotation=clean.rotation[logged])
        return replace(shifted, q=clean.q[logged])

    return change


def _mirrored_poses(clean: Measurements, robot: Robot) -> Measurements:
    """Write poses like a program with a left-handed frame: y reversed in positions and rotations."""
    mirror = torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64))
    assert clean.position is not None
    assert clean.rotation is not None
    return replace(clean, position=clean.position @ mirror, rotation=mirror @ clean.rotation @ mirror)


def _two_reflectors(clean: Measurements, robot: Robot) -> Measurements:
    """Use another reflector, 60 mm from the first, for every third row."""
    assert clean.position is not None
    fitted = GeometricCalibrator(robot).fit(clean).robot
    offset = forward_kinematics(fitted, clean.q)[:, :3, :3] @ torch.tensor([0.05, 0.03, 0.01]).double()
    other = (torch.arange(clean.rows) % 3 == 0)[:, None]
    return replace(clean, position=clean.position + torch.where(other, offset, 0.0))


def _in_other_order(clean: Measurements, robot: Robot) -> Measurements:
    order = torch.randperm(clean.rows, generator=torch.Generator().manual_seed(1))
    return replace(clean, q=clean.q[order])


def unchanged(clean: Measurements, robot: Robot) -> Measurements:
    """Return the measurements without a mistake."""
    return clean


UNITS = (
    Mistake("degrees named radians", _joints(180 / math.pi), r"degrees|unit|limits"),
    Mistake("radians named degrees", _joints(math.pi / 180), r"radians.*degrees"),
    Mistake("gradians named degrees", _joints(10 / 9), r"gon|gradian"),
    _scaled(1e3, "mm named m", r"millimetres|unit"),
    _scaled(1e-3, "m named mm", r"metres|unit"),
    _scaled(1 / 25.4, "inches named mm", r"inches"),
)
ROWS = (
    Mistake("rows shifted by one", _shifted(1), r"shifted by (one|1) row|by 1 row"),
    Mistake("a row lost half-way", _shifted(1, 0.5), r"shifted by (one|1) row|by 1 row"),
    Mistake("rows in another order", _in_other_order, r"other rows|belong together|order"),
)
JOINTS = (
    _sign(1),
    _sign(2),
    _sign(3),
    _sign(4),
    _sign(5),
    _swap(1, 2),
    _swap(2, 3),
    _swap(4, 5),
    _swap(5, 6),
    _constant(4),
    _constant(5),
    _coupled(3, 2, 1.0),
    _zero(2, 90),
    _zero(3, 10),
)
POSITIONS = (
    *JOINTS,
    *UNITS,
    *ROWS,
    _sign(2, 3, 4),
    _coupled(5, 4, -1.0),
    _copied(5, 4),
    _positions([[1, 0, 0], [0, -1, 0], [0, 0, 1]], "sign of y", r"mirrored|handed"),
    _positions([[0, 1, 0], [1, 0, 0], [0, 0, 1]], "x and y swapped", r"mirrored|handed|swapped"),
    Mistake("two reflectors, one name", _two_reflectors, r"targets|reflectors"),
    Mistake("the robot file of a UR10", unchanged, r"ur5", "ur10"),
)
POSES = (
    *(JOINTS[i] for i in (0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11, 13)),
    UNITS[1],
    UNITS[3],
    *ROWS,
    _sign(6),
    _constant(6),
    _coupled(6, 5, 1.0),
    _rotations(lambda R: Rotation.from_quat(np.roll(R.as_quat(), 1, 1)), "quaternion wxyz", r"qw|scalar"),
    _rotations(
        lambda R: Rotation.from_quat(R.as_quat() * [-1, -1, -1, 1]),
        "quaternion conjugated",
        r"invers|conjugat",
    ),
    _rotations(
        lambda R: Rotation.from_euler("ZYX", R.as_euler("XYZ")[:, ::-1]),
        "reversed Euler order",
        r"euler|order",
    ),
    _rotations(
        lambda R: Rotation.from_euler("ZYX", R.as_euler("ZYX")[:, ::-1]),
        "roll and yaw swapped",
        r"roll.*yaw|euler",
    ),
    _rotations(
        lambda R: Rotation.from_euler("ZYX", R.as_rotvec()[:, ::-1]),
        "rotation vector as angles",
        r"rotation vector",
    ),
    Mistake("left-handed frame", _mirrored_poses, r"mirrored|handed"),
    _positions([[1, 0, 0], [0, -1, 0], [0, 0, 1]], "sign of y, not of rotations", r"mirrored|handed"),
    _positions([[0, 1, 0], [0, 0, 1], [1, 0, 0]], "x, y, z permuted, not rotations", r"permut|order|frame"),
    Mistake("orientations shifted by one", _shifted(1, what="rotations"), r"shifted by one row|by 1 row"),
    Mistake("the robot file of a UR5", unchanged, r"ur10", "ur5"),
)
assert len(POSITIONS) == len(POSES) == 30
SETS = (("ur5", "ur5/grid.csv", 4, POSITIONS), ("ur10", "ur10/series_c_train.csv", 8, POSES))
"""Robot, file, stride of the rows that are used, and the mistakes."""


@dataclass(frozen=True)
class Answer:
    """Result of a calibration with a mistake.

    Attributes:
        status: 2 where it was refused, 3 where the result must not be trusted, else 0.
        text: error, or diagnostics and warnings.
        seconds: computing time [s].
    """

    status: int
    text: str
    seconds: float

    def names(self, mistake: Mistake) -> bool:
        """Whether the calibration was stopped, and the cause named."""
        return self.status in (2, 3) and re.search(mistake.words, self.text, re.IGNORECASE) is not None


def clean_rows(data: Path, robot: str, file: str, every: int) -> tuple[Robot, Measurements]:
    """Read every n-th row of a measured file."""
    nominal = Robot.load(robot)
    rows = Measurements.read_csv(data / file, nominal)
    return nominal, replace(rows.select(torch.arange(0, rows.rows, every)), temperature=None)


def answer(mistake: Mistake, nominal: Robot, clean: Measurements, folder: Path) -> Answer:
    """Write the file with a mistake, and calibrate with it like the command."""
    path, start = folder / "rows.csv", time.perf_counter()
    mistake.change(clean, nominal).write_csv(path, nominal)
    try:
        calibration = calibrate(
            mistake.robot or nominal, path, CalibrationSettings(model="geometric", folds=0)
        )
    except PisigmaError as refusal:
        return Answer(2, str(refusal), time.perf_counter() - start)
    text = " ".join([*(one.sentence for one in calibration.summary.diagnostics), *calibration.warnings])
    return Answer(0 if calibration.trusted else 3, text, time.perf_counter() - start)


def main(arguments: Sequence[str]) -> int:
    """Print the results of all mistakes, and return 0 where 5 of 6 are stopped with their cause."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=1, help="times as many rows")
    parser.add_argument("--only", default="", help="pattern of names")
    options = parser.parse_args(arguments)
    data = Path(os.environ.get("PISIGMA_DATA", Path(__file__).parents[3] / "shared" / "data"))
    named = count = 0
    with tempfile.TemporaryDirectory() as folder:
        for robot, file, every, mistakes in SETS:
            nominal, clean = clean_rows(data, robot, file, max(1, every // options.rows))
            for mistake in (Mistake("(clean)", unchanged, "^$"), *mistakes):
                if re.search(options.only, mistake.name):
                    got = answer(mistake, nominal, clean, Path(folder))
                    named, count = named + got.names(mistake), count + 1
                    good = (
                        "ok  "
                        if got.names(mistake) or (got.status == 0 and mistake.words == "^$")
                        else "MISS"
                    )
                    print(
                        f"{good} {got.status} {got.seconds:4.1f} s  {robot:4} {mistake.name}: {got.text[:400]}"
                    )
    print(f"{named} of {count} are stopped with their cause.")
    return 0 if 6 * named >= 5 * count else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
