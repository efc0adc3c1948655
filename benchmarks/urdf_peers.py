"""Poses of the tool of a URDF file in MuJoCo, pinocchio and Drake.

`python urdf_peers.py PEER FILE BASE TOOL < joint_values.json` reads joint values [[q_1, ...], ...] [rad or m] and
prints the poses of the link TOOL in the link BASE as JSON. It does not import pisigma, so the peers can be
installed in a separate environment:
`pip install mujoco pin drake==1.51.1` (the last Drake for Python 3.11).
"""

import json
import sys

import numpy as np


def mujoco_poses(path: str, q: np.ndarray, *links: str) -> list[np.ndarray]:
    """Return poses by MuJoCo, which compiles the unmodified file."""
    import mujoco

    spec = mujoco.MjSpec.from_file(path)
    spec.compiler.fusestatic = False
    model = spec.compile()
    data, poses = mujoco.MjData(model), []
    base, tool = (mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) for name in links)
    for values in q:
        data.qpos[:] = values
        mujoco.mj_kinematics(model, data)
        frames = []
        for body in (base, tool):
            T = np.eye(4)
            if body >= 0:  # the root of a URDF is the world itself
                T[:3, :3], T[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
            frames.append(T)
        poses.append(np.linalg.inv(frames[0]) @ frames[1])
    return poses


def pinocchio_poses(path: str, q: np.ndarray, *links: str) -> list[np.ndarray]:
    """Return poses by pinocchio, whose continuous joints take cosine and sine."""
    import pinocchio

    model = pinocchio.buildModelFromUrdf(path)
    data, poses = model.createData(), []
    base, tool = (model.getFrameId(name) for name in links)
    for values in q:
        stated: list[float] = []
        for joint, value in zip(model.joints[1:], values, strict=True):
            stated += [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
        pinocchio.framesForwardKinematics(model, data, np.array(stated))
        poses.append((data.oMf[base].inverse() * data.oMf[tool]).homogeneous)
    return poses


def drake_poses(path: str, q: np.ndarray, *links: str) -> list[np.ndarray]:
    """Return poses by Drake, with the base welded to the world."""
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    plant = MultibodyPlant(time_step=0.0)
    Parser(plant).AddModels(path)
    base, tool = (plant.GetFrameByName(name) for name in links)
    plant.WeldFrames(plant.world_frame(), base)
    plant.Finalize()
    context, poses = plant.CreateDefaultContext(), []
    for values in q:
        plant.SetPositions(context, values)
        poses.append(tool.CalcPose(context, base).GetAsMatrix4())
    return poses


PEERS = {"mujoco": mujoco_poses, "pinocchio": pinocchio_poses, "drake": drake_poses}

if __name__ == "__main__":
    peer, file, *links = sys.argv[1:]
    values = np.array(json.load(sys.stdin))
    print(json.dumps([np.asarray(pose).tolist() for pose in PEERS[peer](file, values, *links)]))
