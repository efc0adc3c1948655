"""The unknowns of a hybrid in coordinates in which steps of one size suit all of them."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor
from torch.func import functional_call

from pisigma.hybrid.design import Design
from pisigma.hybrid.evidence import Posterior
from pisigma.hybrid.held_products import HeldProducts, normalised
from pisigma.hybrid.refinement import Refined, with_held_factors
from pisigma.hybrid.uncertainty import covariance_root
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.measurement.conditions import JointState


@dataclass(frozen=True, eq=False)
class WhitenedUnknowns:
    """`x = start + root · z`, where some rows say that z is about 0 with covariance 1.

    The unknowns x are the free parameters counted from nominal, the weights of the features, and of the product
    units first the weights of the free factors and then the changes of the held ones.

    Attributes:
        design: of the few rows.
        posterior: of their unknowns, whose prior sizes and noise stand.
        held: choices of free factors, that of `design` first; none without product units.
        start: x where z is 0.
        root: root of the covariance of x.
        precision: 1 / variance of x in the prior, whose mean is 0.
        correction: the network, for its shape.
    """

    design: Design
    posterior: Posterior
    held: tuple[HeldProducts, ...]
    start: Float64[Tensor, " unknowns"]
    root: Float64[Tensor, "unknowns unknowns"]
    precision: Float64[Tensor, " unknowns"]
    correction: JointCorrection

    @staticmethod
    def around(few: Refined) -> "WhitenedUnknowns":
        """Around the solution of a part of the rows."""
        whole = with_held_factors(few)
        covariance = whole.posterior.covariance
        change = torch.eye(few.design.active).to(covariance)
        extra = len(covariance) - few.design.unknowns
        return WhitenedUnknowns(
            design=few.design,
            posterior=few.posterior,
            held=tuple(chosen for chosen in whole.design.features if isinstance(chosen, HeldProducts)),
            start=torch.cat([few.posterior.x, few.posterior.x.new_zeros(extra)]),
            root=covariance_root(covariance, change),
            precision=whole.posterior.prior.precision,
            correction=few.correction,
        )

    def values(self, z: Float64[Tensor, " unknowns"]) -> Float64[Tensor, " unknowns"]:
        """The unknowns x."""
        return self.start + self.root @ z

    def shift(self, x: Float64[Tensor, " unknowns"], state: JointState) -> Float64[Tensor, "rows dof"]:
        """Joint corrections [rad or m] of rows, to be derived by x."""
        weights = {}
        for number, chosen in enumerate(self._additive):
            none = torch.zeros(chosen.used.shape).to(x)
            weights[f"linear.{number}"] = none.masked_scatter(chosen.used, x[self.design.stretch(number)])
        if self.held:
            factors = self.factors(x)
            weights |= {"bias": factors[..., 0], "weight": factors[..., 1:]}
        delta: Tensor = functional_call(self.correction, weights, (state,))
        return delta

    def factors(self, x: Float64[Tensor, " unknowns"]) -> Float64[Tensor, "dof factors inputs"]:
        """Weights of all factors of the product units, the bias first."""
        first, *others = self.held
        dof, _, inputs = first.factors.shape
        place = self.design.stretch(len(self._additive)).start
        total = first.factors.clone()
        total[:, list(first.free)] = 0.0
        for chosen in (first, *others):
            part = x[place : place + chosen.used.numel()].reshape(dof, len(chosen.orders), inputs)
            total = total.index_add(1, torch.tensor(chosen.free, device=x.device), part)
            place += chosen.used.numel()
        return total

    def solution(self, x: Float64[Tensor, " unknowns"]) -> tuple[Design, Posterior]:
        """Design and posterior with these unknowns as the most probable values, held factors of length 1."""
        x = x.detach()
        if not self.held:
            return self.design, replace(self.posterior, x=x)
        first, factors = self.held[0], self.factors(x)
        length, unit = factors.norm(dim=-1), normalised(factors)
        free, start = [], 0
        for order, place in zip(first.orders, first.free, strict=True):
            others = [s for s in range(start, start + order) if s != place]
            free.append(factors[:, place] * length[:, others].prod(1)[:, None])
            start += order
        held = HeldProducts(self.design.problem.space.robot, first.orders, unit, first.turn)
        weights = x[: self.design.stretch(len(self._additive)).start]
        x = torch.cat([weights, torch.stack(free, 1).flatten()])
        design = replace(self.design, features=(*self._additive, held))
        return design, replace(self.posterior, x=x)

    @property
    def _additive(self) -> tuple[AbstractFeature, ...]:
        """Features of the unit of order 1."""
        return self.design.features[:-1] if self.held else self.design.features
