"""Distances of segments from each other and from boxes, compared with points on them."""

import torch
from testing.closeness import assert_close

from pisigma.planning.surroundings.distances import box_distance, segment_distance

STEPS = torch.linspace(0, 1, 400, dtype=torch.float64)[:, None]


def _segments(count: int, seed: int) -> torch.Tensor:
    return torch.rand(count, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def _points(segment: torch.Tensor) -> torch.Tensor:
    return segment[0] + STEPS * (segment[1] - segment[0])


def test_segments_are_as_far_apart_as_their_nearest_points():
    first, second = _segments(60, 0), _segments(60, 1)
    first[:5, 1] = first[:5, 0]  # points
    second[3:8, 1] = second[3:8, 0]
    second[8:12] = first[8:12] + 0.3  # parallel
    first[12:15, 1], second[12:15, 0] = first[12:15, 0] * 2, first[12:15, 0] * 3  # on one line
    second[12:15, 1] = first[12:15, 0] * 4
    nearest = [torch.cdist(_points(a), _points(b)).min() for a, b in zip(first, second, strict=True)]
    assert_close(segment_distance(first, second), torch.stack(nearest), atol=5e-3)
    assert_close(segment_distance(first, second), segment_distance(second, first), atol=1e-12)


def test_crossing_segments_touch():
    first = torch.tensor([[[-1.0, 0, 0], [1, 0, 0]]], dtype=torch.float64)
    second = torch.tensor([[[0.3, -1, 0], [0.3, 2, 0]]], dtype=torch.float64)
    assert_close(segment_distance(first, second), torch.zeros(1), atol=1e-12)


def test_a_segment_is_as_far_from_a_box_as_its_nearest_point():
    segments, half = _segments(80, 2) * 2, torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
    outside = [((_points(segment).abs() - half).clamp(min=0)).norm(dim=1).min() for segment in segments]
    assert_close(box_distance(segments, half), torch.stack(outside), atol=5e-3)
    assert bool((box_distance(segments, half) <= torch.stack(outside) + 1e-9).all())


def test_a_segment_is_nearest_to_a_box_where_the_slope_of_the_distance_is_zero():
    half = torch.tensor([1.0, 1.0, 1.0], dtype=torch.float64)
    cases = [
        ([[-3, 0, 1.5], [3, 0, 1.5]], 0.5),  # along a face
        ([[0, 4, 0], [4, 0, 0]], 2**0.5),  # past an edge
        ([[6, 0, 0], [0, 6, 0]], 2 * 2**0.5),
        ([[3, 0, 0], [0, 3, 0]], 0.5**0.5),
        ([[7, 1, 1], [1, 7, 1]], 3 * 2**0.5),
        ([[3, 3, 3], [3, 3, 3]], 12**0.5),  # a point, past a corner
        ([[0.2, 0.1, 0], [0.2, 0.1, 0]], 0.0),
        ([[-3, 0.1, 0.2], [3, 0.1, 0.2]], 0.0),  # through it
        ([[2, 0, 0], [5, 0, 0]], 1.0),  # away from it
        ([[5, 0, 0], [2, 0, 0]], 1.0),  # towards it
    ]
    segments = torch.tensor([ends for ends, _ in cases], dtype=torch.float64)
    assert_close(box_distance(segments, half), torch.tensor([far for _, far in cases]).double(), atol=1e-6)
    assert_close(box_distance(segments, half), box_distance(segments.flip(-2), half), atol=1e-14)
    assert_close(box_distance(segments[:, None], half[None])[:, 0], box_distance(segments, half), atol=0)
