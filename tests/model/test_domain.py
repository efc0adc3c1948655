"""The domain: distances to the training rows divided by their spacing."""

import pytest
import torch
from testing.closeness import assert_close

from pisigma.model.domain import MARGIN, MAX_SAMPLES, REPEAT, Domain


def grid(*, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    line = torch.linspace(-1, 1, 11, dtype=dtype)
    return torch.cartesian_prod(line, line)


def test_radius_is_the_spacing_of_a_grid(generator):
    domain = Domain.from_rows(grid(), generator)
    assert_close(domain.radius, 0.2 * MARGIN, atol=1e-12)
    assert_close(domain.measure(grid()), 0.0, atol=1e-12)
    assert bool(domain.contains(torch.tensor([0.1, 0.1], dtype=torch.float64)))
    outside = torch.tensor([1.0 + 0.2 * MARGIN + 1e-9, 0.0], dtype=torch.float64)
    assert not bool(domain.contains(outside))


def test_measure_is_the_distance_over_the_radius(generator):
    domain = Domain.from_rows(grid(), generator)
    points = 3 * torch.rand(50, 2, generator=generator, dtype=torch.float64)
    by_hand = torch.stack([(grid() - point).norm(dim=-1).min() for point in points]) / domain.radius
    assert_close(domain.measure(points), by_hand, atol=1e-12)


def test_repeats_do_not_shrink_the_domain(generator):
    """Where every pose was measured twice with some scatter, the spacing is that of the poses."""
    scatter = 1e-2 * REPEAT * torch.rand(121, 2, generator=generator, dtype=torch.float64)
    for again in (grid(), grid() + scatter):
        domain = Domain.from_rows(torch.cat([grid(), again]), generator)
        assert_close(domain.radius, 0.2 * MARGIN, atol=1e-4)


def test_one_row_defines_a_domain(generator):
    row = torch.tensor([[0.3, -0.2]], dtype=torch.float64)
    for rows in (row, row.repeat(5, 1)):
        domain = Domain.from_rows(rows, generator)
        assert bool(domain.contains(row).all())
        assert_close(domain.radius, REPEAT * MARGIN)
        far = domain.measure(row + 1)
        assert 100 < float(far) < float("inf")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (0,)])
def test_batches_and_dtypes(generator, dtype, batch):
    domain = Domain.from_rows(grid(dtype=dtype), generator)
    points = torch.rand(*batch, 2, generator=generator, dtype=dtype)
    measure = domain.measure(points)
    assert measure.shape == batch
    assert measure.dtype == domain.radius.dtype == dtype
    assert domain.contains(points).dtype == torch.bool


def test_chunks_equal_single_poses(generator):
    domain = Domain.from_rows(grid(), generator)
    points = 2 * torch.rand(9001, 2, generator=generator, dtype=torch.float64)
    together = domain.measure(points)
    for index in (0, 4095, 4096, 8192, 9000):
        assert_close(together[index], domain.measure(points[index]), atol=1e-12)


def test_nan_is_never_inside(generator):
    domain = Domain.from_rows(grid(), generator)
    point = torch.tensor([[0.0, float("nan")], [0.0, 0.0]], dtype=torch.float64)
    assert domain.contains(point).tolist() == [False, True]


def test_many_rows_are_thinned_reproducibly():
    rows = torch.rand(MAX_SAMPLES + 500, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    one, two = (Domain.from_rows(rows, torch.Generator().manual_seed(7)) for _ in range(2))
    assert one.samples.shape == (MAX_SAMPLES, 3)
    assert torch.equal(one.samples, two.samples)
    assert float(one.measure(rows).max()) < 3  # rows that were not drawn are among those that were


@pytest.mark.parametrize(("rows", "radius"), [(0, 1.0), (3, 0.0), (3, -1.0), (3, float("nan"))])
def test_a_domain_without_extent_is_refused(rows, radius):
    with pytest.raises(ValueError, match=f"{rows} samples and radius {radius:g}"):
        Domain(torch.zeros(rows, 2), torch.tensor(radius))
