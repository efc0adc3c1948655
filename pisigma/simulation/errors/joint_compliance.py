"""Compliance of joints under the weight of the arm and its payload."""

from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from pisigma.files.yaml_file import Section
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.components import Frame, as_transform, compose_xyz_zyx
from pisigma.robot.kinematics.forward import Geometry, iterate_rows
from pisigma.simulation.errors.source import (
    AbstractJointSource,
    JointErrorFunction,
    row_index,
    value_per_joint,
)

Triple = tuple[float, float, float]


class LinkMass(Section):
    """Mass of a link or a payload.

    Attributes:
        mass_kg: mass [kg].
        centre_mm: centre of mass [mm] in the frame of the link's row (after its RotY(beta)), or in the tool frame for
            the payload.
    """

    mass_kg: float = Field(ge=0)
    centre_mm: Triple = (0.0, 0.0, 0.0)


class JointCompliance(AbstractJointSource):
    """Deflection of every joint in proportion to its gravity torque.

    `e_j = c_j · tau_j(q)` with `tau_j = Σ_k z_j · ((r_k - p_j) x m_k g)` over all masses k beyond joint j,
    where z_j and p_j are the joint's axis and origin, and r_k is the centre of mass; for a prismatic joint, the force
    is `tau_j = Σ_k z_j · m_k g`. The torque is computed for the nominal geometry at the commanded joint values, without
    the deflection, which is exact to first order in the compliance.

    Source: Whitney, Lozinski and Rourke, ASME Journal of Dynamic Systems, Measurement, and Control
    108(1), 1986, 1-8; Judd and Knasinski, IEEE Transactions on Robotics and Automation 6(1), 1990, 20-30.
    A linear spring between motor and link is the model of Spong, "Modeling and control of elastic joint
    robots", ASME Journal of Dynamic Systems, Measurement, and Control 109(4), 1987, 310-318.

    Attributes:
        kind: "joint_compliance".
        compliance_rad_per_Nm: compliance by name of a revolute joint [rad/(N m)]; 1e-6 to 1e-5 for industrial arms.
        compliance_m_per_N: compliance by name of a prismatic joint [m/N].
        links: masses and centres of mass of links by row name.
        payload: mass and centre of mass of the payload.
        gravity_m_per_s2: gravitational acceleration [m/s^2] in the frame of the first DH row (excluding `base`).
    """

    kind: Literal["joint_compliance"]
    compliance_rad_per_Nm: dict[str, Annotated[float, Field(ge=0)]] = Field(default_factory=dict)
    compliance_m_per_N: dict[str, Annotated[float, Field(ge=0)]] = Field(default_factory=dict)
    links: dict[str, LinkMass] = Field(default_factory=dict)
    payload: LinkMass = LinkMass(mass_kg=0.0)
    gravity_m_per_s2: Triple = (0.0, 0.0, -9.81)

    def bind(self, robot: Robot, place_in_recipe: str) -> JointErrorFunction:
        """Return the deflection as a function of the joint values; see `AbstractJointSource.bind`."""
        fields = ("compliance_rad_per_Nm", "compliance_m_per_N")
        stated = value_per_joint(
            robot, self.compliance_rad_per_Nm, self.compliance_m_per_N, fields, place_in_recipe
        )
        compliance = torch.from_numpy(stated)
        links = {row_index(robot, name, place_in_recipe): mass for name, mass in self.links.items()}
        payload, gravity = self.payload, self.gravity_m_per_s2
        return lambda q: compliance.to(q) * gravity_load(robot, q, links, payload, gravity)


def gravity_load(
    robot: Robot,
    q: Float[Tensor, "*batch dof"],
    links: dict[int, LinkMass],
    payload: LinkMass,
    gravity: Triple,
) -> Float[Tensor, "*batch dof"]:
    """Return the gravity torque [N m] or force [N] of every joint, with the sign of the controller's joint values.

    It is the negative derivative of the potential energy with respect to the joint values. The sum over the masses
    beyond a joint is kept as their total M and first moment S = Σ m r: `tau_j = z_j · ((S - M p_j) x g)`.

    Args:
        robot: the robot, whose base is ignored.
        q: joint values [rad or m].
        links: masses by index of the row.
        payload: mass in the tool frame.
        gravity: gravitational acceleration [m/s^2] in the frame of the first DH row.
    """
    columns = q.reshape(-1, robot.dof).t().contiguous().unbind(0)
    geometry = Geometry(robot.dh.tolist(), [0.0] * 6, robot.tool.tolist())
    frames = list(iterate_rows(robot, geometry, columns))
    fall = q.new_tensor(gravity)
    total, moment = (
        payload.mass_kg,
        _first_moment(payload, compose_xyz_zyx(frames[-1].after, geometry.tool), q),
    )
    loads: list[Tensor] = []
    for index in reversed(range(len(frames))):
        row, frame = robot.rows[index], frames[index]
        if index in links:
            total += links[index].mass_kg
            moment = moment + _first_moment(links[index], frame.after, q)
        if row.type == "fixed":
            continue
        axis, origin = as_transform(frame.before, columns[0])[:, :3, 2:].unbind(-1)
        force = (
            fall * total
            if row.type == "prismatic"
            else torch.linalg.cross(moment - total * origin, fall[None])
        )
        loads.append(row.direction * (axis * force).sum(-1))
    return torch.stack(loads[::-1], -1).reshape(q.shape)


def _first_moment(mass: LinkMass, frame: Frame, q: Tensor) -> Float[Tensor, "poses 3"]:
    """Return mass times centre of mass [kg m] in the frame of the first DH row."""
    T = as_transform(frame, q.reshape(-1, q.shape[-1])[:, 0])
    return mass.mass_kg * (T @ q.new_tensor([*(value / 1e3 for value in mass.centre_mm), 1.0]))[:, :3]
