"""Small calibrated models for tests: hand-made, or trained once per test run."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import jaxtyping
import torch
from testing.stored import stored

from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.domain import Domain
from pisigma.model.inverse.solution import Solution
from pisigma.network.correction_network import CorrectionNetwork, JointGroup
from pisigma.network.inputs import Inputs
from pisigma.network.pi_sigma import PiSigma
from pisigma.robot import Robot
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status

HOMES = {
    "kiro3": (0.3, 1.2, -0.15, 0.2),
    "kiro4": (0.2, 0.5, 0.4, 0.3, 0.8, 0.2),
    "ur10": (0.3, -1.2, 1.4, -0.6, -1.2, 0.4),
}
"""Centre of the joint values of the hand-made models' rows [rad or m]."""

SPREAD = 0.25
"""Half the range of the rows around HOMES [rad]; a tenth of it [m] for prismatic joints."""


def joints_around(name: str, *batch: int, seed: int = 0, spread: float = SPREAD) -> torch.Tensor:
    """Draw joint values [rad or m], uniform around the home of a robot."""
    home = torch.tensor(HOMES[name], dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    drawn = 2 * torch.rand(*batch, len(home), generator=generator, dtype=torch.float64) - 1
    width = torch.tensor([spread if revolute else spread / 10 for revolute in Robot.load(name).revolute])
    return home + drawn * width


def hand_made_model(
    name: str, *, scale: float = 0.02, inputs: tuple[str, ...] | None = None, robot: Robot | None = None
) -> CalibratedModel:
    """Return a model with a smooth joint correction of about `scale` [rad or m], which is 0 at 0."""
    robot = robot or Robot.load(name)
    turning = [joint.name for joint in robot.joints if joint.type == "revolute"]
    names = inputs or tuple(f"{f}({joint})" for joint in turning for f in ("sin", "cos"))
    network = PiSigma(len(names), robot.dof, (1, 2))
    network.initialise(0.1, torch.Generator().manual_seed(1))
    network.output_scale.fill_(scale)
    network.output_offset.fill_(-3 * scale)
    group = JointGroup(tuple(range(robot.dof)), Inputs.from_names(robot, names))
    corrections = CorrectionNetwork(robot.dof, [group], [network]).requires_grad_(False)
    q = joints_around(name, 64)
    T = forward_kinematics(robot, q)
    solver = closed_form_solver(robot)
    branches: tuple[str, ...] = ()
    if solver is not None:
        distance = torch.sin((solver.solve(T).q - q[:, None]) / 2).square().sum(-1)
        index = set(distance.nan_to_num(math.inf).argmin(-1).tolist())
        assert len(index) == 1, "the rows of a hand-made model shall lie on one branch"
        branches = (solver.branches[index.pop()],)
    domain = Domain.from_rows(corrections.scaled_inputs(T, q), torch.Generator().manual_seed(0))
    return CalibratedModel(
        name=f"hand_made_{name}",
        kind="inverse_calibration",
        robot=robot,
        network=corrections,
        domain=domain,
        branches=branches,
        starts=q,
    )


def with_limits(robot: Robot, index: int, lower: float, upper: float) -> Robot:
    """Return the robot with other limits [rad or m] of one of its joints."""
    row = robot.joint_rows[index]
    limited = replace(robot.rows[row], lower=lower, upper=upper)
    return replace(robot, rows=(*robot.rows[:row], limited, *robot.rows[row + 1 :]))


REPOSITORY = Path(__file__).parents[2]


def small_recipe_text(name: str) -> str:
    """Return the shipped recipe of kiro3 or kiro4 with a shorter training, as YAML text."""
    text = (REPOSITORY / "training" / f"{name}.yaml").read_text(encoding="utf-8")
    lines = []
    for line in text.splitlines():
        key = line.strip().split(":")[0]
        indent = line[: len(line) - len(line.lstrip())]
        short = {"epochs": "40", "starts": "2"}.get(key)
        lines.append(
            f"{indent}{key}: {short}"
            if short and indent == "  "
            else line.replace("count: 2000", "count: 200")
        )
    return "\n".join(lines) + "\n"


@stored
def shipped_training(name: str, seed: int | None = None):
    """Train a complete shipped recipe with `pisigma.train`, with its seed or another one."""
    import pisigma
    from pisigma.workflow.recipes.reader import read_recipe

    recipe = read_recipe(Path(__file__).parents[2] / "training" / f"{name}.yaml")
    if seed is not None:
        recipe = recipe.model_copy(update={"fit": recipe.fit.model_copy(update={"seed": seed})})
    with no_type_checker():
        return pisigma.train(recipe)


@stored
def trained_run(name: str):
    """Return a shortened shipped recipe, and its training run."""
    from pisigma.files.errors import RecipeError
    from pisigma.files.yaml_file import parse_yaml
    from pisigma.workflow.recipes.data import load_data
    from pisigma.workflow.recipes.recipe import InverseRecipe
    from pisigma.workflow.train import train_networks

    recipe = parse_yaml(small_recipe_text(name), InverseRecipe, RecipeError, name)
    with no_type_checker():
        return recipe, train_networks(recipe, load_data(recipe))


@contextmanager
def no_type_checker() -> Iterator[None]:
    """Call pisigma without the type checker, like users do."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", before)


def poses_around(name: str, *batch: int, seed: int = 3) -> torch.Tensor:
    """Return poses of the nominal robot around its home."""
    return forward_kinematics(Robot.load(name), joints_around(name, *batch, seed=seed, spread=0.15))


def statuses(solution: Solution) -> list[Status]:
    """Return the statuses of solutions."""
    return [Status(value) for value in solution.status.reshape(-1).tolist()]
