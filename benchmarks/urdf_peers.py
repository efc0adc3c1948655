"""Poses and Jacobians of the tool of exported files in MuJoCo, pinocchio, Drake and the Robotics Toolbox.

`python urdf_peers.py PEER < requests.json` reads `[{"file": ..., "base": ..., "tool": ..., "q": [[q_1, ...], ...]}]`
with joint values [rad or m], and prints for every file the poses of the link, body or site `tool` in `base`, and the
geometric Jacobians of its origin in the axes of `base` (first of the position, then of the rotation), as JSON. Files
are URDF, MJCF, or DH tables as .csv or .json, from which `dh_models.py` builds the models. It does not import pisigma,
so the peers can be installed in a separate environment: `pip install mujoco pin roboticstoolbox-python drake==1.51.1`
(the last Drake for Python 3.11), and `pip install placo`, which requires another version of pinocchio, in another one.
"""

import json
import sys
from collections.abc import Iterator

import numpy as np
from dh_models import add_to_drake, mujoco_model, pinocchio_model, toolbox_model

Motion = tuple[np.ndarray, np.ndarray]
"""Pose (4, 4) and Jacobian (6, joints)."""


def is_table(path: str) -> bool:
    """Return whether a file is an exported DH table."""
    return path.endswith((".csv", ".json"))


def _in_base(T_base: np.ndarray, T_tool: np.ndarray, J: np.ndarray) -> Motion:
    """Convert a pose and a Jacobian from the axes of the world to those of a fixed base."""
    R = T_base[:3, :3].T
    return np.linalg.inv(T_base) @ T_tool, np.concatenate([R @ J[:3], R @ J[3:]])


def mujoco_motions(path: str, q: np.ndarray, *names: str) -> Iterator[Motion]:
    """Yield motions by MuJoCo, which compiles the unmodified file."""
    import mujoco

    spec = mujoco_model(path) if is_table(path) else mujoco.MjSpec.from_file(path)
    spec.compiler.fusestatic = False
    model = spec.compile()
    data = mujoco.MjData(model)

    def frame(name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose of a body or site, and the columns of its motion."""
        T, J = np.eye(4), np.zeros((2, 3, model.nv))
        if (site := mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)) >= 0:
            T[:3, :3], T[:3, 3] = data.site_xmat[site].reshape(3, 3), data.site_xpos[site]
            mujoco.mj_jacSite(model, data, J[0], J[1], site)
        elif (body := mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)) >= 0:
            T[:3, :3], T[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
            mujoco.mj_jacBody(model, data, J[0], J[1], body)
        return T, J.reshape(6, -1)  # the root of a URDF is the world itself

    for values in q:
        data.qpos[: len(values)] = values
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        T, J = frame(names[1])
        yield _in_base(frame(names[0])[0], T, J[:, : len(values)])


def pinocchio_motions(path: str, q: np.ndarray, *names: str) -> Iterator[Motion]:
    """Yield motions by pinocchio, whose continuous joints take cosine and sine."""
    import pinocchio

    model = pinocchio_model(path) if is_table(path) else pinocchio.buildModelFromUrdf(path)
    data = model.createData()
    base, tool = (model.getFrameId(name) for name in names)
    for values in q:
        stated: list[float] = []
        for joint, value in zip(model.joints[1:], values, strict=True):
            stated += [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
        pinocchio.computeJointJacobians(model, data, np.array(stated))
        pinocchio.updateFramePlacements(model, data)
        J = pinocchio.getFrameJacobian(model, data, tool, pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        yield _in_base(data.oMf[base].homogeneous, data.oMf[tool].homogeneous, J)


def drake_motions(path: str, q: np.ndarray, *names: str) -> Iterator[Motion]:
    """Yield motions by Drake, with the base welded to the world."""
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import JacobianWrtVariable

    plant = MultibodyPlant(time_step=0.0)
    if is_table(path):
        add_to_drake(path, plant)
    else:
        Parser(plant).AddModels(path)
    base, tool = (plant.GetFrameByName(name) for name in names)
    world = plant.world_frame()
    if base.body().index() not in [body.index() for body in plant.GetBodiesWeldedTo(plant.world_body())]:
        plant.WeldFrames(world, base)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    for values in q:
        plant.SetPositions(context, values)
        kind = JacobianWrtVariable.kQDot
        J = plant.CalcJacobianSpatialVelocity(context, kind, tool, np.zeros(3), base, base)
        yield tool.CalcPose(context, base).GetAsMatrix4(), np.concatenate([J[3:], J[:3]])


def toolbox_motions(path: str, q: np.ndarray, *names: str) -> Iterator[Motion]:
    """Yield motions by the Robotics Toolbox for Python."""
    import roboticstoolbox

    robot = toolbox_model(path) if is_table(path) else roboticstoolbox.Robot.URDF(path)
    ends = {} if is_table(path) else {"end": names[1], "start": names[0]}
    for values in q:
        yield robot.fkine(values, **ends).A, robot.jacob0(values, **ends)


def placo_motions(path: str, q: np.ndarray, *names: str) -> Iterator[Motion]:
    """Yield motions by placo, whose arms have a floating base."""
    import placo

    robot = placo.RobotWrapper(path, placo.Flags.ignore_collisions)
    for values in q:
        robot.state.q[7:] = values
        robot.update_kinematics()
        T_base, T_tool = (robot.get_T_world_frame(name) for name in names)
        J = robot.frame_jacobian(names[1], "local_world_aligned")[:, 6:]
        yield _in_base(T_base, T_tool, J)


PEERS = {
    "placo": placo_motions,
    "mujoco": mujoco_motions,
    "pinocchio": pinocchio_motions,
    "drake": drake_motions,
    "toolbox": toolbox_motions,
}

if __name__ == "__main__":
    answers = []
    for one in json.load(sys.stdin):
        motions = PEERS[sys.argv[1]](one["file"], np.array(one["q"]), one["base"], one["tool"])
        poses, jacobians = zip(*motions, strict=True)
        answers.append({"poses": np.stack(poses).tolist(), "jacobians": np.stack(jacobians).tolist()})
    print(json.dumps(answers))
