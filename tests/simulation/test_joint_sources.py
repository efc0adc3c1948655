"""Every joint error source alone, compared with its formula."""

import math

import pytest
import torch
from pydantic import ValidationError
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import RecipeError
from pisigma.robot import Robot
from pisigma.simulation.errors.encoder import EncoderQuantisation
from pisigma.simulation.errors.joint_offset import JointOffset
from pisigma.simulation.errors.transmission import TransmissionHarmonics

KIRO3 = Robot.load("kiro3")
BATCHES = [(), (1,), (0,), (3, 1, 2)]


def joint_values(batch: tuple[int, ...], generator: torch.Generator, dtype: torch.dtype = torch.float64):
    return 4 * torch.rand(*batch, 4, generator=generator, dtype=dtype) - 2


def test_offset_is_added_to_its_joint_only(generator):
    q = joint_values((5,), generator)
    source = JointOffset(kind="joint_offset", offset_deg={"theta_2": 3.0}, offset_mm={"d_3": -0.5})
    expected = torch.tensor([0.0, math.radians(3.0), -0.0005, 0.0], dtype=torch.float64).expand(5, 4)
    assert_close(source.bind(KIRO3, "here")(q), expected, atol=1e-16)


def test_transmission_errors_of_one_joint(generator):
    q = joint_values((7,), generator)
    term = {"joint": "theta_1", "amplitude_deg": 0.2, "harmonic": 3, "phase_deg": 40}
    error = TransmissionHarmonics(kind="transmission", terms=[term]).bind(KIRO3, "here")(q)
    for row, values in zip(error.tolist(), q.tolist(), strict=True):
        expected = math.radians(0.2) * math.sin(3 * values[0] + math.radians(40))
        assert_close(row, [expected, 0.0, 0.0, 0.0], atol=1e-15)


def test_transmission_terms_of_coupled_joints_add_up(generator):
    q = joint_values((7,), generator)
    terms = [
        {"joint": "theta_4", "amplitude_deg": 0.1, "joints": {"theta_1": 1, "theta_4": -2}},
        {"joint": "theta_4", "amplitude_deg": 0.05, "harmonic": 1, "phase_deg": 90},
    ]
    error = TransmissionHarmonics(kind="transmission", terms=terms).bind(KIRO3, "here")(q)
    expected = math.radians(0.1) * torch.sin(q[:, 0] - 2 * q[:, 3]) + math.radians(0.05) * torch.cos(q[:, 3])
    assert_close(error[:, 3], expected, atol=1e-16)
    assert_close(error[:, :3], 0.0)


def test_transmission_of_a_screw_repeats_with_its_lead():
    term = {"joint": "d_3", "amplitude_mm": 0.02, "harmonic": 1, "lead_mm": 10}
    error = TransmissionHarmonics(kind="transmission", terms=[term]).bind(KIRO3, "here")
    q = torch.zeros(4, 4, dtype=torch.float64)
    q[:, 2] = torch.tensor([-0.1, -0.1025, -0.105, -0.1075], dtype=torch.float64)
    expected = [[0, 0, x, 0] for x in (0.0, -2e-5, 0.0, 2e-5)]
    assert_close(error(q), torch.tensor(expected, dtype=torch.float64), atol=1e-12)


def test_encoder_rounds_to_the_nearest_pulse(generator):
    q = joint_values((1000,), generator)
    source = EncoderQuantisation(
        kind="encoder", pulses_per_revolution={"theta_1": 2048, "theta_2": 2048}, step_mm={"d_3": 0.1}
    )
    reached = q + source.bind(KIRO3, "here")(q)
    steps = torch.tensor([2 * math.pi / 2048, 2 * math.pi / 2048, 1e-4], dtype=torch.float64)
    pulses = reached[:, :3] / steps
    assert_close(pulses, pulses.round(), atol=1e-8)
    distance = ((reached - q)[:, :3].abs() / steps).amax(0)
    assert bool((distance <= 0.5 + 1e-9).all())
    assert bool((distance > 0.49).all())  # the bound is reached, so the step is no smaller
    assert_close(reached[:, 3], q[:, 3])


def test_quantised_twice_is_quantised_once(generator):
    q = joint_values((100,), generator)
    error = EncoderQuantisation(kind="encoder", pulses_per_revolution={"theta_1": 2500}).bind(KIRO3, "here")
    reached = q + error(q)
    assert_close(error(reached), 0.0, atol=1e-15)


ALL = [
    JointOffset(kind="joint_offset", offset_deg={"theta_2": 3.0}),
    TransmissionHarmonics(
        kind="transmission",
        terms=[{"joint": "theta_1", "amplitude_deg": 0.2, "joints": {"theta_1": 1, "theta_2": 1}}],
    ),
    EncoderQuantisation(kind="encoder", pulses_per_revolution={"theta_1": 2048}),
]


@pytest.mark.parametrize("source", ALL, ids=lambda source: source.kind)
@pytest.mark.parametrize("batch", BATCHES, ids=str)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batches_and_dtypes(source, batch, dtype, generator):
    q = joint_values(batch, generator, dtype)
    error = source.bind(KIRO3, "here")
    assert error(q).shape == q.shape
    assert error(q).dtype == dtype
    looped = torch.stack([error(one) for one in q.reshape(-1, 4)]) if q.numel() else q.reshape(-1, 4)
    assert_close(error(q).reshape(-1, 4), looped, atol=1e-7 if dtype == torch.float32 else 1e-16)


@pytest.mark.parametrize(
    ("source", "option", "value", "name"),
    [
        (JointOffset(kind="joint_offset", offset_deg={"theta_3": 1}), "here", "theta_3", "'theta_"),
        (JointOffset(kind="joint_offset", offset_deg={"d_3": 1}), "here", "d_3", "offset_mm"),
        (
            EncoderQuantisation(kind="encoder", step_mm={"theta_1": 1}),
            "here",
            "theta_1",
            "pulses_per_revolution",
        ),
        (
            EncoderQuantisation(kind="encoder", pulses_per_revolution={"tetha_1": 9}),
            "here",
            "tetha_1",
            "'theta_1'",
        ),
        (
            TransmissionHarmonics(
                kind="transmission", terms=[{"joint": "d_3", "amplitude_mm": 1, "harmonic": 1}]
            ),
            "here, terms[0]",
            "d_3",
            "lead_mm",
        ),
        (
            TransmissionHarmonics(
                kind="transmission",
                terms=[{"joint": "theta_1", "amplitude_deg": 1, "harmonic": 1, "lead_mm": 1}],
            ),
            "here, terms[0]",
            "theta_1",
            "lead_mm",
        ),
        (
            TransmissionHarmonics(
                kind="transmission", terms=[{"joint": "theta_1", "amplitude_deg": 1, "joints": {"d_3": 1}}]
            ),
            "here, terms[0]",
            "d_3",
            "joints",
        ),
        (
            TransmissionHarmonics(
                kind="transmission", terms=[{"joint": "theta_1", "amplitude_deg": 1, "joints": {"thta_2": 1}}]
            ),
            "here, terms[0]",
            "thta_2",
            "'theta_2'",
        ),
    ],
)
def test_sources_that_do_not_fit_are_refused(source, option, value, name):
    with refused(RecipeError, option=option, value=value) as caught:
        source.bind(KIRO3, "here")
    assert name in caught.value.remedy


@pytest.mark.parametrize(
    ("term", "kind", "names"),
    [
        ({"joint": "theta_1", "harmonic": 1}, "value_error", ("amplitude_deg", "amplitude_mm")),
        (
            {"joint": "theta_1", "amplitude_deg": 1, "amplitude_mm": 1, "harmonic": 1},
            "value_error",
            ("amplitude_deg", "amplitude_mm"),
        ),
        ({"joint": "theta_1", "amplitude_deg": 1}, "value_error", ("harmonic", "joints")),
        (
            {"joint": "theta_1", "amplitude_deg": 1, "joints": {}, "lead_mm": 1},
            "value_error",
            ("lead_mm", "harmonic"),
        ),
        ({"joint": "theta_1", "amplitude_deg": 1, "harmonic": 1.5}, "int_from_float", ()),
    ],
)
def test_incomplete_and_contradictory_terms_are_refused(term, kind, names):
    with pytest.raises(ValidationError) as caught:
        TransmissionHarmonics(kind="transmission", terms=[term])
    first = caught.value.errors()[0]
    assert first["type"] == kind
    assert all(name in first["msg"] for name in names)
