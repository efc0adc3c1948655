"""The package robotkinecal: screw axes by Gauss-Newton, positions of one target."""

import numpy as np

from shared_benchmark.methods._dh import first_frames, flange_poses
from shared_benchmark.rows import Method, Predict, Prediction, Task


def fit(task: Task) -> Predict:
    """Fit the screw axes and the home pose, from the nominal arm with base and tool fitted.

    Raises:
        ValueError: there is more than one target, or a row without a joint.
    """
    import roboticstoolbox
    from robotkinecal import SerialRobotKineCal
    from spatialmath import SE3

    position = task.train.position
    assert position is not None
    if len(np.unique(task.train.target)) > 1 or not task.direction.all():
        raise ValueError("expected one target and a joint in every row")
    start = first_frames(flange_poses(task.dh, task.direction, task.train.q), task.train)
    zero = np.zeros((1, len(task.dh)))
    (home,) = start.poses(flange_poses(task.dh, task.direction, zero), task.train.target[:1])
    links = []
    for joint, sign in enumerate(task.direction):
        T = start.base @ flange_poses(task.dh[:joint], task.direction[:joint], zero)[0]
        links.append(roboticstoolbox.PoERevolute(sign * T[:3, 2], T[:3, 3]))
    peer = SerialRobotKineCal(roboticstoolbox.PoERobot(links, SE3(home, check=False)))
    peer.joint_screw_axis = peer.joint_screw_axis[1:-1]  # its first and last link are frames, not joints
    peer.N_JOINTS = joints = len(task.dh)
    peer.set_observations(list(task.train.q), list(position))
    peer.solve()
    return lambda rows: Prediction(np.stack([peer.forward_kinematics(joints + 1, q).A for q in rows.q]))


METHOD = Method(
    name="robotkinecal",
    title="robotkinecal, screw axes",
    source="Li, Wu, Loewe and Li 2016, IEEE Trans. Robotics 32(2)",
    packages=("robotkinecal", "numpy"),
    measured=("position", "pose"),
    fit=fit,
)
