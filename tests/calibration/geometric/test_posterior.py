"""What a calibration says of all its parameters together."""

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused
from testing.sensors import mixed_data, true_robot, wire_data

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.posterior import ParameterPosterior
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.files.errors import IdentificationError


@pytest.fixture(scope="module", params=["wires", "mixed"])
def result(request: pytest.FixtureRequest) -> CalibrationResult:
    rows = wire_data() if request.param == "wires" else mixed_data()
    return GeometricCalibrator(true_robot().nominal).fit(rows)


def test_all_parameters_and_correlations_are_listed(result: CalibrationResult) -> None:
    posterior = result.posterior
    assert posterior.names == tuple(parameter.name for parameter in result.parameters)
    assert_close(
        posterior.mean, torch.tensor([one.estimated for one in result.parameters], dtype=torch.float64)
    )
    covariance = torch.from_numpy(result.covariance)
    deviation = covariance.diagonal().clamp(min=0).sqrt()
    unit = torch.where(deviation > 0, 1 / deviation, 0.0)
    assert_close(
        posterior.covariance * unit * unit[:, None], covariance * unit * unit[:, None], atol=1e-9, rtol=0.0
    )
    assert_close(posterior.standard_errors, deviation, rtol=1e-9)
    assert posterior.weight_count == 0


def test_sensors_unknowns_are_among_them(result: CalibrationResult) -> None:
    posterior = result.posterior
    names = [name for name in posterior.names if name.startswith(("anchor_", "socket_"))]
    assert names
    some = posterior.select([*names, "a_2", "base_x"] if "base_x" in posterior.names else [*names, "a_2"])
    group, owner = next(
        (group, owner)
        for group, owners in result.sensor_unknowns.items()
        for owner in owners
        if names[0] == f"{group}_{owner}_x"
    )
    assert_close(some.mean[:3], torch.from_numpy(result.sensor_unknowns[group][owner][:3]))
    rows = [posterior.names.index(name) for name in some.names]
    # products of other numbers of rows may be summed in another order, which shows in the last bit
    whole = posterior.covariance[rows][:, rows]
    assert_close(some.covariance, whole, atol=1e-14 * float(whole.abs().max()), rtol=1e-14)
    cross = some.covariance[: len(names), len(names) :]
    assert float(cross.abs().max()) > 0  # they are known together, not one by one


def test_an_unknown_name_is_refused(result: CalibrationResult) -> None:
    with refused(IdentificationError, value="a_22"):
        result.posterior.select(["a_22"])


def test_values_that_were_not_kept_are_nan(result: CalibrationResult) -> None:
    solved = result.solved
    space = solved.problem.space
    bare = solved.geometry.__class__(result.robot, result.bases, result.tools, {})
    posterior = ParameterPosterior.from_geometry(space, bare, solved.covariance_root)
    first = space.arm_parameter_count + 6 * (len(space.frames) + len(space.targets))
    assert_close(posterior.mean[:first], result.posterior.mean[:first])
    assert bool(posterior.mean[first:].isnan().all())
