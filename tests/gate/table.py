"""Forty mistakes in the rows of a session, which every command that reads rows has to notice."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from testing.aged import original_model, rows_after_change
from testing.simulated_arm import dh_errors

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import poses_of_rows
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

Change = Callable[[Measurements], Measurements]
ROWS = 16
NO_MODEL = "so few rows show it only against a model, and this command has none"
ABSORBED = "a calibration fits base, tool and arm to these rows, which absorbs it"
FITTED = "base and tool are fitted to the rows"


@dataclass(frozen=True)
class Mistake:
    """One mistake.

    Attributes:
        name: description of the mistake.
        change: function that puts the mistake into right rows.
        kinds: kinds of diagnostics that may name it in checks against a model; "*" for any.
        unnoticed: commands that need not notice it, and why.
    """

    name: str
    change: Change
    kinds: tuple[str, ...] = ("setup_fault",)
    unnoticed: Mapping[str, str] = field(default_factory=dict)


def filtered_rows(seed: int = 2) -> Measurements:
    """Return rows without a mistake, of the model's robot."""
    return replace(rows_after_change(ROWS, seed), line=tuple(range(2, ROWS + 2)), source="rows.csv")


def joints(
    factor: Sequence[float] | float = 1.0, order: Sequence[int] | None = None, add: object = 0.0
) -> Change:
    def change(rows: Measurements) -> Measurements:
        q = rows.q if order is None else rows.q[:, list(order)]
        return replace(rows, q=q * torch.as_tensor(factor).double() + torch.as_tensor(add).double())

    return change


def sign(*reversed_joints: int) -> Change:
    return joints([-1.0 if joint in reversed_joints else 1.0 for joint in range(1, 7)])


def swap(first: int, second: int) -> Change:
    order = list(range(6))
    order[first - 1], order[second - 1] = second - 1, first - 1
    return joints(order=order)


def column(joint: int, values: Callable[[torch.Tensor], torch.Tensor]) -> Change:
    def change(rows: Measurements) -> Measurements:
        q = rows.q.clone()
        q[:, joint - 1] = values(rows.q)
        return replace(rows, q=q)

    return change


def positions(matrix: object) -> Change:
    def change(rows: Measurements) -> Measurements:
        assert rows.position is not None
        return replace(
            rows, position=rows.position @ (torch.as_tensor(matrix).double() * torch.eye(3).double()).mT
        )

    return change


def moved(by: tuple[float, float, float]) -> Change:
    def change(rows: Measurements) -> Measurements:
        assert rows.position is not None
        return replace(rows, position=rows.position + torch.tensor(by).double())

    return change


def permuted(order: Callable[[int], torch.Tensor]) -> Change:
    return lambda rows: replace(rows, q=rows.q[order(rows.rows)])


def of_other_arm(dh: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Replace positions by those of an arm with another geometry, in the model's frame and with its tool."""

    def change(rows: Measurements) -> Measurements:
        model = original_model()
        assert model.hybrid is not None
        arm = replace(model.hybrid, robot=model.hybrid.robot.with_geometry(dh=dh(model.hybrid.robot.dh)))
        return replace(rows, position=poses_of_rows(replace(model, hybrid=arm), rows)[:, :3, 3].clone())

    return change


def other_robot(name: str) -> Change:
    return lambda rows: replace(rows, position=forward_kinematics(Robot.load(name), rows.q)[:, :3, 3])


def in_some(chosen: Callable[[torch.Tensor], torch.Tensor], change: Change) -> Change:
    """Make a mistake in some of the rows."""

    def partly(rows: Measurements) -> Measurements:
        wrong, some = change(rows), chosen(torch.arange(rows.rows))[:, None]
        assert rows.position is not None
        assert wrong.position is not None
        return replace(
            rows,
            q=torch.where(some, wrong.q, rows.q),
            position=torch.where(some, wrong.position, rows.position),
        )

    return partly


def scattered(rows: Measurements) -> Measurements:
    """Displace positions by 20 mm in random directions."""
    assert rows.position is not None
    noise = torch.from_numpy(np.random.default_rng(3).normal(size=(rows.rows, 3)))
    return replace(rows, position=rows.position + 0.02 * noise / noise.norm(dim=1, keepdim=True))


def second_half(rows: torch.Tensor) -> torch.Tensor:
    return rows >= len(rows) // 2


def every_second(rows: torch.Tensor) -> torch.Tensor:
    return rows % 2 == 1


def some_third(rows: torch.Tensor) -> torch.Tensor:
    return torch.isin(rows, torch.tensor([1, 4, 5, 9, 12]))


SPECIMEN = of_other_arm(lambda dh: dh + dh_errors(Robot.load("rb5"), 2e-3, 4e-3, np.random.default_rng(7)))
MIXED = {"kinds": ("mixed_rows",), "unnoticed": {"calibrate": NO_MODEL}}
SCALED = {"kinds": ("scale",), "unnoticed": {"calibrate": ABSORBED}}

MISTAKES: tuple[Mistake, ...] = (
    Mistake("inches named mm", positions(1 / 25.4)),
    Mistake("metres named mm", positions(1e-3)),
    Mistake("mm named m", positions(1e3)),
    Mistake("feet named mm", positions(1 / 304.8), ("setup_fault", "scale")),
    Mistake("degrees named radians", joints(180 / math.pi)),
    Mistake("radians named degrees", joints(math.pi / 180)),
    Mistake("gradians named degrees", joints(10 / 9)),
    *(Mistake(f"sign of q{joint}", sign(joint)) for joint in (2, 3, 4, 5)),
    Mistake("signs of q2, q3 and q4", sign(2, 3, 4)),
    *(Mistake(f"q{first} and q{first + 1} swapped", swap(first, first + 1)) for first in (1, 2, 4, 5)),
    Mistake("q3 logged as q3 + q2", column(3, lambda q: q[:, 2] + q[:, 1])),
    Mistake("zeros of q2 and q3 off by 90 deg", joints(add=[0, math.pi / 2, math.pi / 2, 0, 0, 0])),
    Mistake("q4 logged constant", column(4, lambda q: q[:, 3].median().expand(len(q))), ("*",)),
    Mistake("q5 in the column of q4", column(4, lambda q: q[:, 4]), ("*",)),
    Mistake("sign of y", positions([[1, 0, 0], [0, -1, 0], [0, 0, 1]])),
    Mistake("x and y swapped", positions([[0, 1, 0], [1, 0, 0], [0, 0, 1]]), ("*",)),
    Mistake("rows shifted by one", permuted(lambda count: torch.arange(count).roll(1)), ("*",)),
    Mistake(
        "a row lost half-way",
        permuted(
            lambda count: (torch.arange(count) + (torch.arange(count) >= count // 2)).clamp(max=count - 1)
        ),
        ("*",),
    ),
    Mistake("rows in another order", permuted(lambda count: torch.arange(count).flip(0)), ("*",)),
    Mistake("tracker moved by 2 mm half-way", in_some(second_half, moved((0.002, 0.0, 0.0))), **MIXED),
    Mistake("every second row 2 mm off", in_some(every_second, moved((0.0, 0.002, 0.0))), **MIXED),
    Mistake("two robots, one after the other", in_some(second_half, SPECIMEN), **MIXED),
    Mistake("two robots, alternating", in_some(every_second, SPECIMEN), **MIXED),
    Mistake("half in inches", in_some(second_half, positions(1 / 25.4)), ("mixed_rows",)),
    Mistake("a third with another reflector", in_some(some_third, moved((0.0, 0.003, 0.004))), **MIXED),
    Mistake("half with the sign of q4", in_some(second_half, sign(4)), ("mixed_rows",)),
    Mistake(
        "half mirrored", in_some(every_second, positions([[1, 0, 0], [0, -1, 0], [0, 0, 1]])), ("mixed_rows",)
    ),
    Mistake("tracker carried by 100 mm half-way", in_some(second_half, moved((0.1, 0, 0))), ("mixed_rows",)),
    Mistake("a third scattered by 20 mm", in_some(some_third, scattered), ("mixed_rows",)),
    Mistake("lengths x 1.001", positions(1.001), **SCALED),
    Mistake("lengths x 0.999", positions(0.999), **SCALED),
    Mistake("lengths x 1.01", positions(1.01), **SCALED),
    Mistake("rows of a UR5", other_robot("ur5"), ("*",)),
    Mistake("rows of a UR10", other_robot("ur10"), ("*",)),
)
assert len(MISTAKES) == 40, len(MISTAKES)

MOVES: tuple[Mistake, ...] = (
    Mistake("base carried by 6 m", moved((6.0, 0.0, 0.0)), (), {"compare": FITTED}),
    Mistake("joint 3 zeroed again, 10 deg off", joints(add=[0, 0, math.radians(10), 0, 0, 0]), ()),
)
"""Movements that are not mistakes, of any size."""
