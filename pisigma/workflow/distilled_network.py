"""The network into which a calibrated model is distilled: sizes, fitting and model selection."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import IdentificationError
from pisigma.files.progress import Progress, with_stage
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

_VALIDATION_SHARE = 0.1

_OVERTONE_SCALE = 1e4
"""Factor by which overtones are scaled down, and their weights up, after the fit. Overtones do not show where a joint
is within its range, and the domain is measured in scaled inputs."""

_NEGLIGIBLE_ERROR = 5e-6
"""RMS error of the tool's position [m] below which no larger size is tried, because no robot repeats better."""
_ABOUT_AS_GOOD = 1.1
"""Largest ratio of a smaller size's error to the best error at which the smaller size is chosen."""
_MIN_POSES_PER_UNKNOWN = 4
"""Minimum number of poses for each unknown of a size."""

_MIN_MOTION = 1e-6
"""Motion over the region [rad or m] below which a joint is not an input."""


@dataclass(frozen=True)
class NetworkSize:
    """Size of the networks of all joints.

    Attributes:
        orders: number of summing units of every product unit.
        harmonics: highest multiple of the corrected joint's value whose sine and cosine are inputs, in addition to the
            sine and cosine of every joint's value.
    """

    orders: tuple[int, ...]
    harmonics: int = 1

    def unknowns(self, robot: Robot) -> int:
        """Number of weights and biases per joint."""
        inputs = sum(2 if revolute else 1 for revolute in robot.revolute) + 2 * (self.harmonics - 1)
        return sum(self.orders) * (inputs + 1)


_SMOOTH = (NetworkSize((1, 2)), NetworkSize((1, 2, 3)), NetworkSize((1, 2, 3, 4)))
"""Sizes for errors that vary slowly with the joints: geometry and sag."""
_RIPPLED = (
    NetworkSize((1, 2)),
    NetworkSize((1, 2, 3)),
    NetworkSize((1, 2, 3), 8),
    NetworkSize((1, 2, 3), 24),
)
"""Sizes for models that also have ripple of gears and encoders."""


def sizes_for(model: CalibratedModel, poses: int) -> tuple[NetworkSize, ...]:
    """Return the sizes to try for a model, in ascending order, given the number of poses to fit.

    Raises:
        IdentificationError: there are too few poses for any size.
    """
    learned = () if model.hybrid is None else model.hybrid.correction.features
    rippled = any(features.highest_harmonic > 1 for features in learned)
    sizes = tuple(
        size
        for size in (_RIPPLED if rippled else _SMOOTH)
        if size.unknowns(model.robot) * _MIN_POSES_PER_UNKNOWN <= poses
    )
    if not sizes:
        raise IdentificationError(
            f"{poses} poses are too few for a network of any size for robot '{model.robot.name}'",
            value=poses,
            option="--poses",
            remedy="give more, or the orders of a small network",
        )
    return sizes


def choose_network(
    parent: CalibratedModel,
    poses: SolvedPoses,
    fit_and_selection: tuple[slice, slice],
    sizes: tuple[NetworkSize, ...],
    seed: int,
    max_iterations: int,
    progress: Progress,
) -> tuple[CorrectionNetwork, tuple[SizeFigures, ...]]:
    """Return the smallest network that is about as good as the best one, and the figures of all candidates.

    Args:
        parent: the model that is distilled.
        poses: poses with the full solutions of the model.
        fit_and_selection: slices of the poses to fit and of the poses for model selection.
        sizes: sizes to fit, in ascending order.
        seed: random seed.
        max_iterations: maximum number of iterations per joint.
        progress: called with the current step.
    """
    pairs = _pairs(poses, fit_and_selection[0])
    fits: list[tuple[CorrectionNetwork, NetworkSize, float]] = []
    for size in sizes:
        of_size = with_stage(progress, f"orders {size.orders}, harmonics {size.harmonics}")
        network = _fit_size(parent.robot, size, pairs, seed, max_iterations, of_size)
        T, q = poses.T[fit_and_selection[1]], poses.q_nominal[fit_and_selection[1]]
        with torch.no_grad():
            reached = parent.forward(q + network(T, q))
        error = float((reached[:, :3, 3] - T[:, :3, 3]).square().sum(-1).mean().sqrt())
        fits.append((network, size, error))
        if error < _NEGLIGIBLE_ERROR:
            break
    best = min(error for *_, error in fits)
    bound = max(_ABOUT_AS_GOOD * best, _NEGLIGIBLE_ERROR)
    kept = next(k for k, (*_, error) in enumerate(fits) if error <= bound)
    sizes_tried = tuple(
        SizeFigures(
            orders=size.orders,
            harmonics=size.harmonics,
            unknowns=size.unknowns(parent.robot),
            rms_mm=error * 1e3,
            is_selected=k == kept,
        )
        for k, (_, size, error) in enumerate(fits)
    )
    return fits[kept][0], sizes_tried


def _pairs(poses: SolvedPoses, rows: slice) -> TrainingPairs:
    q_nominal = poses.q_nominal[rows]
    every = torch.ones(len(q_nominal), dtype=torch.bool)
    return TrainingPairs(poses.T[rows], q_nominal, poses.correction[rows], every, ~every, ~every, ())


def _fit_size(
    robot: Robot, size: NetworkSize, pairs: TrainingPairs, seed: int, epochs: int, progress: Progress
) -> CorrectionNetwork:
    """Fit a network of a size to corrections by Levenberg-Marquardt.

    Args:
        robot: the nominal robot.
        size: size of the network.
        pairs: nominal joint values and their corrections.
        seed: random seed of the start and of the validation rows.
        epochs: maximum number of iterations per joint.
        progress: called with the names of the joints that are fitted.

    Raises:
        IdentificationError: no joint moves in the region, or there are too few poses.
        TrainingError: the fit diverged.
    """
    section = LevenbergMarquardtSection(
        method="levenberg_marquardt", epochs=epochs, starts=1, validation_share=_VALIDATION_SHARE, seed=seed
    )
    sections = _sections(robot, size, pairs.q_nominal)
    groups: list[JointGroup] = []
    networks: list[PiSigma] = []
    rows = torch.arange(len(pairs.target))
    for part in sections:
        progress(", ".join(part.joints))
        network = build_network(robot, [part], pairs)
        generator = torch.Generator().manual_seed(seed)
        patterns = build_patterns(network, pairs, _VALIDATION_SHARE, rows, generator)
        ((group, net),) = network.members()
        fit_networks([net], patterns, [part.joints], section)
        _shrink_overtones(net, group.inputs)
        groups.append(group)
        networks.append(net)
    return CorrectionNetwork(robot.dof, groups, networks).requires_grad_(False)


def _sections(robot: Robot, size: NetworkSize, q: Float64[Tensor, "poses dof"]) -> list[NetworkSection]:
    """Return one group of all joints, or one group per joint if overtones are inputs.

    Raises:
        IdentificationError: no joint moves in the region.
    """
    names = [joint.name for joint in robot.joints]
    moves = ((q.amax(0) - q.amin(0)) > _MIN_MOTION).tolist()
    shared: list[str] = []
    for name, revolute, moving in zip(names, robot.revolute, moves, strict=True):
        if moving:
            shared += [f"sin({name})", f"cos({name})"] if revolute else [name]
    if not shared:
        raise IdentificationError(
            "all poses to distil from have the same joint values",
            expected="poses with different joint values",
            remedy="give a larger region, or joint values that differ",
        )
    if size.harmonics == 1:
        return [NetworkSection(joints=tuple(names), inputs=tuple(shared), orders=size.orders)]
    sections = []
    for name, revolute, moving in zip(names, robot.revolute, moves, strict=True):
        multiples = range(2, size.harmonics + 1) if revolute and moving else ()
        overtones = [f"{function}({k}*{name})" for k in multiples for function in ("sin", "cos")]
        sections.append(NetworkSection(joints=(name,), inputs=(*shared, *overtones), orders=size.orders))
    return sections


@torch.no_grad()
def _shrink_overtones(network: PiSigma, inputs: Inputs) -> None:
    """Scale inputs that are multiples of a joint's value down, and their weights up, keeping the output unchanged."""
    overtone = [max(inputs.combination(name)[1]) > 1 for name in inputs.names]
    factor = torch.where(torch.tensor(overtone), _OVERTONE_SCALE, 1.0).double()
    network.input_scale.mul_(factor)
    network.weight.mul_(factor)
