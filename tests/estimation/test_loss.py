import pytest
import torch
from testing.closeness import assert_close

from pisigma.estimation.loss import (
    DISTANCE_99,
    HAMPEL_VARIANCE,
    MEDIAN_DISTANCE,
    AbstractLoss,
    HampelLoss,
    SquaredLoss,
)

COMPONENTS = [1, 2, 3]


def density(components: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return lengths of standard normal vectors and their probabilities on a fine grid."""
    d = torch.linspace(1e-6, 15.0, 300_001, dtype=torch.float64)
    weight = d ** (components - 1) * torch.exp(-d.square() / 2)
    return d, weight / weight.sum()


@pytest.mark.parametrize("loss", [SquaredLoss(), HampelLoss()])
@pytest.mark.parametrize("components", COMPONENTS)
def test_weight_is_half_the_derivative_of_the_cost_over_the_distance(
    loss: AbstractLoss, components: int
) -> None:
    d = torch.linspace(0.05, 20.0, 401, dtype=torch.float64)
    slope = (loss.cost(d + 1e-6, components) - loss.cost(d - 1e-6, components)) / 2e-6
    assert_close(slope / (2 * d), loss.weight(d, components), atol=1e-6)


@pytest.mark.parametrize("components", COMPONENTS)
def test_constants_are_those_of_normal_noise(components: int) -> None:
    d, p = density(components)
    cumulated = p.cumsum(0)
    assert_close(d[int((cumulated < 0.5).sum())], MEDIAN_DISTANCE[components], atol=1e-4)
    assert_close(d[int((cumulated < 0.99).sum())], DISTANCE_99[components], atol=1e-4)
    w = HampelLoss().weight(d, components)
    assert_close(
        (w * d.square() * p).sum() / (components * (w * p).sum()), HAMPEL_VARIANCE[components], atol=5e-5
    )


def test_hampel_leaves_good_rows_and_drops_bad_ones() -> None:
    d = torch.tensor([0.0, 1.0, 3.3, 3.5, 8.0, 10.2, 1e6], dtype=torch.float64)
    w = HampelLoss().weight(d, 3)
    assert_close(w[:3], torch.ones(3))
    assert 0.9 < float(w[3]) < 1.0
    assert_close(w[5:], torch.zeros(2))
    assert (w.diff() <= 0).all()


@pytest.mark.parametrize("components", COMPONENTS)
def test_scale_is_robust_to_wrong_rows(components: int, generator: torch.Generator) -> None:
    r = 0.2 * torch.randn(20_000, components, generator=generator, dtype=torch.float64)
    r[:2000] *= 100
    loss = HampelLoss()
    distance = r.norm(dim=-1)
    scale = loss.scale(distance, components, 0.0)
    assert 0.2 < scale < 0.25
    assert_close(loss.sigma(distance, components, 0.0, 0.2), 0.2, rtol=0.03)
    assert SquaredLoss().scale(distance, components, 0.0) > 5


def test_estimated_parameters_increase_the_scale() -> None:
    d = torch.ones(10, dtype=torch.float64)
    assert_close(SquaredLoss().scale(d, 1, 5.0), 2**0.5, rtol=1e-12)
    assert_close(HampelLoss().scale(d, 1, 5.0) / HampelLoss().scale(d, 1, 0.0), 2**0.5, rtol=1e-12)
