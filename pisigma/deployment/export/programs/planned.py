"""Planned poses as programs: stops at every pose until it is measured, and by way points where the way is blocked."""

from pathlib import Path

import torch

from pisigma import __version__
from pisigma.deployment.export.programs.languages import COUNTING, LANGUAGES, Program, check_program
from pisigma.planning.plan_file import StoredPlan

TEST = (
    "TEST IT AT LOW SPEED FIRST: the poses and the ways between them keep out of what the cell states. Nothing else "
    "was checked, nor was the way to the first pose."
)


def planned_program(plan: StoredPlan, path: Path) -> str:
    """The program that goes to all poses of a plan, and waits at each until it is measured.

    Args:
        plan: of a robot with six joints that turn.
        path: the file; its suffix is that of a language, its name is the program's.

    Raises:
        OutputError: the program cannot be written so.
    """
    robot = plan.arm.robot
    check_program(path, robot, False, None)
    language = LANGUAGES[path.suffix.lower()]
    q, labels, waits = [], [], []
    for order, pose, points in zip(plan.numbers, plan.q, plan.way_points, strict=True):
        q += [*points, pose]
        labels += ["way point"] * len(points) + [f"pose {order}"]
        waits += [0.0] * len(points) + [plan.settings.settling_s]
    title = f"{len(plan.q)} planned poses of robot {robot.name}, by pisigma {__version__}."
    heading = [title, TEST, COUNTING.format(robot=robot.name)]
    program = Program(
        language.program_name(path),
        robot,
        heading,
        robot.to_controller(torch.stack(q)),
        tuple(labels),
        tuple(waits),
    )
    return language.write(program)
