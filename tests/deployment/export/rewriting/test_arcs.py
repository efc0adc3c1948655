"""Circular moves of rewritten programs: arcs that are split, and those that are left unchanged."""

import math

import pytest
import torch
from testing.arc_programs import ARC_PROGRAMS, arc_poses, arc_request
from testing.closeness import assert_close
from testing.rewritten_programs import TOLERANCE_MM, TOOL, attained_poses, scanned

from pisigma.deployment.export.registry import export_model
from pisigma.deployment.export.rewriting.correction import (
    COLLINEAR,
    OTHER_ORIENTATION,
    CircularArcs,
    is_straight,
)
from pisigma.deployment.export.rewriting.krl import STATED_ARC


def _reasons(exported):
    return [entry["reason"] for entry in exported.facts["left_alone"]]


@pytest.mark.parametrize("suffix", ARC_PROGRAMS)
def test_the_real_tool_remains_on_the_arc(suffix, arm, tmp_path):
    """A controller moves on arcs through the commanded poses, and the real tool on the intended arc."""
    T = arc_poses(arm)
    request = arc_request(suffix, ARC_PROGRAMS[suffix].text, T, arm, tmp_path)
    exported = export_model("targets", request)
    moves = [move for move in scanned(request.out, request.frames).moves if move.circular]
    assert len(moves) > 1
    assert exported.facts["way_points"] == 2 * len(moves) - 1
    assert _reasons(exported)[1:] == []
    meant, worst = CircularArcs.through_points(*T[:, None, :3, 3]), 0.0
    for move in moves:
        ends = (target.pose.T[None, :3, 3] for target in (move.start, move.via, move.end))
        commanded = move.start.pose.T.repeat(9, 1, 1)
        commanded[:, :3, 3] = CircularArcs.through_points(*ends).sample(8)[0]
        real = attained_poses(arm, commanded, commanded)[:, :3, 3] - meant.centre
        height = (real * meant.axis).sum(-1)
        off = torch.hypot(
            height, (real - height[:, None] * meant.axis).norm(dim=-1) - meant.radius_vector.norm()
        )
        worst = max(worst, float(off.max()) * 1e3)
    assert worst < 1.5 * TOLERANCE_MM
    last = attained_poses(arm, moves[-1].end.pose.T[None], T[2:])
    assert_close(last[0, :3, 3], T[2, :3, 3], atol=1e-8)


@pytest.mark.parametrize("suffix", ARC_PROGRAMS)
def test_an_arc_with_another_orientation_is_not_split(suffix, arm, tmp_path):
    text = ARC_PROGRAMS[suffix].text.replace(*ARC_PROGRAMS[suffix].turning)
    exported = export_model("targets", arc_request(suffix, text, arc_poses(arm), arm, tmp_path))
    assert exported.facts["way_points"] == 0
    assert exported.facts["statuses"] == {"reached": 3}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda T: T[1, :3, :3].copy_(T[1, :3, :3] @ TOOL[:3, :3]), OTHER_ORIENTATION),
        (lambda T: T[1, :3, 3].copy_((T[0, :3, 3] + T[2, :3, 3]) / 2), COLLINEAR),
    ],
)
def test_ambiguous_arcs_are_reported(change, reason, arm, tmp_path):
    T = arc_poses(arm)
    change(T)
    exported = export_model("targets", arc_request(".src", ARC_PROGRAMS[".src"].text, T, arm, tmp_path))
    assert reason in _reasons(exported)
    assert exported.facts["way_points"] == 0


def test_an_arc_after_a_move_to_joint_values_is_reported(arm, tmp_path):
    text = ARC_PROGRAMS[".src"].text.replace("CIRC", "PTP {{A1 0, A2 -90, A3 90, A4 0, A5 0, A6 0}}\nCIRC")
    exported = export_model("targets", arc_request(".src", text, arc_poses(arm), arm, tmp_path))
    assert any(why.startswith("the start or via point of the arc") for why in _reasons(exported))


def test_an_arc_beyond_its_end_point_is_reported(arm, tmp_path):
    text = ARC_PROGRAMS[".src"].text.replace("{P2} ;", "{P2}, CA 200 ;")
    exported = export_model("targets", arc_request(".src", text, arc_poses(arm), arm, tmp_path))
    assert STATED_ARC in _reasons(exported)
    assert exported.facts["way_points"] == 0


def test_arcs_pass_through_their_points():
    angles = torch.tensor([[0.3, 1.0, 2.0], [0.3, 5.0, 6.0]], dtype=torch.float64)
    circle = torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], -1) * 0.2
    arcs = CircularArcs.through_points(*circle.unbind(1))
    assert_close(arcs.angle, angles[:, 2] - angles[:, 0], atol=1e-12)
    assert_close(arcs.via_angle, angles[:, 1] - angles[:, 0], atol=1e-12)
    assert_close(arcs.sample(4)[:, [0, -1]], circle[:, [0, 2]], atol=1e-12)
    assert_close(arcs.sample(4).norm(dim=-1), 0.2, atol=1e-12)
    back = CircularArcs.through_points(*circle.flip(1).unbind(1))
    assert_close(back.angle, arcs.angle, atol=1e-12)
    assert float(arcs.angle[1]) > math.pi
    assert not is_straight(*circle.unbind(1))
    assert is_straight(circle[:, 0], circle[:, 0], circle[:, 2])
