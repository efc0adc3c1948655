"""The network that a calibrated model is distilled into: sizes, fitting one, and choosing among them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import IdentificationError
from pisigma.files.progress import Progress, stage
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.network.correction_network import CorrectionNetwork, JointGroup
from pisigma.network.inputs import Inputs
from pisigma.network.networks import fit_networks
from pisigma.network.pairs import TrainingPairs
from pisigma.network.patterns import build_network, build_patterns
from pisigma.network.pi_sigma import PiSigma
from pisigma.network.sections import LevenbergMarquardtSection, NetworkSection
from pisigma.robot.description import Robot
from pisigma.validation.held_out.distillation_summary import SizeFigures
from pisigma.workflow.solved_poses import SolvedPoses

VALIDATION_SHARE = 0.1

OVERTONE_SCALE = 1e4
"""Overtones are scaled down by so much after the fit, and their weights up: they do not say where a joint is, and the
domain is measured in scaled inputs."""

ENOUGH = 5e-6
"""[m] RMS of the tool's error below which no larger size is tried: no robot repeats so well."""
AS_GOOD = 1.1
"""A smaller size is taken where its error is not larger than the best one's times this."""
ROWS_PER_UNKNOWN = 4
"""A size is tried where there are so many poses for each of its unknowns."""

_STILL = 1e-6
"""[rad or m] A joint that moves less over the region is no input."""


@dataclass(frozen=True)
class Size:
    """A network: the same for every joint.

    Attributes:
        orders: number of summing units of every product unit.
        harmonics: sines and cosines of up to so many times the corrected joint's own value are inputs, besides those of
            all joints' own values.
    """

    orders: tuple[int, ...]
    harmonics: int = 1

    def unknowns(self, robot: Robot) -> int:
        """Number of weights and biases per joint."""
        inputs = sum(2 if turns else 1 for turns in robot.revolute) + 2 * (self.harmonics - 1)
        return sum(self.orders) * (inputs + 1)


SMOOTH = (Size((1, 2)), Size((1, 2, 3)), Size((1, 2, 3, 4)))
"""Sizes for what varies slowly with the joints: geometry, and arms that sag."""
RIPPLED = (Size((1, 2)), Size((1, 2, 3)), Size((1, 2, 3), 8), Size((1, 2, 3), 24))
"""Sizes where gears and encoders run out of true as well."""


def sizes_for(model: CalibratedModel, poses: int) -> tuple[Size, ...]:
    """Give the sizes to try for a model with so many poses to fit, small ones first.

    Raises:
        IdentificationError: the poses are too few for any size.
    """
    learned = () if model.hybrid is None else model.hybrid.correction.features
    rippled = any(features.fastest > 1 for features in learned)
    sizes = tuple(
        size
        for size in (RIPPLED if rippled else SMOOTH)
        if size.unknowns(model.robot) * ROWS_PER_UNKNOWN <= poses
    )
    if not sizes:
        raise IdentificationError(
            f"{poses} poses are too few for any size of network for robot '{model.robot.name}'; give "
            "more, or the orders of a small one."
        )
    return sizes


def choose_network(
    parent: CalibratedModel,
    poses: SolvedPoses,
    chosen: tuple[slice, slice],
    sizes: tuple[Size, ...],
    search: tuple[int, int],
    progress: Progress,
) -> tuple[CorrectionNetwork, tuple[SizeFigures, ...]]:
    """Give the smallest network that is about as good as the best, and all that were tried.

    Args:
        parent: the model that is distilled.
        poses: with its full solutions.
        chosen: which of them to fit to, and which to choose by.
        sizes: to fit, small ones first.
        search: seed, and largest number of iterations for a joint.
        progress: called with what is being done.
    """
    pairs = _pairs(poses, chosen[0])
    fits: list[tuple[CorrectionNetwork, Size, float]] = []
    for size in sizes:
        of_size = stage(progress, f"orders {size.orders}, harmonics {size.harmonics}")
        network = _fit_size(parent.robot, size, pairs, *search, of_size)
        T, q = poses.T[chosen[1]], poses.q_nominal[chosen[1]]
        with torch.no_grad():
            reached = parent.forward(q + network(T, q))
        error = float((reached[:, :3, 3] - T[:, :3, 3]).square().sum(-1).mean().sqrt())
        fits.append((network, size, error))
        if error < ENOUGH:
            break
    best = min(error for *_, error in fits)
    kept = next(k for k, (*_, error) in enumerate(fits) if error <= max(AS_GOOD * best, ENOUGH))
    sizes_tried = tuple(
        SizeFigures(
            orders=size.orders,
            harmonics=size.harmonics,
            unknowns=size.unknowns(parent.robot),
            rms_mm=error * 1e3,
            kept=k == kept,
        )
        for k, (_, size, error) in enumerate(fits)
    )
    return fits[kept][0], sizes_tried


def _pairs(poses: SolvedPoses, rows: slice) -> TrainingPairs:
    q_nominal = poses.q_nominal[rows]
    every = torch.ones(len(q_nominal), dtype=torch.bool)
    return TrainingPairs(poses.T[rows], q_nominal, poses.correction[rows], every, ~every, ~every, ())


def _fit_size(
    robot: Robot, size: Size, pairs: TrainingPairs, seed: int, epochs: int, progress: Progress
) -> CorrectionNetwork:
    """Fit a network of a size to corrections by Levenberg-Marquardt.

    Args:
        robot: the nominal robot.
        size: of the network.
        pairs: nominal joint values and their corrections.
        seed: of start and validation rows.
        epochs: largest number of iterations for a joint.
        progress: called with what is being done.

    Raises:
        IdentificationError: no joint moves in the region, or there are too few poses.
        TrainingError: the fit diverged.
    """
    section = LevenbergMarquardtSection(
        method="levenberg_marquardt", epochs=epochs, starts=1, validation_share=VALIDATION_SHARE, seed=seed
    )
    sections = _sections(robot, size, pairs.q_nominal)
    groups: list[JointGroup] = []
    networks: list[PiSigma] = []
    rows = torch.arange(len(pairs.target))
    for part in sections:
        progress(", ".join(part.joints))
        network = build_network(robot, [part], pairs)
        generator = torch.Generator().manual_seed(seed)
        patterns = build_patterns(network, pairs, VALIDATION_SHARE, rows, generator)
        ((group, net),) = network.members()
        fit_networks([net], patterns, [part.joints], section)
        _shrink_overtones(net, group.inputs)
        groups.append(group)
        networks.append(net)
    return CorrectionNetwork(robot.dof, groups, networks).requires_grad_(False)


def _sections(robot: Robot, size: Size, q: Float64[Tensor, "poses dof"]) -> list[NetworkSection]:
    """One group of all joints, or one of each joint where its overtones are inputs."""
    names = [joint.name for joint in robot.joints]
    moves = ((q.amax(0) - q.amin(0)) > _STILL).tolist()
    shared: list[str] = []
    for name, turns, moving in zip(names, robot.revolute, moves, strict=True):
        if moving:
            shared += [f"sin({name})", f"cos({name})"] if turns else [name]
    if not shared:
        raise IdentificationError(
            "no joint moves among the poses to distil from; give a larger region, or joint values that differ."
        )
    if size.harmonics == 1:
        return [NetworkSection(joints=tuple(names), inputs=tuple(shared), orders=size.orders)]
    sections = []
    for name, turns, moving in zip(names, robot.revolute, moves, strict=True):
        multiples = range(2, size.harmonics + 1) if turns and moving else ()
        overtones = [f"{function}({k}*{name})" for k in multiples for function in ("sin", "cos")]
        sections.append(NetworkSection(joints=(name,), inputs=(*shared, *overtones), orders=size.orders))
    return sections


@torch.no_grad()
def _shrink_overtones(network: PiSigma, inputs: Inputs) -> None:
    """Scale inputs of multiples of a joint's value down and their weights up, which changes no output."""
    overtone = [max(inputs.combination(name)[1]) > 1 for name in inputs.names]
    factor = torch.where(torch.tensor(overtone), OVERTONE_SCALE, 1.0).double()
    network.input_scale.mul_(factor)
    network.weight.mul_(factor)
