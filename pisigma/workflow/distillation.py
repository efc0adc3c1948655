"""Inverse distillation: a calibrated model as a small Pi-Sigma network on nominal joint values.

Jeong et al. 1998 learn `Δθ = θ_measured - θ_analytic` from measurements; here the full solution of a model takes the
place of θ_measured, for poses of a region.
"""

import platform
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import IdentificationError, ModelError
from pisigma.inverse.torch_ik import NUMERIC, TorchIK
from pisigma.model.calibrated_model import CalibratedModel, Provenance
from pisigma.model.domain import Domain
from pisigma.model.stored_starts import spread_rows
from pisigma.network.correction_network import CorrectionNetwork
from pisigma.training.pairs import TrainingPairs
from pisigma.workflow.distilled_sizes import Size, fit_size, sizes_for
from pisigma.workflow.solved_poses import Region, SolvedPoses, draw_solved_poses

POSES = 5_000
CHOICE_SHARE, HELD_OUT_SHARE = 0.2, 0.4
"""Poses that sizes are chosen by, and poses that the chosen one is judged by, beside one that is fitted to."""

ENOUGH = 5e-6
"""[m] RMS of the tool's error below which no larger size is tried: no robot repeats so well."""
AS_GOOD = 1.1
"""A smaller size is taken where its error is not larger than the best one's times this."""

DOMAIN_SAMPLES = 512

_FEWEST = 100


@dataclass(frozen=True)
class DistillationSettings:
    """How a model is distilled.

    Attributes:
        poses: to fit to; others are drawn besides for choosing and judging.
        size: the only one to fit; None tries those of `sizes_for`.
        seed: of poses and starts.
        epochs: largest number of iterations for a joint.
    """

    poses: int = POSES
    size: Size | None = None
    seed: int = 0
    epochs: int = 80


@dataclass(frozen=True)
class Trial:
    """A size that was fitted.

    Attributes:
        size: of the network.
        unknowns: of a joint.
        error: RMS of the tool's error against the full solution, over the poses for choosing [m].
        kept: whether it was chosen.
    """

    size: Size
    unknowns: int
    error: float
    kept: bool


@dataclass(frozen=True, eq=False)
class Distillation:
    """What distilling a model gave.

    Attributes:
        model: the distilled model, not yet written.
        parent: the model it was distilled from.
        region: where.
        trials: sizes that were fitted, in order.
        fitted: number of poses that the network was fitted to, validation rows among them.
        held_out: poses that were neither fitted to nor chosen by.
        predicted: what the network adds to their nominal joint values [rad or m].
    """

    model: CalibratedModel
    parent: CalibratedModel
    region: Region
    trials: tuple[Trial, ...]
    fitted: int
    held_out: SolvedPoses
    predicted: Float64[Tensor, "poses dof"]


def distill(
    name: str,
    parent: CalibratedModel,
    region: Region | None = None,
    settings: DistillationSettings = DistillationSettings(),
    parent_sha256: str = "",
    tell: Callable[[str], None] = lambda what: None,
) -> Distillation:
    """Fit a small network on nominal joint values to the full solutions of a model.

    Args:
        name: of the distilled model.
        parent: a model with an identified geometry.
        region: where; None: around the joint values that the model was measured at.
        settings: number of poses, sizes, seed.
        parent_sha256: hash of the parent's description, for provenance.
        tell: is called with the state of the work.

    Raises:
        ModelError: the model has nothing that could be distilled.
        IdentificationError: the robot takes too few poses of the region, or they are too few for the size.
    """
    _check_parent(parent)
    sizes = _sizes(parent, settings)
    if region is None:
        region = Region(parent.starts.double())
    generator = torch.Generator().manual_seed(settings.seed)
    choosing, judging = (round(settings.poses * share) for share in (CHOICE_SHARE, HELD_OUT_SHARE))
    total = settings.poses + choosing + judging
    every = draw_solved_poses(TorchIK(parent), region, total, generator, tell)
    fitted, chosen_by = slice(settings.poses), slice(settings.poses, settings.poses + choosing)
    network, trials = _choose(parent, every, (fitted, chosen_by), sizes, settings, tell)
    held_out = _rows(every, slice(settings.poses + choosing, None))
    with torch.no_grad():
        predicted = network(held_out.T, held_out.q_nominal)
        scaled = network.scaled_inputs(every.T[fitted], every.q_nominal[fitted])
    model = CalibratedModel(
        name=name,
        kind="distilled",
        robot=parent.robot,
        network=network,
        domain=Domain.around(scaled[:DOMAIN_SAMPLES], generator),
        branches=_frequent(TorchIK(parent), every),
        starts=spread_rows((every.q_nominal + every.correction)[fitted]),
        bases=parent.bases,
        tools=parent.tools,
        provenance=_provenance(parent, parent_sha256, settings),
    )
    return Distillation(model, parent, region, trials, settings.poses, held_out, predicted)


def _check_parent(parent: CalibratedModel) -> None:
    if parent.network is not None:
        raise ModelError(
            f"model '{parent.name}' corrects nominal joint values by a network already, so there is nothing to "
            "distil; export it as it is."
        )
    if parent.calibrated is None or not len(parent.starts):
        raise ModelError(
            f"model '{parent.name}' has no identified geometry with joint values it was measured at, so there is "
            "nothing to distil; give a model of `pisigma calibrate`."
        )


def _sizes(parent: CalibratedModel, settings: DistillationSettings) -> tuple[Size, ...]:
    """Sizes to fit."""
    if settings.poses < _FEWEST:
        raise IdentificationError(
            f"{settings.poses} poses are too few to distil from; give {_FEWEST} or more."
        )
    if settings.size is not None:
        return (settings.size,)
    sizes = sizes_for(parent, settings.poses)
    if not sizes:
        raise IdentificationError(
            f"{settings.poses} poses are too few for any size of network for robot '{parent.robot.name}'; give "
            "more, or the orders of a small one."
        )
    return sizes


def _choose(
    parent: CalibratedModel,
    poses: SolvedPoses,
    parts: tuple[slice, slice],
    sizes: tuple[Size, ...],
    settings: DistillationSettings,
    tell: Callable[[str], None],
) -> tuple[CorrectionNetwork, tuple[Trial, ...]]:
    """The smallest network that is about as good as the best, and all that were tried."""
    pairs = _pairs(poses, parts[0])
    found: list[tuple[CorrectionNetwork, Size, float]] = []
    for size in sizes:
        about = f"orders {size.orders}, harmonics {size.harmonics}"
        network = fit_size(
            parent.robot,
            size,
            pairs,
            settings.seed,
            settings.epochs,
            lambda what, about=about: tell(f"{about}: {what}"),  # type: ignore[misc]
        )
        T, q = poses.T[parts[1]], poses.q_nominal[parts[1]]
        with torch.no_grad():
            reached = parent.forward(q + network(T, q))
        error = float((reached[:, :3, 3] - T[:, :3, 3]).square().sum(-1).mean().sqrt())
        found.append((network, size, error))
        if error < ENOUGH:
            break
    best = min(error for *_, error in found)
    kept = next(k for k, (*_, error) in enumerate(found) if error <= max(AS_GOOD * best, ENOUGH))
    trials = tuple(
        Trial(size, size.unknowns(parent.robot), error, k == kept) for k, (_, size, error) in enumerate(found)
    )
    return found[kept][0], trials


def _pairs(poses: SolvedPoses, part: slice) -> TrainingPairs:
    q_nominal = poses.q_nominal[part]
    every = torch.ones(len(q_nominal), dtype=torch.bool)
    return TrainingPairs(poses.T[part], q_nominal, poses.correction[part], every, ~every, ~every, ())


def _rows(poses: SolvedPoses, part: slice) -> SolvedPoses:
    return SolvedPoses(
        poses.T[part],
        poses.q_nominal[part],
        poses.correction[part],
        poses.branch[part],
        poses.status[part],
        poses.drawn,
        poses.refused,
    )


def _frequent(ik: TorchIK, poses: SolvedPoses) -> tuple[str, ...]:
    """Branches that the poses lie on, most frequent first; none for a robot without closed-form inverse."""
    if ik.branches == (NUMERIC,):
        return ()
    counts = torch.bincount(poses.branch, minlength=len(ik.branches))
    order = counts.argsort(descending=True, stable=True).tolist()
    return tuple(ik.branches[i] for i in order if counts[i] > 0)


def _provenance(parent: CalibratedModel, sha256: str, settings: DistillationSettings) -> Provenance:
    return Provenance(
        data_source=f"full solutions of model {parent.name}",
        data_sha256=sha256,
        rows=settings.poses,
        seed=settings.seed,
        versions={name: version(name) for name in ("pisigma", "torch")}
        | {"python": platform.python_version()},
    )
