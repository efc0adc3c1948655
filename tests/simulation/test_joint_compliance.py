"""Deflection under gravity, compared with the potential energy and with torques by hand."""

import math

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import RecipeError
from pisigma.robot import Robot, Row
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.simulation.errors.joint_compliance import JointCompliance, LinkMass, gravity_load

GRAVITY = (1.0, -2.0, -9.0)


def arm() -> Robot:
    """Five rows of every type, one with negative direction, with a base that must not matter."""
    rows = (
        Row("j1", "revolute"),
        Row("j2", "revolute", direction=-1),
        Row("bracket", "fixed"),
        Row("slide", "prismatic", direction=-1),
        Row("j5", "revolute"),
    )
    generator = np.random.default_rng(3)
    return Robot(
        "arm", "", "", rows, generator.normal(size=(5, 5)), generator.normal(size=6), generator.normal(size=6)
    )


def potential_energy(
    robot: Robot, q: torch.Tensor, masses: dict[int, LinkMass], payload: LinkMass
) -> torch.Tensor:
    """-Σ m g · r, with every centre of mass as the tool of the robot that ends at its row."""
    gravity = torch.tensor(GRAVITY, dtype=torch.float64)
    energy = torch.zeros(q.shape[:-1], dtype=torch.float64)
    bodies = [(index, mass, np.zeros(6)) for index, mass in masses.items()]
    bodies.append((len(robot.rows) - 1, payload, robot.tool))
    for index, mass, frame in bodies:
        part = Robot("part", "", "", robot.rows[: index + 1], robot.dh[: index + 1], np.zeros(6), frame)
        T = forward_kinematics(part, q[..., : part.dof])
        centre = torch.tensor([*mass.centre_mm, 1e3], dtype=torch.float64) / 1e3
        energy = energy - mass.mass_kg * (T @ centre)[..., :3] @ gravity
    return energy


def test_load_is_minus_the_derivative_of_the_potential_energy(generator):
    robot = arm()
    masses = {
        0: LinkMass(mass_kg=4, centre_mm=(100, -50, 30)),
        2: LinkMass(mass_kg=0.5, centre_mm=(10, 20, -30)),
        3: LinkMass(mass_kg=2, centre_mm=(-70, 0, 200)),
        4: LinkMass(mass_kg=1),
    }
    payload = LinkMass(mass_kg=3, centre_mm=(0, 40, 60))
    q = torch.randn(20, 4, generator=generator, dtype=torch.float64)
    load = gravity_load(robot, q, masses, payload, GRAVITY)
    for joint in range(4):
        step = torch.zeros(4, dtype=torch.float64)
        step[joint] = 1e-5
        above, below = (potential_energy(robot, q + s * step, masses, payload) for s in (1, -1))
        assert_close(load[:, joint], -(above - below) / 2e-5, atol=1e-7)
    assert float(load.abs().amax(0).min()) > 1.0  # every joint carries something


def test_horizontal_beam_by_hand():
    """A beam of 2 m about a horizontal axis: mass in the middle, payload at the end."""
    beam = Robot("beam", "", "", (Row("j1", "revolute"),), np.array([[0, 0, 2.0, 0, 0]]))
    source = JointCompliance(
        kind="joint_compliance",
        compliance_rad_per_Nm={"j1": 1e-5},
        links={"j1": LinkMass(mass_kg=6, centre_mm=(-1000, 0, 0))},
        payload=LinkMass(mass_kg=1),
        gravity_m_per_s2=(0, -9.81, 0),
    )
    q = torch.tensor([[0.0], [math.pi / 3], [math.pi / 2]], dtype=torch.float64)
    torque = 6 * 9.81 * 1 + 1 * 9.81 * 2
    assert_close(source.bind(beam, "here")(q), -1e-5 * torque * torch.cos(q), atol=1e-18)


def test_a_vertical_axis_has_no_torque_and_the_prismatic_joint_carries_the_weight(generator):
    robot = Robot.load("kiro3")
    source = JointCompliance(
        kind="joint_compliance",
        compliance_rad_per_Nm={"theta_1": 1e-5, "theta_2": 1e-5, "theta_4": 1e-5},
        compliance_m_per_N={"d_3": 1e-6},
        links={"d_3": LinkMass(mass_kg=2, centre_mm=(0, 0, 100))},
        payload=LinkMass(mass_kg=3, centre_mm=(50, 0, 0)),
    )
    error = source.bind(robot, "here")(torch.randn(3, 1, 4, generator=generator, dtype=torch.float64))
    assert_close(error[..., [0, 1, 3]], 0.0, atol=1e-20)
    assert_close(error[..., 2], -1e-6 * 5 * 9.81, atol=1e-18)


@pytest.mark.parametrize("batch", [(), (0,), (1,), (3, 1, 2)], ids=str)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batches_and_dtypes(batch, dtype, generator):
    robot = Robot.load("ur10")
    source = JointCompliance(
        kind="joint_compliance",
        compliance_rad_per_Nm={f"theta_{i}": 1e-5 for i in range(1, 7)},
        links={"theta_2": LinkMass(mass_kg=12, centre_mm=(300, 0, 150))},
    )
    error = source.bind(robot, "here")
    q = torch.randn(*batch, 6, generator=generator, dtype=dtype)
    assert error(q).shape == q.shape
    assert error(q).dtype == dtype
    looped = torch.stack([error(one) for one in q.reshape(-1, 6)]) if q.numel() else q.reshape(-1, 6)
    assert_close(error(q).reshape(-1, 6), looped, atol=1e-9 if dtype == torch.float32 else 1e-18)


@pytest.mark.parametrize(
    ("fields", "value", "name"),
    [
        ({"compliance_rad_per_Nm": {"theta_9": 1e-6}}, "theta_9", "'theta_"),
        ({"compliance_m_per_N": {"theta_1": 1e-6}}, "theta_1", "compliance_rad_per_Nm"),
        ({"links": {"link_1": {"mass_kg": 1}}}, "link_1", "theta_1"),
    ],
)
def test_unknown_joints_and_rows_are_refused(fields, value, name):
    source = JointCompliance(kind="joint_compliance", **fields)
    with refused(RecipeError, option="here", value=value) as caught:
        source.bind(Robot.load("ur10"), "here")
    assert name in caught.value.remedy
