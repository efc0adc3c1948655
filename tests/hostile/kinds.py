"""All kinds of hostile inputs, and how often each is drawn."""

from pathlib import Path

import numpy as np
from hostile.case import Case, Generator
from hostile.clean import Clean
from hostile.documents import robot_file_case, wrong_recipe, wrong_robot
from hostile.exports import wrong_export
from hostile.folders import wrong_model
from hostile.healthy import healthy_robot, measured_robot
from hostile.options import wrong_calibrate, wrong_ik, wrong_judging
from hostile.plans import wrong_plan
from hostile.tables import another_robot, damaged_measurements, wrong_measurements, wrong_poses
from hostile.urdfs import wrong_urdf

KINDS: dict[str, tuple[Generator, int]] = {
    "healthy robots": (healthy_robot, 1),
    "clean measurements": (measured_robot, 1),
    "damaged measurements": (damaged_measurements, 14),
    "wrong measurements": (wrong_measurements, 2),
    "another robot": (another_robot, 2),
    "poses": (wrong_poses, 20),
    "robots": (wrong_robot, 7),
    "robot files": (robot_file_case, 3),
    "urdfs": (wrong_urdf, 32),
    "recipes": (wrong_recipe, 26),
    "models": (wrong_model, 5),
    "options of calibrate": (wrong_calibrate, 12),
    "options of ik": (wrong_ik, 16),
    "options of others": (wrong_judging, 14),
    "exports": (wrong_export, 20),
    "plans": (wrong_plan, 1),
}
"""Generator and share of every kind: most inputs are of kinds that are fast to read or to refuse."""


def make(kind: str, seed: int, number: int, clean: Clean, folder: Path) -> Case:
    """Write the hostile input of a kind, a seed and a number into an empty folder, reproducibly."""
    rng = np.random.default_rng([list(KINDS).index(kind), seed, number])
    return KINDS[kind][0](rng, clean, folder)


def shares(count: int, kinds: tuple[str, ...] = tuple(KINDS)) -> dict[str, int]:
    """Return how many inputs of every kind add up to `count`, at least one of each."""
    whole = sum(KINDS[kind][1] for kind in kinds)
    return {kind: max(1, -(-count * KINDS[kind][1] // whole)) for kind in kinds}
