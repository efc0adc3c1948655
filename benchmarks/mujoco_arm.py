"""An arm with errors in MuJoCo: a drawn URDF with changed bodies and joints, position controllers and a reflector.

MuJoCo reads the drawn URDF file. Then poses of bodies are changed, joints become elastic or have free play, and a
payload is attached to the tip. The module does not use pisigma.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import files
from pathlib import Path

import mujoco
import numpy as np
from lxml import etree
from scipy.spatial.transform import Rotation

STEP_S = 2e-3
"""Step of the simulation."""
RAMP_S = 0.3
"""Duration of a motion from one commanded pose to the next."""
SETTLING_S = 1.0
"""Longest time to wait after a motion."""
AT_REST = 1e-8
"""Speed [rad/s or m/s] below which an arm is at rest; it is then 2e-10 rad from its equilibrium."""
SERVO_LAG_S = 0.02
"""Damping over stiffness of controllers and elastic joints: the time constant with which they settle."""
REFLECTOR = (0.06, 0.02, 0.12)
"""Position of the reflector in the frame of the tip [m]."""
PAYLOAD_AT = (0.0, 0.01, 0.08)
"""Centre of mass of the payload in the frame of the tip [m]."""
MAX_COMMAND = 100.0
"""Largest joint value [rad or m] that a controller accepts."""
GEAR = " gear"
"""Suffix of the name of an elastic gear after the name of its joint."""
ROTOR = 0.1
"""Inertia of a rotor [kg m²], or mass of a drive [kg]."""


@dataclass(frozen=True)
class ArmErrors:
    """Differences of the true arm from the drawn one.

    Attributes:
        length_mm: standard deviation of the position of every body in its parent, per axis [mm].
        axis_mrad: standard deviation of the orientation of every body in its parent, about each axis [mrad].
        zero_mrad: standard deviation of the zero of a revolute joint [mrad].
        zero_mm: standard deviation of the zero of a prismatic joint [mm].
        elastic: stiffness of the gears of revolute joints [Nm/rad], in the order of the joints; the last one also
            applies to all others. Empty for rigid gears.
        play_deg: free play of every elastic gear [deg].
    """

    length_mm: float = 0.5
    axis_mrad: float = 0.5
    zero_mrad: float = 1.0
    zero_mm: float = 0.5
    elastic: tuple[float, ...] = ()
    play_deg: float = 0.0


@dataclass(frozen=True)
class DrawnArm:
    """A drawn arm and its controllers.

    Attributes:
        file: name of the URDF file, in `drawn_arms` or in a package.
        base: link in whose frame pisigma states poses.
        tip: link that carries reflector and payload.
        kp: stiffness of the position controllers [Nm/rad, or N/m for prismatic joints], in the order of the joints; the
            last one also applies to all others.
        elastic: stiffness of elastic gears, see `ArmErrors`.
        package: installed package with the file; None for `drawn_arms`.
    """

    file: str
    base: str | None
    tip: str
    kp: tuple[float, ...]
    elastic: tuple[float, ...]
    package: str | None = None

    @cached_property
    def urdf(self) -> Path:
        """The URDF file."""
        if self.package is None:
            return Path(__file__).resolve().parent / "drawn_arms" / self.file
        named = (one for one in files(self.package) or () if one.name == self.file)
        return Path(str(next(named).locate()))


@dataclass(frozen=True)
class Driven:
    """Result of driving an arm through commanded poses.

    Attributes:
        position: true positions of the reflector in the world [m], shape (poses, 3).
        encoders: joint values [rad or m] that the encoders read, shape (poses, joints).
        torque: torques or forces of the drives on the joints [Nm or N], shape (poses, joints): `qfrc_actuator`.
        unsettled: largest joint speed when a pose was measured [rad/s or m/s].
    """

    position: np.ndarray
    encoders: np.ndarray
    torque: np.ndarray
    unsettled: float


class PerturbedArm:
    """An arm in MuJoCo that differs from its drawing."""

    def __init__(self, drawn: DrawnArm, errors: ArmErrors, seed: int, payload_kg: float = 0.0) -> None:
        """Build the arm; equal seeds make equal arms, with any payload."""
        spec = mujoco.MjSpec.from_string(_without_shapes(drawn.urdf))
        spec.option.timestep = STEP_S
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        rng = np.random.default_rng(seed)
        chain = _chain(spec.body(drawn.tip))
        names = {body.name for body in chain}
        for part in [*spec.equalities, *(one for one in spec.joints if one.parent.name not in names)]:
            spec.delete(part)  # grippers are locked
        self.joints: list[str] = []
        for body in chain:
            if body.joints:
                _perturb_body(body, body.joints[0], errors, rng)
                _add_gear(body, body.joints[0], errors, len(self.joints))
                _add_controller(spec, body.joints[0], _of(drawn.kp, len(self.joints)))
                self.joints.append(body.joints[0].name)
        tip = spec.body(drawn.tip)
        tip.add_site(name="reflector", pos=REFLECTOR)
        if payload_kg:
            inertia = payload_kg * 0.05**2 * 0.4  # a ball of 50 mm
            tip.add_body(
                name="payload", pos=PAYLOAD_AT, mass=payload_kg, inertia=[inertia] * 3, explicitinertial=True
            )
        self.model = spec.compile()
        self.spec = spec
        self.data = mujoco.MjData(self.model)
        self._drives = [self.model.joint(name).dofadr[0] for name in self.joints]
        self._encoders = [self.model.joint(name).qposadr[0] for name in self.joints]
        joints = [self.model.joint(k) for k in range(self.model.njnt)]
        self._gears = [joint.qposadr[0] for joint in joints if joint.name.endswith(GEAR)]
        self._play = np.deg2rad(errors.play_deg / 2)

    def drive(self, commands: np.ndarray, servo: int = 0) -> Driven:
        """Move to the commanded joint values in their order, and measure each pose after the arm has come to rest.

        Args:
            commands: joint values [rad or m], shape (poses, joints), as commanded to the controllers.
            servo: number of corrections of every command by the difference between command and encoders, as by
                controllers with an integral part; with 0 the deviation of a proportional controller remains.
        """
        if not np.abs(commands).max() < MAX_COMMAND:
            raise ValueError(f"a joint value of {np.abs(commands).max():g} was commanded")
        positions, encoders, torques, unsettled = [], [], [], 0.0
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self._encoders] = commands[0]
        self.data.ctrl[:] = commands[0]
        for command in commands:
            self._move_to(command)
            for _ in range(servo):
                self._move_to(self.data.ctrl + command - self.data.qpos[self._encoders])
            mujoco.mj_forward(self.model, self.data)
            unsettled = max(unsettled, float(np.abs(self.data.qvel).max()))
            positions.append(self.data.site("reflector").xpos.copy())
            encoders.append(self.data.qpos[self._encoders].copy())
            torques.append(self.data.qfrc_actuator[self._drives].copy())
        return Driven(np.array(positions), np.array(encoders), np.array(torques), unsettled)

    def _move_to(self, command: np.ndarray) -> None:
        before = self.data.ctrl.copy()
        steps = round(RAMP_S / STEP_S)
        for k in range(1, steps + 1):
            self.data.ctrl[:] = before + (command - before) * (1 - np.cos(np.pi * k / steps)) / 2
            self._step()
        for k in range(1, round(SETTLING_S / STEP_S) + 1):
            self._step()
            if k % 25 == 0 and np.abs(self.data.qvel).max() < AT_REST:
                return

    def _step(self) -> None:
        """Advance by a step; the springs of gears act only outside their play."""
        if self._play:
            self.model.qpos_spring[self._gears] = np.clip(
                self.data.qpos[self._gears], -self._play, self._play
            )
        mujoco.mj_step(self.model, self.data)


def _without_shapes(urdf: Path) -> bytes:
    """Return a URDF file without shapes, but with all links."""
    root = etree.parse(urdf).getroot()
    for kind in ("visual", "collision", "transmission", "gazebo", "material"):
        for element in list(root.iter(kind)):
            element.getparent().remove(element)
    etree.SubElement(etree.SubElement(root, "mujoco"), "compiler", fusestatic="false")
    return etree.tostring(root).decode()


def _chain(tip: "mujoco.MjsBody") -> "list[mujoco.MjsBody]":
    """Return the bodies from the base to the tip."""
    chain = [tip]
    while chain[0].parent.name != "world":
        chain.insert(0, chain[0].parent)
    return chain


def _of(values: Sequence[float], joint: int) -> float:
    return values[min(joint, len(values) - 1)]


def _perturb_body(
    body: "mujoco.MjsBody", joint: "mujoco.MjsJoint", errors: ArmErrors, rng: np.random.Generator
) -> None:
    """Change the pose of a body in its parent, and the zero of its joint."""
    drawn = Rotation.from_quat(body.quat, scalar_first=True)
    axis = np.asarray(joint.axis) / np.linalg.norm(joint.axis)
    tilt = Rotation.from_rotvec(rng.normal(0, errors.axis_mrad * 1e-3, 3))
    shift, zero = rng.normal(0, errors.length_mm * 1e-3, 3), rng.normal()
    true = drawn * tilt
    if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
        true = true * Rotation.from_rotvec(axis * zero * errors.zero_mrad * 1e-3)
    else:
        shift = shift + true.apply(axis * zero * errors.zero_mm * 1e-3)
    body.quat, body.pos = true.as_quat(scalar_first=True), body.pos + shift
    joint.limited = joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    joint.armature = ROTOR


def _add_gear(body: "mujoco.MjsBody", joint: "mujoco.MjsJoint", errors: ArmErrors, number: int) -> None:
    """Add a coaxial joint after the encoder of a revolute joint, as its elastic gear."""
    if not errors.elastic or joint.type != mujoco.mjtJoint.mjJNT_HINGE:
        return
    stiffness = _of(errors.elastic, number)
    body.add_joint(
        name=f"{joint.name}{GEAR}",
        type=joint.type,
        axis=joint.axis,
        stiffness=stiffness,
        damping=stiffness * SERVO_LAG_S,
        armature=ROTOR / 10,
    )


def _add_controller(spec: "mujoco.MjSpec", joint: "mujoco.MjsJoint", kp: float) -> None:
    controller = spec.add_actuator(
        name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT, ctrllimited=False
    )
    controller.gaintype, controller.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    controller.gainprm[0] = kp
    controller.biasprm[:3] = [0, -kp, -kp * SERVO_LAG_S]
