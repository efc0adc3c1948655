"""Programs of targets comply with the grammars, and have the targets in every controller's convention."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from lark.exceptions import LarkError
from scipy.spatial.transform import Rotation
from testing.closeness import assert_close
from testing.program_readers import READERS, Program
from testing.refusals import refused

from pisigma.deployment.export.programs.languages import COUNTING, FANUC, TEST, URSCRIPT, program_text
from pisigma.deployment.export.programs.targets import Targets
from pisigma.files.errors import OutputError, UnreachablePoseError
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status

LANGUAGES = tuple(READERS)
CONFIG = "N U T, 0, 0, 0"
BASE = np.array([0.4, -0.2, 0.1, 0.3, -0.5, 2.9])
TOOL = np.array([0.01, -0.02, 0.15, -1.2, 0.7, 0.4])


def targets_at(q: torch.Tensor, T: torch.Tensor | None = None, name: str = "rb5", **others) -> Targets:
    """Targets of a catalogue robot with a base and a tool."""
    robot = Robot.load(name).with_geometry(base=BASE, tool=TOOL)
    plain = Targets(
        model="cell_3",
        robot=robot,
        source="poses.csv",
        line=tuple(range(2, 2 + len(q))),
        status=(Status.REACHED,) * len(q),
        branch=("only",) * len(q),
        q=q,
        T_nominal=forward_kinematics(robot, q) if T is None else T,
        sigma=torch.full((len(q),), 1e-5, dtype=torch.float64),
    )
    return replace(plain, **others)


def some_joints(rows: int, spread: float = 3.1) -> torch.Tensor:
    drawn = torch.rand(rows, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return (2 * drawn - 1) * spread


def read(targets: Targets, suffix: str, cartesian: bool = False, name: str = "cell") -> Program:
    config = CONFIG if cartesian and suffix == ".ls" else None
    return READERS[suffix](program_text(targets, Path(f"{name}{suffix}"), cartesian, config))


def transforms(values: list[list[float]], suffix: str) -> np.ndarray:
    """Convert poses of a language to matrices [m], with scipy's conventions."""
    array = np.array(values)
    rotation = {
        ".script": lambda v: Rotation.from_rotvec(v),
        ".src": lambda v: Rotation.from_euler("ZYX", v, degrees=True),  # A, B, C about moving axes
        ".mod": lambda v: Rotation.from_quat(v[:, [1, 2, 3, 0]]),  # scipy has w last
        ".ls": lambda v: Rotation.from_euler("xyz", v, degrees=True),  # W, P, R about fixed axes
    }[suffix](array[:, 3:])
    T = np.tile(np.eye(4), (len(array), 1, 1))
    T[:, :3, 3] = array[:, :3] * (1.0 if suffix == ".script" else 1e-3)
    T[:, :3, :3] = rotation.as_matrix()
    return T


def in_radians(values: list[list[float]], suffix: str) -> torch.Tensor:
    joints = torch.tensor(values, dtype=torch.float64)
    return joints if suffix == ".script" else torch.deg2rad(joints)


@pytest.mark.parametrize("rows", [1, 200])
@pytest.mark.parametrize("suffix", LANGUAGES)
def test_joint_targets_are_read_back(suffix, rows):
    targets = targets_at(some_joints(rows))
    program = read(targets, suffix)
    assert program.name == ("CELL" if suffix == ".ls" else "cell")
    assert program.poses == []
    q = in_radians(program.joints, suffix)
    assert_close(torch.rad2deg(q), torch.rad2deg(targets.q), atol=5.1e-7)
    moved = forward_kinematics(targets.robot, q) - targets.T_nominal
    assert float(moved[:, :3, 3].norm(dim=-1).max()) < 1e-6


@pytest.mark.parametrize("rows", [1, 200])
@pytest.mark.parametrize("suffix", LANGUAGES)
def test_cartesian_targets_are_read_back(suffix, rows):
    """The controller's frame, pose and tool determine the same flange pose as the joint values."""
    targets = targets_at(some_joints(rows))
    program = read(targets, suffix, cartesian=True)
    T = transforms(program.poses, suffix)
    assert_close(T[:, :3, 3], targets.T_nominal[:, :3, 3], atol=1e-9)
    assert_close(T[:, :3, :3], targets.T_nominal[:, :3, :3], atol=3e-8)
    (T_root_poses,) = transforms([program.frame], suffix)
    (T_flange_tool,) = transforms([program.tool], suffix)
    bare = targets.robot.with_geometry(base=np.zeros(6), tool=np.zeros(6))
    T_root_flange = T_root_poses @ T @ np.linalg.inv(T_flange_tool)
    assert_close(T_root_flange, forward_kinematics(bare, targets.q), atol=2e-7)
    if suffix == ".script":
        assert_close(program.near, targets.q, atol=1e-9)
    elif suffix == ".ls":
        assert program.config == {CONFIG}
    else:
        assert_close(in_radians(program.joints, suffix), targets.q[:1], atol=1e-8)


@pytest.mark.parametrize("suffix", LANGUAGES)
def test_orientations_at_singularities_of_conventions(suffix):
    """No rotation, half turns about all axes and between them, and a pitch at and near a quarter turn."""
    half = Rotation.from_rotvec(
        np.pi * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.8, 0], [0.6, 0, -0.8], [0, -0.6, 0.8]])
    )
    pitches = [
        [0.3, sign * (np.pi / 2 - off), -0.8]
        for sign in (1, -1)
        for off in (0, 1e-13, 1e-11, 1e-9, 1e-7, 1e-4)
    ]
    tiny = Rotation.from_rotvec([[0, 0, 0], [1e-12, 0, 0], [0, -1e-7, 1e-7], [0, 0, np.pi - 1e-7]])
    R = np.concatenate([half.as_matrix(), Rotation.from_euler("ZYX", pitches).as_matrix(), tiny.as_matrix()])
    T = torch.eye(4, dtype=torch.float64).repeat(len(R), 1, 1)
    T[:, :3, :3] = torch.from_numpy(R)
    targets = targets_at(some_joints(len(R)), T)
    found = transforms(read(targets, suffix, cartesian=True).poses, suffix)
    assert_close(found[:, :3, :3], R, atol=3e-8)


@pytest.mark.parametrize("suffix", LANGUAGES)
def test_zeros_and_very_small_numbers_have_neither_sign_nor_exponent(suffix):
    small = torch.tensor([[-0.0, 1e-13, -1e-13, -1e-300, 0.0, 3e-5]], dtype=torch.float64)
    T = torch.eye(4, dtype=torch.float64)[None].clone()
    T[0, :3, 3] = torch.tensor([-0.0, -1e-14, 1e-12])
    for cartesian in (False, True):
        program = read(targets_at(small, T), suffix, cartesian)
        for values in (*program.joints, *program.poses):
            assert not np.signbit(values).any()
        assert program.joints or program.poses


@pytest.mark.parametrize("suffix", LANGUAGES)
def test_every_program_states_its_requirements(suffix):
    targets = targets_at(some_joints(3), remarks=("The base is that of the frame 'wall'.",))
    for cartesian in (False, True):
        program = read(targets, suffix, cartesian)
        said = " ".join(program.remarks)
        for sentence in (targets.title, TEST, COUNTING.format(robot="rb5")):
            assert sentence.replace(";", ",") in said.replace(";", ",")
        assert "The base is that of the frame 'wall'." in said
        assert [remark for remark in program.remarks if remark.startswith("line ")] == [
            "line 2", "line 3", "line 4"
        ]  # fmt: skip
        assert (FANUC.cautions[0].replace(";", ",") in said) == (suffix == ".ls")
        note = URSCRIPT.cartesian_cautions[0]
        assert (note in said) == (suffix == ".script" and cartesian)


def test_programs_are_slow():
    speeds = {suffix: read(targets_at(some_joints(1)), suffix).speeds for suffix in LANGUAGES}
    assert speeds[".script"] == {"speed": 0.1, "acceleration": 0.2}
    assert speeds[".src"] == {"SPEED": 5, "$VEL_AXIS": "SPEED", "$ACC_AXIS": "SPEED"}
    assert speeds[".mod"] == {"slow": [50, 10, 50, 10]}
    assert speeds[".ls"] == {"percent": {5}}


@pytest.mark.parametrize("suffix", LANGUAGES)
def test_hostile_names_of_models_stay_in_their_comments(suffix):
    hostile = 'a";\nEND\r\n;}]) "\'` Zelle-ü \x00\t\u2028 %s {0} ' + "x" * 300
    targets = targets_at(some_joints(2), model=hostile)
    for cartesian in (False, True):
        program = read(targets, suffix, cartesian)
        assert len(program.joints) + len(program.poses) >= 2
        text = "".join(program.remarks)
        assert "x" * 20 in text
        assert text.isascii()


@pytest.mark.parametrize("suffix", LANGUAGES)
def test_targets_outside_the_domain_are_marked(suffix):
    status = (Status.REACHED, Status.OUTSIDE_DOMAIN)
    program = read(targets_at(some_joints(2), status=status), suffix)
    assert "line 3 OUTSIDE DOMAIN" in program.remarks
    assert "1 of 2 poses, line 3: outside_domain." in " ".join(program.remarks)
    assert len(program.joints) == 2


@pytest.mark.parametrize("suffix", LANGUAGES)
@pytest.mark.parametrize(
    "status", [status for status in Status if status not in (Status.REACHED, Status.OUTSIDE_DOMAIN)]
)
def test_a_missing_target_is_refused(suffix, status):
    targets = targets_at(some_joints(3), status=(Status.REACHED, status, status))
    with pytest.raises(UnreachablePoseError) as refused:
        program_text(targets, Path(f"cell{suffix}"), cartesian=False)
    name = status.name.lower()
    assert str(refused.value).startswith(
        f"poses.csv, line 3: {name}. {status.sentence} (Also: line 4 {name}.)"
    )


def test_many_failures_are_counted():
    targets = targets_at(some_joints(14), status=(Status.UNREACHABLE,) * 14)
    assert "line 12 unreachable; and 3 more.)" in str(targets.failure_sentence)


@pytest.mark.parametrize(
    ("name", "suggested"),
    [
        ("9 bad-name.ls", "P_9_BAD_NAME.ls"),
        ("9 bad-name.src", "P_9_bad_name.src"),
        ("café.script", "caf.script"),
        ("ptp.src", "P_ptp.src"),
        ("EndProc.mod", "P_EndProc.mod"),
        ("movej.script", "P_movej.script"),
        ("nul.ls", "P_NUL.ls"),
        ("...mod", "P.mod"),
        ("_a.mod", "a.mod"),
        (f"{'a' * 25}.src", f"{'a' * 24}.src"),
        (f"{'a' * 28}.mod", f"{'a' * 27}.mod"),
        (f"{'a' * 37}.ls", f"{'A' * 36}.ls"),
    ],
)
def test_invalid_program_names_are_refused(name, suggested):
    targets = targets_at(some_joints(1))
    with pytest.raises(OutputError) as caught:
        program_text(targets, Path(name), cartesian=False)
    assert (caught.value.file, caught.value.option) == (name, "--out")
    assert str(caught.value).endswith(f"such as {suggested}.")
    suffix = Path(suggested).suffix
    assert READERS[suffix](program_text(targets, Path(suggested), False)).name == Path(suggested).stem


@pytest.mark.parametrize("suffix", LANGUAGES)
@pytest.mark.parametrize("robot", ["kiro3", "panda"])
def test_other_arms_have_no_programs(suffix, robot):
    q = torch.zeros(1, Robot.load(robot).dof, dtype=torch.float64)
    with refused(OutputError, value=robot, expected="six revolute joints"):
        program_text(targets_at(q, name=robot), Path(f"a{suffix}"), cartesian=False)


@pytest.mark.parametrize("suffix", [".src", ".mod", ".ls"])
def test_poses_on_several_branches(suffix):
    targets = targets_at(some_joints(3), branch=("up", "up", "down"))
    config = CONFIG if suffix == ".ls" else None
    with refused(OutputError, file="poses.csv", line=4, value="down"):
        program_text(targets, Path(f"a{suffix}"), True, config)
    assert len(read(targets, suffix).joints) == 3
    assert len(read(targets, ".script", cartesian=True).poses) == 3


def test_targets_with_several_numbers_of_turns_are_refused():
    q = some_joints(2)
    q[1, 5] += 2 * np.pi
    with refused(OutputError, file="poses.csv", line=3, option="--config"):
        program_text(targets_at(q), Path("a.ls"), True, CONFIG)
    assert_close(in_radians(read(targets_at(q), ".ls").joints, ".ls"), q, atol=1e-8)


@pytest.mark.parametrize("config", ["", "N U T", "NUT, 0, 0, 0", "N U T, 0, 0, 0\n", "N U T, 0, 0, 0';"])
def test_invalid_configurations_are_refused(config):
    with refused(OutputError, option="--config", value=config):
        program_text(targets_at(some_joints(1)), Path("a.ls"), True, config)


@pytest.mark.parametrize("suffix", LANGUAGES)
@pytest.mark.parametrize(
    ("pattern", "other"),
    [
        (r"(\d)\.(\d{6})\d*", r"\1.\2e-05"),
        (r"(\d)\.(\d{6})", r"\1,\2"),
        (r"(?m)^.*\b(end|END|ENDMODULE)\b.*$", ""),
        (r"line 2", "line \N{LATIN SMALL LETTER U WITH DIAERESIS}"),
        (r"\n", "\n\n"),
        (r"(\d\.\d{6}\d*(?: deg)?),", r"\1"),
        (r"\r?\n", lambda match: "\n" if match.group().startswith("\r") else "\r\n"),
    ],
)
def test_the_grammars_refuse_invalid_programs(suffix, pattern, other):
    text = program_text(targets_at(some_joints(2)), Path(f"cell{suffix}"), cartesian=False)
    broken = re.sub(pattern, other, text)
    assert broken != text
    with pytest.raises((LarkError, AssertionError)):
        READERS[suffix](broken)


def test_a_program_with_too_many_lines_is_refused():
    with refused(OutputError, expected="at most 9999 lines"):
        program_text(targets_at(some_joints(5000)), Path("a.ls"), False)
