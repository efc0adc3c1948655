"""In rewritten programs the real tool reaches the programmed poses, along straight lines too."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused
from testing.rewritten_programs import (
    LANGUAGES,
    TOLERANCE_MM,
    attained_poses,
    desired_poses,
    inline_points,
    program,
    scanned,
)

from pisigma.deployment.export.export_format import Exported, ExportRequest
from pisigma.deployment.export.registry import export_model
from pisigma.deployment.export.rewriting.scan import COMPUTED
from pisigma.deployment.export.targets import TEST
from pisigma.files.errors import OutputError
from pisigma.model.folder.model_folder import load_model


@pytest.mark.parametrize("language", LANGUAGES, ids=lambda language: language.suffix)
def test_the_real_tool_reaches_the_programmed_poses(language, arm, tmp_path):
    request = program(language, arm, tmp_path)
    exported = export_model("targets", request)
    wanted = desired_poses(load_model(arm).robot)
    before, after = scanned(request.program, request.frames), scanned(request.out, request.frames)
    names = [round(float(t.pose.T[0, 3]), 6) for t in before.targets]
    kept = 2 if language.suffix == ".ls" else 3  # P[3] is used with an offset too
    assert len(before.targets) == kept + 1
    assert exported.facts["statuses"] == {"reached": kept, "unreachable": 1}
    order = [min(range(4), key=lambda i: abs(float(wanted[i, 0, 3]) - x)) for x in names]
    assert sorted(order) == [0, 1, *([2] if kept == 3 else []), 3]
    commanded = {}
    for target in after.targets:
        nearest = min(range(4), key=lambda i: float((wanted[i] - target.pose.T)[:3, 3].norm()))
        if float((wanted[nearest] - target.pose.T)[:3, 3].norm()) < 4e-3:
            commanded[nearest] = target.pose.T
    for index in set(order) - {3}:
        assert float((commanded[index] - wanted[index])[:3, 3].norm()) > 1e-4
        real = attained_poses(arm, commanded[index][None], wanted[index][None])
        assert_close(real[0, :3, 3], wanted[index, :3, 3], atol=1e-8)
        assert_close(real[0, :3, :3], wanted[index, :3, :3], atol=1e-7)
    assert_close(commanded[3], wanted[3], atol=1e-8)  # it keeps its line
    line = next(
        i for i, text in enumerate(request.program.read_text().splitlines(), 1) if "9" in text and i > 5
    )
    assert line
    (unreached,) = exported.facts["unreached"]
    assert unreached["status"] == "unreachable"
    assert str(exported.missed_limit).startswith(f"{request.program}, line {unreached['line']}: unreachable")


@pytest.mark.parametrize("language", LANGUAGES, ids=lambda language: language.suffix)
def test_straight_moves_remain_straight(language, arm, tmp_path):
    """Between waypoints a controller moves on the line between commanded poses, and the real tool nearly so."""
    request = program(language, arm, tmp_path)
    exported = export_model("targets", request)
    after = scanned(request.out, request.frames)
    moves = [move for move in after.moves if move.start is not None]
    wanted = desired_poses(load_model(arm).robot)
    assert exported.facts["way_points"] >= 1
    ends = [float((move.end.pose.T - wanted[1])[:3, 3].norm()) < 4e-3 for move in moves]
    moves = moves[: ends.index(True) + 1]
    assert len(moves) > 1
    share = torch.linspace(0, 1, 9, dtype=torch.float64)[:, None, None]
    worst, line = 0.0, wanted[1, :3, 3] - wanted[0, :3, 3]
    for move in moves:
        T = move.start.pose.T + share * (move.end.pose.T - move.start.pose.T)
        u, _, v = torch.linalg.svd(T[:, :3, :3])
        T[:, :3, :3] = u @ v
        real = attained_poses(arm, T, T)[:, :3, 3] - wanted[0, :3, 3]
        off = real - (real @ line / (line @ line))[:, None] * line
        worst = max(worst, float(off.norm(dim=-1).max()) * 1e3)
    assert worst < 1.5 * TOLERANCE_MM


@pytest.mark.parametrize("language", LANGUAGES, ids=lambda language: language.suffix)
def test_other_text_is_unchanged_and_reported(language, arm, tmp_path):
    request = program(language, arm, tmp_path)
    exported = export_model("targets", request)
    text, old = request.out.read_text(), request.program.read_text()
    assert all(piece in text for piece in language.kept)
    removed = [
        line[1:] for line in exported.facts["diff"].splitlines() if line.startswith("-") and line[:3] != "---"
    ]
    unnumbered = [re.sub(r"^:", "", line) for line in removed]
    assert all(any(line.endswith(rest) for line in old.splitlines()) for rest in unnumbered)
    reasons = {entry["line"]: entry["reason"] for entry in exported.facts["left_alone"]}
    computed = next(
        i for i, line in enumerate(old.splitlines(), 1) if re.search(r"pose_add|LIN_REL|Offs\(|PR\[1\]", line)
    )
    assert reasons[computed] == COMPUTED or "bench_2" in reasons[computed]
    assert exported.facts["joint_lines"]
    assert exported.facts["largest_shift_mm"] > 0.1
    assert TEST in exported.warnings
    (branch,) = exported.facts["branches"]
    assert any(f" {branch}." in sentence for sentence in exported.warnings)
    if language.suffix == ".ls":
        lines = re.findall(r"(?m)^ *(\d+):", text)
        assert lines == [str(i) for i in range(1, len(lines) + 1)]
        assert f"LINE_COUNT = {len(lines)};" in text
        assert reasons[13].startswith("Offset ")


@pytest.mark.parametrize("language", LANGUAGES, ids=lambda language: language.suffix)
def test_targets_in_unknown_frames_are_unchanged(language, arm, tmp_path):
    request = program(language, arm, tmp_path)
    pattern = r"(?m)^.*(set_tcp|\$BASE|tooldata).*\n"
    request.program.write_text(re.sub(pattern, "", request.program.read_text(), count=1), newline="")
    with refused(OutputError, file=str(request.program)):
        export_model("targets", replace(request, frames=None))
    assert not request.out.exists()


def test_a_move_after_a_branch_of_the_program_has_no_known_start(arm, tmp_path):
    request = program(LANGUAGES[0], arm, tmp_path)
    text = request.program.read_text().replace("  set_digital_out(1, True)\n", "  if x > 1:\n  end\n")
    request.program.write_text(text)
    exported = export_model("targets", request)
    reasons = [entry["reason"] for entry in exported.facts["left_alone"]]
    assert sum(reason.startswith("the start of the straight move") for reason in reasons) == 1


def test_a_pose_of_several_tools_is_unchanged(arm, tmp_path):
    request = program(LANGUAGES[0], arm, tmp_path)
    other = "end\n".join(request.program.read_text().rsplit("end\n", 1)).replace(
        "  movel(pose_add",
        "  set_tcp(p[0, 0, 0, 0, 0, 0])\n  movel(pose_trans(bench, over))\n  movel(pose_add",
    )
    request.program.write_text(other)
    exported = export_model("targets", request)
    assert any("several frames or tools" in entry["reason"] for entry in exported.facts["left_alone"])
    assert exported.facts["targets"] == 3


@pytest.mark.parametrize(
    ("options", "fields"),
    [
        ({"program": Path("cell.txt")}, {"option": "--program", "file": "cell.txt"}),
        ({"out": Path("new.src")}, {"option": "--out", "value": ".script and .src"}),
        ({"targets": "joints"}, {"option": "--targets", "value": "joints"}),
        ({"tolerance_mm": 0.0}, {"option": "--tolerance-mm", "value": 0.0}),
        ({"poses": Path("poses.csv")}, {"option": "--poses", "remedy": "give only one of them"}),
        ({"program": None}, {"option": "--poses", "remedy": "give --poses, or a --program with poses"}),
        ({"program": None, "poses": Path("x.csv")}, {"option": "--tolerance-mm"}),
    ],
)
def test_invalid_options_are_refused(options, fields, arm, tmp_path):
    request = replace(program(LANGUAGES[0], arm, tmp_path), **options)
    with refused(OutputError, **fields):
        export_model("targets", request)


def test_a_missing_program_is_refused(arm, tmp_path):
    request = replace(program(LANGUAGES[0], arm, tmp_path), program=Path("none.script"))
    with pytest.raises(OutputError, match=r"none\.script"):
        export_model("targets", request)


def test_the_facts_are_plain_values(arm, tmp_path):
    exported = export_model("targets", program(LANGUAGES[0], arm, tmp_path))
    assert isinstance(exported, Exported)
    assert json.loads(json.dumps(dict(exported.facts)))["unreached"] == [
        {"line": 11, "status": "unreachable"}
    ]


@pytest.mark.parametrize("language", LANGUAGES, ids=lambda language: language.suffix)
def test_line_endings_are_kept(language, arm, tmp_path):
    request = program(language, arm, tmp_path)
    export_model("targets", request)
    plain = request.out.read_bytes()
    request.program.write_bytes(request.program.read_bytes().replace(b"\n", b"\r\n"))
    export_model("targets", request)
    assert request.out.read_bytes() == plain.replace(b"\n", b"\r\n")


def test_points_of_inline_forms(arm, tmp_path):
    """Their frames are numbers; points with a fixed tool or without frames are left unchanged."""
    T = desired_poses(load_model(arm).robot)
    request = inline_points(arm, tmp_path)
    exported = export_model("targets", request)
    (target,) = scanned(request.out, request.frames).targets
    real = attained_poses(arm, target.pose.T[None], T[:1])
    assert_close(real[0, :3, 3], T[0, :3, 3], atol=1e-8)
    assert [entry["line"] for entry in exported.facts["left_alone"]] == [4, 6]
    assert request.out.read_text().splitlines()[2:] == request.program.read_text().splitlines()[2:]
    with refused(OutputError, option="--out", value=".dat"):
        export_model("targets", ExportRequest(arm, request.out, poses=tmp_path / "poses.csv"))
