"""A distilled model approximates the full solution in its region, and reports its error."""

import functools
import math
import re
from dataclasses import replace

import pytest
import torch
from testing.closeness import assert_close
from testing.identified import geometric_model, hybrid_model
from testing.models import HOMES, hand_made_model, no_type_checker
from testing.refusals import refused

import pisigma
from pisigma.files.errors import IdentificationError, ModelError
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status
from pisigma.validation.held_out.distillation_summary import DistillationSummary
from pisigma.workflow.distill import distill
from pisigma.workflow.distilled_network import NetworkSize, sizes_for
from pisigma.workflow.settings.distillation import DistillationSettings
from pisigma.workflow.solved_poses import Region, draw_between, draw_solved_poses

pytestmark = pytest.mark.usefixtures("without_type_checker")

HOME = torch.tensor(HOMES["kiro3"], dtype=torch.float64)
BOX = tuple(
    float(value) + side
    for value, width in zip(
        forward_kinematics(Robot.load("kiro3"), HOME)[:3, 3], (0.04, 0.04, 0.01), strict=True
    )
    for side in (-width, width)
)
"""A box around the home position of kiro3 [m]."""


@pytest.fixture(scope="module")
def without_type_checker():
    with no_type_checker():
        yield


def rippled(name: str) -> CalibratedModel:
    """A model with a series for every revolute joint; a prismatic joint has no overtones."""
    robot = Robot.load(name)
    model = hybrid_model(name, [FourierSeries(robot, 24), GravityTorques(robot)])
    model.hybrid.correction.linear[0][~torch.tensor(robot.revolute)] = 0.0
    return model


@functools.cache
def distilled(kind: str, name: str, size: NetworkSize | None, poses: int = 600):
    parent = geometric_model(name) if kind == "geometric" else rippled(name)
    return distill(parent, DistillationSettings(poses=poses, size=size, epochs=30))


def tool_errors(found, q: torch.Tensor) -> torch.Tensor:
    """Return the distances of the tool from the requested positions [m]."""
    return (found.parent.forward(q)[:, :3, 3] - found.held_out.T[:, :3, 3]).norm(dim=-1)


@pytest.mark.parametrize(
    ("kind", "name", "share"),
    [
        ("geometric", "kiro3", 0.01),
        ("geometric", "kiro4", 0.05),
        ("geometric", "ur10", 0.05),
        ("hybrid", "kiro3", 0.2),
    ],
)
def test_the_tool_is_close_to_the_full_solution(kind, name, share):
    """On held-out poses, for every kind of arm, relative to the nominal robot's error."""
    found = distilled(kind, name, NetworkSize((1, 2, 3)))
    poses = found.held_out
    assert_close(tool_errors(found, poses.q_nominal + poses.correction), 0.0, atol=1e-9)
    nominal = tool_errors(found, poses.q_nominal).square().mean().sqrt()
    rms = tool_errors(found, poses.q_nominal + found.predicted_corrections).square().mean().sqrt()
    assert float(nominal) > 4e-4
    assert float(rms) < share * float(nominal)


def test_overtones_follow_what_sines_and_cosines_cannot():
    plain, rich = (distilled("hybrid", "kiro3", NetworkSize((1, 2), harmonics)) for harmonics in (1, 24))
    errors = [
        float(tool_errors(f, f.held_out.q_nominal + f.predicted_corrections).square().mean().sqrt())
        for f in (plain, rich)
    ]
    assert errors[1] < 0.3 * errors[0]


def test_poses_are_those_of_the_nominal_joint_values():
    poses = distilled("geometric", "ur10", NetworkSize((1, 2, 3))).held_out
    robot = Robot.load("ur10")
    assert_close(forward_kinematics(robot, poses.q_nominal), poses.T, atol=1e-9)
    assert len(poses.T) == 240
    assert set(poses.status.tolist()) <= {Status.REACHED, Status.OUTSIDE_DOMAIN}


@pytest.mark.parametrize("size", [NetworkSize((1, 2, 3)), NetworkSize((1, 2), 24)])
def test_a_folder_gives_the_same_corrections(size, tmp_path):
    found = distilled("hybrid", "kiro3", size)
    found.save(tmp_path)
    ik = pisigma.load(tmp_path)
    poses = found.held_out
    solution = ik(poses.T)
    assert ik.model.kind == "distilled"
    assert_close(solution.q_nominal, poses.q_nominal, atol=1e-9)
    assert_close(solution.q, poses.q_nominal + found.predicted_corrections, atol=1e-9)
    assert float((solution.status == Status.REACHED).double().mean()) > 0.95
    if size.harmonics > 1:
        arrays = ik(poses.T.numpy())
        assert_close(arrays.q, solution.q, atol=1e-9)
        assert_close(arrays.status, solution.status)


@pytest.mark.parametrize("size", [NetworkSize((1, 2, 3)), NetworkSize((1, 2), 24)])
def test_poses_away_from_the_region_are_outside_the_domain(size):
    """Overtones, which are similar everywhere, do not hide that a joint is outside."""
    found = distilled("hybrid", "kiro3", size)
    robot, q = found.model.robot, found.held_out.q_nominal.clone()
    q[:, 0] += 1.5
    scaled = found.model.network.scaled_inputs(forward_kinematics(robot, q), q)
    assert not found.model.domain.contains(scaled).any()


def test_a_region_of_positions_holds_all_poses():
    parent = geometric_model("kiro3")
    region = Region(parent.starts, BOX)
    found = distill(parent, DistillationSettings(region, 300, NetworkSize((1, 2)), epochs=20))
    place = found.held_out.T[:, :3, 3]
    for axis in range(3):
        assert float(place[:, axis].min()) >= BOX[2 * axis]
        assert float(place[:, axis].max()) <= BOX[2 * axis + 1]
    assert float(tool_errors(found, found.held_out.q_nominal + found.predicted_corrections).max()) < 2e-4


def test_a_given_seed_gives_the_same_model():
    settings = DistillationSettings(poses=200, size=NetworkSize((1, 2)), seed=4, epochs=5)
    first, second = (distill(geometric_model("kiro3"), settings) for _ in range(2))
    assert_close(first.predicted_corrections, second.predicted_corrections)
    other = distill(geometric_model("kiro3"), replace(settings, seed=5))
    assert not torch.equal(first.held_out.T, other.held_out.T)


def test_the_smallest_size_that_is_good_is_kept():
    found = distilled("hybrid", "kiro3", None, 800)
    sizes = found.summary.sizes
    assert [size.orders for size in sizes][:2] == [(1, 2), (1, 2, 3)]
    (kept,) = (size for size in sizes if size.is_selected)
    assert kept.rms_mm <= max(1.1 * min(size.rms_mm for size in sizes), 5e-3)
    assert kept.harmonics == sizes[-1].harmonics > 1


def test_sizes_fit_the_number_of_poses_and_the_parent():
    plain, rich = geometric_model("kiro3"), rippled("kiro3")
    assert {size.harmonics for size in sizes_for(plain, 10_000)} == {1}
    assert max(size.harmonics for size in sizes_for(rich, 10_000)) == 24
    assert sizes_for(rich, 150) == (NetworkSize((1, 2)),)
    robot, size = Robot.load("kiro3"), NetworkSize((1, 2), 24)
    network = distilled("hybrid", "kiro3", size).model.network
    assert network.networks[0].weight[0].numel() + network.networks[0].bias[0].numel() == size.unknowns(robot)


@pytest.mark.parametrize("rows", [1, 2, 60])
def test_joint_values_lie_between_the_rows(rows):
    robot, q = Robot.load("kiro3"), geometric_model("kiro3").starts[:rows]
    drawn = draw_between(robot, q, 500, torch.Generator().manual_seed(0))
    assert drawn.shape == (500, 4)
    assert bool(((drawn >= q.amin(0) - 1e-12) & (drawn <= q.amax(0) + 1e-12)).all())
    assert rows == 1 or float(drawn.std(0).min()) > 0.1 * float(q.std(0).min())


def test_between_takes_the_shorter_direction():
    robot = Robot.load("ur10")
    q = torch.full((2, 6), 3.1, dtype=torch.float64)
    q[1] = -3.1
    drawn = draw_between(robot, q, 100, torch.Generator().manual_seed(0))
    assert float(drawn.abs().min()) >= 3.1 - 1e-12
    assert float(drawn.abs().max()) <= 2 * math.pi - 3.1 + 1e-12


def test_figures_and_card_are_those_of_the_held_out_poses(tmp_path):
    found = distilled("hybrid", "kiro3", NetworkSize((1, 2, 3)))
    summary = found.summary
    errors = tool_errors(found, found.held_out.q_nominal + found.predicted_corrections) * 1e3
    assert_close(summary.held_out.distilled.rms_mm, errors.square().mean().sqrt(), rtol=1e-9)
    assert_close(summary.held_out.distilled.max_mm, errors.max(), rtol=1e-9)
    off = (found.predicted_corrections - found.held_out.correction)[:, 0].abs().rad2deg()
    assert_close(summary.joints[0].error.max, off.max(), rtol=1e-9)
    assert_close(
        summary.joints[2].correction.mean,
        found.held_out.correction[:, 2].abs().mean() * 1e3,
        rtol=1e-9,
    )
    written = found.save(tmp_path / "small", command="pisigma distill it")
    assert DistillationSummary.read(written).parent == summary.parent
    card = (tmp_path / "small" / "README.md").read_text()
    assert "`pisigma distill it`" in card
    assert f"{summary.held_out.distilled.rms_mm:.4f} mm RMS" in card
    assert "24 cycles" in card
    assert "`hybrid_kiro3`" in card
    assert not re.search(r"\bnan\b", card)


def test_a_region_out_of_reach_is_refused():
    parent = geometric_model("kiro3")
    region = Region(parent.starts, (3.0, 3.1, 0.0, 0.1, 0.0, 0.1))
    with refused(IdentificationError, value={"unreachable": 640}):
        distill(parent, DistillationSettings(region, 200, NetworkSize((1,))))


def test_poses_near_a_singularity_are_not_drawn():
    parent = geometric_model("kiro4")
    straight = parent.starts.clone()
    straight[:, 4] = 0.02
    with refused(IdentificationError, value={"singular": 20}):
        draw_solved_poses(CorrectedIK(parent), Region(straight), 10, torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("parent", "expected"),
    [
        (lambda: hand_made_model("kiro3"), "a model without a network"),
        (lambda: replace(geometric_model("kiro3"), calibrated=None), "a model with an identified geometry"),
    ],
)
def test_models_that_cannot_be_distilled_are_refused(parent, expected):
    with refused(ModelError, expected=expected):
        distill(parent())


@pytest.mark.parametrize(
    ("name", "settings", "rows", "fields"),
    [
        ("kiro3", DistillationSettings(poses=50), 60, {"option": "--poses", "value": 50}),
        ("ur10", DistillationSettings(poses=120), 60, {"option": "--poses", "value": 120}),
        ("kiro3", DistillationSettings(poses=120, size=NetworkSize((3, 3), 8)), 60, {}),
        (
            "kiro3",
            DistillationSettings(poses=200, size=NetworkSize((1,))),
            1,
            {"expected": "poses with different joint values"},
        ),
    ],
)
def test_too_few_poses_or_motions_are_refused(name, settings, rows, fields):
    parent = geometric_model(name)
    with refused(IdentificationError, **fields):
        distill(parent, replace(settings, region=Region(parent.starts[:rows])))
