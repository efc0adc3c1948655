"""Every sensor's closed-form derivative against finite differences; exact data of every sensor are met."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.sensors import (
    ARM,
    TRUE_BASES,
    mixed_data,
    pair_data,
    socket_data,
    touch_data,
    true_robot,
    wire_data,
)

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.identifiability.redundancy import find_redundancy
from pisigma.calibration.geometric.problem.noise import contributions_and_noise_of
from pisigma.estimation.loss import SquaredLoss
from pisigma.measurement.dataset import Measurements
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import wrap_to_pi

KNOWN = {("plate/0", "plate/1"): 0.05}
DATA: dict[str, Callable[[], Measurements]] = {
    "touch": touch_data,
    "socket": socket_data,
    "distance": wire_data,
    "pair": pair_data,
    "mixed": mixed_data,
}


def test_derivatives_are_those_of_the_predicted_values() -> None:
    setup = GeometricCalibrator(true_robot().nominal, socket_distances=KNOWN).build(mixed_data())
    problem, everything = setup.problem, torch.arange(len(setup.start))
    generator = torch.Generator().manual_seed(1)
    point = setup.start + 1e-2 * torch.randn(len(setup.start), generator=generator, dtype=torch.float64)
    rows, step = slice(0, problem.q.shape[0]), 1e-3

    def residuals(at: torch.Tensor) -> list[torch.Tensor]:
        motion = problem.motion(at, rows, everything)
        return [
            sensor.residual(motion, problem.space.sensor_unknowns(at), rows) for sensor in problem.sensors
        ]

    motion = problem.motion(point, rows, everything)
    found = {
        k: problem.prediction_derivative(
            sensor, motion, problem.space.sensor_unknowns(point), rows, everything
        )[..., sensor.present]
        for k, sensor in enumerate(problem.sensors)
        if sensor.name not in ("position", "rotation")
    }
    numeric = {k: torch.zeros_like(J) for k, J in found.items()}
    for i in everything.tolist():
        for weight, times in ((-4 / 5, 1), (1 / 5, 2), (-4 / 105, 3), (1 / 280, 4)):
            shift = torch.zeros_like(point)
            shift[i] = times * step
            high, low = residuals(point + shift), residuals(point - shift)
            for k, differences in numeric.items():
                differences[i] += weight * (high[k] - low[k])[..., problem.sensors[k].present] / step
    assert found
    for k, J in found.items():
        assert_close(J, numeric[k], atol=1e-8 * float(J.abs().max()))
        assert float(J.abs().amax((1, 2)).max()) > 0.1


def test_23_parameters_come_back_from_exact_touches_without_a_guess() -> None:
    arm = true_robot()
    calibrator = GeometricCalibrator(arm.nominal, free=ARM, tool="position", prior=None, loss=SquaredLoss())
    solved = calibrator.solve(touch_data())
    result, at_start = solved.result(), solved.findings.information
    assert len(result.free_parameters) == result.rank == 23
    of_arm = at_start.eliminate([k for k, p in enumerate(at_start.parameters) if p.group in ("base", "tool")])
    assert find_redundancy(of_arm, np.zeros(len(of_arm.parameters))).rank == len(ARM)
    assert result.status.is_minimum
    true = arm.geometric_robot
    assert_close(result.robot.dh, true.dh, atol=1e-9)
    assert_close(result.tools[""][:3], true.tool[:3], atol=1e-9)
    assert set(result.bases) == {"right", "left"}
    for name, base in result.bases.items():
        off = torch.from_numpy(base - TRUE_BASES[name])
        assert_close(torch.cat([off[:3], wrap_to_pi(off[3:])]), torch.zeros(6), atol=1e-9)


def test_base_names_mean_every_frame_and_a_further_jig_costs_six() -> None:
    arm = true_robot()
    names = [*ARM, "tool_x", "tool_y", "tool_z"] + [
        f"base_{c}" for c in ("x", "y", "z", "roll", "pitch", "yaw")
    ]
    counts = []
    for frames in (("right",), ("right", "left"), ("right", "left", "back")):
        calibrator = GeometricCalibrator(
            arm.nominal, free=names, base="fixed", tool="fixed", prior=None, loss=SquaredLoss()
        )
        result = calibrator.fit(touch_data(frames))
        assert_close(result.robot.dh, arm.geometric_robot.dh, atol=1e-9)
        counts.append(len(result.free_parameters))
    assert counts == [17, 23, 29]


@pytest.mark.parametrize("kind", ["socket", "distance", "pair", "mixed"])
def test_exact_data_of_every_sensor_give_the_robot_back(kind: str) -> None:
    arm, data = true_robot(), DATA[kind]()
    known = KNOWN if kind in ("socket", "mixed") else {}
    calibrator = GeometricCalibrator(
        arm.nominal, free=ARM, tool="position", prior=None, loss=SquaredLoss(), socket_distances=known
    )
    result = calibrator.fit(data)
    for name, errors in result.errors_of(data).items():
        seen = torch.isfinite(errors).all(-1)
        assert bool(seen.any()), name
        assert_close(errors[seen], torch.zeros_like(errors[seen]), atol=1e-11)
    assert_close(result.robot.dh, arm.geometric_robot.dh, atol=1e-7)
    if kind in ("distance", "mixed"):
        assert_close(result.sensor_unknowns["anchor"]["wire"][3], 0.012, atol=1e-7)


def test_pairs_in_any_order_and_many_rows_stay_together() -> None:
    arm = true_robot()
    data = pair_data(count=4400)
    mixed = data.select(torch.randperm(data.rows, generator=torch.Generator().manual_seed(2)))
    calibrator = GeometricCalibrator(arm.nominal, free=ARM, tool="position", prior=None, loss=SquaredLoss())
    setup = calibrator.build(mixed)
    problem = setup.problem.with_active(calibrator.candidates(setup.problem.space))
    part = problem.select(torch.tensor([1, 5, 4, 4399]))
    assert part.q.shape[0] == 6
    tool = setup.problem.space.split(setup.start)[2][0].numpy()
    started = arm.nominal.with_geometry(tool=tool)
    for chosen in (problem, part):
        part = contributions_and_noise_of(chosen.linearise(setup.start, None)).contributions[0]
        p = forward_kinematics(started, chosen.q)[:, :3, 3]
        expected = chosen.sensors[0].measured[::2] - (p[::2] - p[1::2]).norm(dim=-1)  # type: ignore[attr-defined]
        assert_close(part.residual[0, ::2], expected, atol=1e-12)
    result = calibrator.fit(mixed)
    assert_close(result.robot.dh, arm.geometric_robot.dh, atol=1e-7)
    assert np.isfinite(result.residuals["pair"]).sum() == 2200
