"""Own feature: how to write a joint correction, here for a belt that stretches in proportion to the joint value."""

import torch
from matplotlib.figure import Figure

from pisigma import HybridCalibrator, Measurements, Robot, register_feature
from pisigma.joint_correction.feature import AbstractFeature, scaled_joints
from pisigma.robot.kinematics.forward import forward_kinematics


@register_feature
class Belt(AbstractFeature):
    """`Δ_j = s_j · q_j`, with the joint value scaled to -1 ... 1 between the limits."""

    name = "belt"
    group_names = ("belt",)

    def __init__(self, robot):
        """Use one weight per joint."""
        super().__init__(robot)
        self.used = torch.ones(robot.dof, 1, dtype=torch.bool)
        self.group = torch.zeros(robot.dof, 1, dtype=torch.int64)

    def columns(self, state):
        """Return the scaled joint values."""
        return scaled_joints(self.robot, state.q)[..., None]

    def is_periodic(self, weight):
        """Return False: a full turn of a joint stretches the belt."""
        return False


robot = Robot.load("ur5")
stretch = torch.tensor([2e-3, 0, 1e-3, 0, -3e-3, 0], dtype=torch.float64)
generator = torch.Generator().manual_seed(0)
q = 4 * torch.rand(150, 6, generator=generator, dtype=torch.float64) - 2
position = forward_kinematics(robot, q + stretch * scaled_joints(robot, q))[:, :3, 3]
noise = 3e-5 * torch.randn(150, 3, generator=generator, dtype=torch.float64)
rows = Measurements(q=q, position=position + noise)
result = HybridCalibrator(robot, features=("belt",)).fit(rows)
print(result.verdict)

figure = Figure(figsize=(4, 3), layout="constrained")
axes = figure.subplots()
correction = result.learned.correction.for_rows(rows)
true_mrad, learned_mrad = 1e3 * stretch * scaled_joints(robot, q), 1e3 * correction
for joint in (0, 2, 4):
    axes.plot(true_mrad[:, joint], learned_mrad[:, joint], ".", label=robot.joints[joint].name)
axes.set(xlabel="true correction [mrad]", ylabel="learned correction [mrad]", title="Own feature")
axes.legend()
figure.savefig("own_feature.png", dpi=100)
