"""Models of a geometric calibration: their folder, and inverse kinematics with the identified geometry."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.models import no_type_checker
from testing.refusals import refused
from testing.sensors import true_robot, wire_data
from testing.simulated_arm import draw_joints, simulate

import pisigma
from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.files.errors import ModelError
from pisigma.model.accuracy import parameter_posterior
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.model.geometric_model import model_of_calibration, model_of_hybrid
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.inverse.numeric_ik import NumericIK
from pisigma.model.stored_starts import MAX_STARTS
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.numeric import solve_numeric
from pisigma.robot.kinematics.status import Status

pytestmark = pytest.mark.usefixtures("without_type_checker")  # iterations are slow with one

CLOSED_FORM = ("kiro4", "fanuc_r2000")
BASE = np.array([0.02, -0.01, 0.03, 0.01, 0.02, -0.01])


@pytest.fixture(scope="module", params=(*CLOSED_FORM, "ur5"))
def calibrated(request, tmp_path_factory):
    """The model of a calibration without noise, loaded from its folder."""
    with no_type_checker():
        arm = simulate(request.param, rows=120, turn_noise=0.0, length=2e-3, angle=4e-3, base=BASE)
        result = GeometricCalibrator(arm.nominal, prior=None).fit(arm.measurements)
    folder = tmp_path_factory.mktemp("model")
    save_model(model_of_calibration("arm", arm.nominal, result, arm.measurements), folder)
    return arm, pisigma.load(folder), folder


def boundary_poses(ik, count: int) -> torch.Tensor:
    """Poses with a nearly straight arm that the identified arm reaches and the nominal one does not."""
    robot = ik.model.robot
    q = draw_joints(robot, 40 * count, np.random.default_rng(5))
    limits = torch.from_numpy(robot.limits)
    straight = straight_elbow(robot)
    q[:, 2] = straight + 0.02 * (
        2 * torch.rand(len(q), generator=torch.Generator().manual_seed(0)).double() - 1
    )
    assert bool((limits[2, 0] < straight) & (straight < limits[2, 1]))
    T = forward_kinematics(ik.model.calibrated, q)
    lost = (closed_form_solver(robot).solve(T).status == Status.UNREACHABLE).all(-1)
    assert int(lost.sum()) >= count
    return T[lost][:count]


def straight_elbow(robot) -> float:
    """Joint value of the third joint [rad] at which the wrist is farthest from the second."""
    q = torch.zeros(20_000, robot.dof, dtype=torch.float64)
    q[:, 2] = torch.linspace(-3.1, 3.1, len(q))
    wrist = replace(robot, dh=robot.dh * np.array([1, 1, 1, 1, 1.0])).with_geometry(tool=np.zeros(6))
    dh = wrist.dh.copy()
    dh[-1, 1] = 0
    shoulder = forward_kinematics(wrist.with_geometry(dh=dh), q)[:, :3, 3]
    origin = shoulder.new_tensor([robot.dh[0, 2], 0.0, robot.dh[0, 1]])
    at_zero = robot.with_geometry(base=np.zeros(6), tool=np.zeros(6), dh=dh)
    distance = (forward_kinematics(at_zero, q)[:, :3, 3] - origin).norm(dim=-1)
    inside = (q[:, 2] > robot.limits[2, 0]) & (q[:, 2] < robot.limits[2, 1])
    return float(q[torch.where(inside, distance, -1).argmax(), 2])


def test_the_folder_restores_the_calibrated_robot(calibrated):
    arm, ik, _ = calibrated
    model = ik.model
    q = draw_joints(arm.true, 50, np.random.default_rng(1))
    assert_close(model.forward(q), forward_kinematics(arm.true, q), atol=1e-9)
    assert np.array_equal(model.robot.dh, arm.nominal.dh)
    assert np.array_equal(model.robot.base, model.calibrated.base)
    assert (model.kind, model.network, model.domain) == ("geometric_calibration", None, None)
    solver = closed_form_solver(arm.nominal)
    assert set(model.branches) <= set(solver.branches if solver else ())
    assert bool(model.branches) == (solver is not None)


def test_the_identified_arm_reaches_the_poses(calibrated):
    arm, ik, _ = calibrated
    T = forward_kinematics(arm.true, draw_joints(arm.true, 300, np.random.default_rng(2)))
    solution = ik(T)
    reached = (solution.status == Status.REACHED) | (solution.status == Status.OUTSIDE_JOINT_LIMITS)
    if ik.branches != ("numeric",):
        default = closed_form_solver(ik.model.robot).solve(T).q[:, ik.branches.index(ik.model.branches[0])]
        most = 0.96 if arm.nominal.name.lower() == "ur5" else 0.99  # beside its singular poses branches end
        assert bool(reached[torch.isfinite(default).all(-1)].float().mean() > most)
    assert float(reached.double().mean()) > 0.3
    assert_close(forward_kinematics(ik.model.calibrated, solution.q[reached]), T[reached], atol=1e-9)
    lost = solution.status == Status.UNREACHABLE
    assert bool(solution.q[lost].isnan().all())
    assert not bool(solution.q[~lost].isnan().any())
    assert bool(solution.domain_measure.isnan().all())


def test_nominal_values_are_the_nominal_arms_on_the_identified_base(calibrated):
    arm, ik, _ = calibrated
    T = forward_kinematics(arm.true, draw_joints(arm.true, 100, np.random.default_rng(3)))
    solution = ik(T)
    known = torch.isfinite(solution.q_nominal).all(-1)
    assert int(known.sum()) > 30
    assert_close(forward_kinematics(ik.model.robot, solution.q_nominal[known]), T[known], atol=1e-9)
    assert_close(solution.correction[known], (solution.q - solution.q_nominal)[known])
    assert bool((solution.correction[known].abs() <= torch.pi + 1e-9).all())
    assert float(solution.correction[known].abs().max()) > 1e-4


def test_measured_joint_values_are_found_again_near_themselves(calibrated):
    arm, ik, _ = calibrated
    q = draw_joints(arm.true, 40, np.random.default_rng(4))
    T = forward_kinematics(arm.true, q)
    solution = ik(T, near=q)
    assert float((solution.status == Status.REACHED).double().mean()) > 0.9
    back = (solution.q - q).abs().amax(-1)
    assert float((back < 1e-6).double().mean()) > 0.9


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,)])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_batches_and_types(calibrated, batch, dtype):
    arm, ik, _ = calibrated
    count = int(np.prod(batch)) if batch else 1
    q = arm.measurements.q[:6][:count]
    T = forward_kinematics(arm.true, q).reshape(*batch, 4, 4).to(dtype)
    solution = ik(T)
    assert solution.q.shape == (*batch, ik.model.robot.dof)
    assert solution.status.shape == batch
    assert solution.q.dtype == dtype
    every = ik.all_branches(T)
    assert every.q.shape == (*batch, len(ik.branches), ik.model.robot.dof)
    reached = every.status == Status.REACHED
    found = forward_kinematics(ik.model.calibrated, every.q[reached].double())
    wanted = T.unsqueeze(-3).expand(*every.status.shape, 4, 4)[reached].double()
    assert_close(found, wanted, atol=1e-9 if dtype == torch.float64 else 1e-4)
    assert batch == (0,) or bool(reached.any())


def test_poses_beyond_the_reach_are_not_searched_for(calibrated, monkeypatch):
    _, ik, _ = calibrated
    calls = []

    def counted(robot, T, start, **options):
        calls.append(len(T))
        return solve_numeric(robot, T, start, **options)

    for module in ("numeric_arm", "numeric_ik"):
        monkeypatch.setattr(f"pisigma.model.inverse.{module}.solve_numeric", counted)
    T = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    T[:, 0, 3] = 2 * ik.model.calibrated.reach
    numeric, near = NumericIK(ik.model), torch.zeros(ik.model.robot.dof)
    for solution in (numeric.solve_batch(T), numeric.all_branches(T), numeric.solve_batch(T, near=near)):
        assert bool((solution.status == Status.UNREACHABLE).all())
        assert bool(solution.q.isnan().all())
    assert not any(calls)


@pytest.mark.parametrize("calibrated", CLOSED_FORM, indirect=True)
def test_poses_that_only_the_identified_arm_reaches_are_found(calibrated):
    _, ik, _ = calibrated
    T = boundary_poses(ik, 50)
    for solution in (ik(T), ik(T, near=torch.zeros(ik.model.robot.dof))):
        reached = solution.status != Status.UNREACHABLE
        assert float(reached.double().mean()) > 0.95
        assert_close(forward_kinematics(ik.model.calibrated, solution.q[reached]), T[reached], atol=1e-9)
        assert bool(solution.q_nominal.isnan().all())
        assert bool(solution.correction.isnan().all())
    every = ik.all_branches(T)
    reached = every.status != Status.UNREACHABLE
    assert float(reached.any(-1).double().mean()) > 0.9
    wanted = T[:, None].expand(*reached.shape, 4, 4)
    assert_close(forward_kinematics(ik.model.calibrated, every.q[reached]), wanted[reached], atol=1e-9)


@pytest.mark.parametrize("calibrated", CLOSED_FORM, indirect=True)
def test_branches_keep_their_names(calibrated):
    arm, ik, _ = calibrated
    T = forward_kinematics(arm.true, arm.measurements.q[:20])
    every = ik.all_branches(T)
    for number, name in enumerate(ik.branches):
        alone = ik(T, branch=name)
        same = alone.status == every.status[:, number]
        assert bool(same.all())
        reached = alone.status == Status.REACHED
        assert_close(alone.q[reached], every.q[:, number][reached], atol=1e-9)
        assert bool((alone.branch == number).all())


def test_starts_are_spread_and_different(calibrated):
    arm, ik, _ = calibrated
    repeated = replace(
        arm.measurements,
        q=arm.measurements.q.repeat(10, 1),
        position=arm.measurements.position.repeat(10, 1),
        rotation=None,
        frame=(),
        target=(),
        line=(),
    )
    with no_type_checker():
        result = GeometricCalibrator(arm.nominal).fit(repeated)
    model = model_of_calibration("arm", arm.nominal, result, repeated)
    assert len(model.starts) == min(120, MAX_STARTS) == len(ik.model.starts)
    assert len(model.starts.unique(dim=0)) == len(model.starts)


def test_a_foreign_geometry_is_refused(calibrated, tmp_path):
    _, ik, _ = calibrated
    model = ik.model
    moved = model.calibrated.with_geometry(base=model.robot.base + 0.1)
    save_model(replace(model, calibrated=moved), tmp_path)
    with refused(ModelError, file="model.yaml", column="calibrated"):
        load_model(tmp_path)


def test_a_model_without_starts_still_follows_the_closed_form():
    with no_type_checker():
        arm = simulate("kiro4", rows=60, turn_noise=0.0)
        result = GeometricCalibrator(arm.nominal).fit(arm.measurements)
    model = model_of_calibration("arm", arm.nominal, result, arm.measurements)
    ik = CorrectedIK(replace(model, starts=model.starts[:0]))
    T = forward_kinematics(model.calibrated, arm.measurements.q[:5])
    assert bool((ik.all_branches(T).status == Status.REACHED).any(-1).all())


def test_a_folder_stores_the_unknown_sensor_parameters(tmp_path):
    """Anchors and their zeros are correlated with the geometry; a folder of an older format does not have them."""
    rows, robot = wire_data(), true_robot().nominal
    result = GeometricCalibrator(robot).fit(rows)
    solved = result.solved
    known = PositionUncertainty(
        solved.problem.space, solved.geometry, (), CovarianceRoot(solved.covariance_root), 1.0
    )
    hybrid = HybridResult(result, learned=None, uncertainty=known, trials=(), verdict="")
    model = model_of_hybrid("wires", robot, hybrid, rows)
    save_model(model, tmp_path)
    kept = parameter_posterior(load_model(tmp_path))
    assert any(name.startswith("anchor_") for name in kept.names)
    assert kept.names == result.posterior.names
    assert_close(kept.mean, result.posterior.mean, atol=1e-9)
    scale = 1 / result.posterior.standard_errors.clamp(min=1e-12)
    difference = (kept.covariance - result.posterior.covariance) * scale * scale[:, None]
    assert_close(difference, torch.zeros_like(difference), atol=1e-5)
    bare = IdentifiedGeometry(known.geometry.robot, known.geometry.bases, known.geometry.tools, {})
    older = parameter_posterior(replace(model, uncertainty=replace(known, geometry=bare)))
    assert bool(older.mean[-4:].isnan().all())
