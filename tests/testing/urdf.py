"""URDF files for tests, and other libraries' poses of a chain for comparison."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

LIMITS = '<limit lower="-3.0" upper="3.0" effort="1" velocity="1"/>'


@dataclass(frozen=True)
class UrdfJoint:
    """A joint of a file; rpy [rad] are rotations about the fixed axes x, y, z."""

    type: str
    xyz: Sequence[float]
    rpy: Sequence[float]
    axis: Sequence[float] = (0.0, 0.0, 1.0)


def urdf_text(joints: Sequence[UrdfJoint]) -> str:
    """Return a chain of links l0, l1, ... with joints j1, j2, ..."""
    words = ['<robot name="chain"><link name="l0"/>']
    for i, joint in enumerate(joints, 1):
        xyz, rpy, axis = (" ".join(map(repr, map(float, v))) for v in (joint.xyz, joint.rpy, joint.axis))
        words.append(
            f'<link name="l{i}"/><joint name="j{i}" type="{joint.type}"><origin xyz="{xyz}" rpy="{rpy}"/>'
            f'<parent link="l{i - 1}"/><child link="l{i}"/><axis xyz="{axis}"/>'
            f"{LIMITS if joint.type in ('revolute', 'prismatic') else ''}</joint>"
        )
    return "\n".join([*words, "</robot>\n"])


def pose_of_chain(joints: Sequence[UrdfJoint], q: Sequence[float]) -> np.ndarray:
    """Compute the pose of the last link by the definition of the format, with scipy's rotations."""
    values, T = iter(q), np.eye(4)
    for joint in joints:
        T = T @ _frame(Rotation.from_euler("xyz", joint.rpy), joint.xyz)
        axis = np.asarray(joint.axis, dtype=np.float64)
        axis = axis / np.linalg.norm(axis)
        if joint.type == "prismatic":
            T = T @ _frame(Rotation.identity(), next(values) * axis)
        elif joint.type != "fixed":
            T = T @ _frame(Rotation.from_rotvec(next(values) * axis), np.zeros(3))
    return T


def peer_poses(path: Path, tip: str, q: torch.Tensor) -> torch.Tensor:
    """Compute poses of a link with pytorch-kinematics: its parser, frames and forward kinematics, in float64.

    Its `build_chain_from_urdf` does the same in float32, regardless of the dtype requested afterwards.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the peer's imports are not ours to mend
        from pytorch_kinematics import Transform3d, frame, quaternion_from_euler
        from pytorch_kinematics.chain import Chain, SerialChain
        from pytorch_kinematics.urdf import JOINT_TYPE_MAP
        from pytorch_kinematics.urdf_parser_py.urdf import URDF

    urdf = URDF.from_xml_string(path.read_bytes())

    def below(parent: "frame.Frame") -> None:
        for joint in (j for j in urdf.joints if j.parent == parent.link.name):
            rpy = quaternion_from_euler(torch.tensor(joint.origin.rpy, dtype=torch.float64), "sxyz")
            offset = Transform3d(
                rot=rpy, pos=torch.tensor(joint.origin.xyz, dtype=torch.float64), dtype=torch.float64
            )
            child = frame.Frame(joint.child, frame.Link(joint.child))
            child.joint = frame.Joint(
                joint.name, offset, JOINT_TYPE_MAP[joint.type], joint.axis, dtype=torch.float64
            )
            parent.children.append(child)
            below(child)

    root = frame.Frame(urdf.get_root(), frame.Link(urdf.get_root()), frame.Joint(dtype=torch.float64))
    below(root)
    chain = SerialChain(Chain(root, dtype=torch.float64), tip, dtype=torch.float64)
    return chain.forward_kinematics(q).get_matrix()


def _frame(rotation: Rotation, xyz: Sequence[float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), xyz
    return T
