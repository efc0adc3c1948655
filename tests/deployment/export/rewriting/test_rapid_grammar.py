"""RAPID modules are accepted by `rapidchecker`, a grammar of RAPID with rules of indentation written by others."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from testing.rewritten_programs import LANGUAGES, program

from pisigma.deployment.export.programs.languages import program_text
from pisigma.deployment.export.programs.targets import Targets
from pisigma.deployment.export.registry import export_model
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status

pytest.importorskip("rapidchecker", reason="rapidchecker is not installed (pip install rapidchecker)")


def rejected(*files: Path) -> set[str]:
    """Return the files in which it finds a fault."""
    wide = os.environ | {"COLUMNS": "1000"}
    command = [sys.executable, "-m", "rapidchecker", *map(str, files)]
    run = subprocess.run(command, env=wide, capture_output=True, text=True, check=False)
    assert run.returncode in (0, 1), run.stderr
    found = set(re.findall(r"(?m)^(\S+\.mod)$", run.stdout))
    assert bool(found) == run.returncode
    return found


@pytest.fixture(scope="module")
def modules(arm, tmp_path_factory) -> list[Path]:
    """Joint targets, poses and a rewritten program."""
    folder, robot = tmp_path_factory.mktemp("modules"), Robot.load("ur10")
    q = torch.linspace(-3, 3, 12, dtype=torch.float64).reshape(2, 6)
    reached = (Status.REACHED,) * 2
    T, none = forward_kinematics(robot, q), torch.full((2,), torch.nan, dtype=torch.float64)
    targets = Targets("cell_3", robot, "poses.csv", (2, 3), reached, ("only",) * 2, q, T, none)
    files = [folder / f"{name}.mod" for name in ("joints", "poses")]
    for file in files:
        file.write_text(program_text(targets, file, file.stem == "poses"), newline="")
    request = program(next(one for one in LANGUAGES if one.suffix == ".mod"), arm, folder)
    export_model("targets", request)
    return [*files, request.out]


FAULTS = (
    (r";(?=\s+ENDPROC)", ""),
    (r"ENDPROC", ""),
    (r"MODULE (\w+)", r"MODULE \1 \1"),
    (r"(Move\w*) \[", r"\1 [["),
    (r":=", "="),
)


def test_modules_are_accepted_and_their_faults_found(modules, tmp_path):
    text, broken = modules[1].read_text(), []
    for number, (pattern, other) in enumerate(FAULTS):
        broken.append(tmp_path / f"{number}.mod")
        broken[-1].write_text(re.sub(pattern, other, text, count=1))
        assert broken[-1].read_text() != text
    assert rejected(*modules, *broken) == {str(file) for file in broken}
