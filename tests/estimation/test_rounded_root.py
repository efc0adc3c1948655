"""A rounded covariance root keeps the standard deviations of combinations, and is stored without loss."""

import bz2

import pytest
import torch
from testing.closeness import assert_close
from torch import Tensor

from pisigma.estimation.rounded_root import RoundedRoot, round_root

TOLERANCE = 0.01
UNKNOWNS, ROWS = 150, 400


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def known_combinations() -> tuple[Tensor, Tensor]:
    """Return rows that strongly correlated unknowns were measured with, and a root of their covariance."""
    rows = normal(ROWS, UNKNOWNS, seed=1) + 30 * normal(ROWS, 1, seed=2)
    size = torch.logspace(-6, -2, UNKNOWNS, dtype=torch.float64)
    measured = rows * size
    information = measured.t() @ measured / 1e-10 + torch.diag(size**-2)
    return measured / size * size, torch.linalg.inv(torch.linalg.cholesky(information)).t()


def change(root: Tensor, rounded: Tensor, probes: Tensor) -> Tensor:
    ratio: Tensor = (probes @ rounded).norm(dim=1) / (probes @ root).norm(dim=1)
    return (ratio - 1).abs().max()


def test_combinations_much_better_known_than_their_unknowns_keep_their_deviation() -> None:
    rows, root = known_combinations()
    rounded = round_root(root, rows, TOLERANCE)
    assert rounded is not None
    assert float(change(root, rounded.as_matrix, rows)) <= TOLERANCE
    others = normal(100, UNKNOWNS, seed=3) / root.norm(dim=1)
    assert float(change(root, rounded.as_matrix, others)) < 2 * TOLERANCE
    assert_close(rounded.as_matrix.norm(dim=1), root.norm(dim=1), rtol=TOLERANCE)
    # rounding every row by itself to as many digits loses the rows that were measured
    alone = torch.round(root / rounded.unit[:, None]) * rounded.unit[:, None]
    assert float(change(root, alone, rows)) > 2 * float(change(root, rounded.as_matrix, rows))


@pytest.mark.parametrize("directions", [1, 40])
def test_unknowns_that_others_determine(directions: int) -> None:
    root = normal(UNKNOWNS, directions, seed=4)
    root[7] = 0
    probes = normal(50, UNKNOWNS, seed=5)
    rounded = round_root(root, probes, TOLERANCE)
    assert rounded is not None
    assert float(change(root, rounded.as_matrix, probes)) <= TOLERANCE
    assert not rounded.as_matrix[7].any()


def test_a_root_that_cannot_be_rounded() -> None:
    rows, root = known_combinations()
    assert round_root(root, rows, 1e-9) is None


def test_packed_numbers_are_the_same_and_few() -> None:
    rows, root = known_combinations()
    rounded = round_root(root, rows, TOLERANCE)
    assert rounded is not None
    content = rounded.packed()
    assert len(content) < 8 * root.numel() / 10
    again = RoundedRoot.unpacked(content, rounded.unit)
    assert torch.equal(again.integers, rounded.integers)
    assert torch.equal(again.as_matrix, rounded.as_matrix)
    chosen = [0, *range(3, UNKNOWNS)]
    placed = rounded.select(chosen).with_exact_unknowns(chosen, UNKNOWNS).as_matrix
    assert torch.equal(placed[chosen], rounded.as_matrix[chosen])
    assert not placed[1:3].any()


@pytest.mark.parametrize(
    "content", [b"", b"nonsense", bz2.compress(bytes(7)), bz2.compress(bytes(10_000_000))], ids=len
)
def test_contents_that_are_not_the_numbers_of_a_root(content: bytes) -> None:
    with pytest.raises(ValueError, match="compressed"):
        RoundedRoot.unpacked(content, torch.ones(5, dtype=torch.float64))
