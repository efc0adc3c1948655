from dataclasses import dataclass, replace

import pytest
import torch
from testing.closeness import assert_close

from pisigma.calibration.geometric.problem.least_squares import (
    MAX_NOISE_UPDATES,
    AbstractLeastSquares,
    Linearisation,
    SolutionStatus,
    covariance_of,
    levenberg_marquardt,
    solve_damped,
)

SIGMA = 1e-8
ROUNDING = torch.tensor(1e-10, dtype=torch.float64)
ONE = torch.ones((), dtype=torch.float64)


@dataclass(frozen=True)
class Curve(AbstractLeastSquares[torch.Tensor]):
    """Rosenbrock's valley as residuals, measured with a noise that is known."""

    steepness: float
    offset: float = 0.0

    def linearise(
        self, point: torch.Tensor, with_noise_of: Linearisation[torch.Tensor] | None
    ) -> Linearisation[torch.Tensor]:
        x, y = point.tolist()
        r = torch.tensor([self.steepness * (x * x - y), x - 1, self.offset], dtype=torch.float64) / SIGMA
        slopes = [[2 * self.steepness * x, -self.steepness], [1, 0], [0, 0]]
        J = torch.tensor(slopes, dtype=torch.float64) / SIGMA
        return Linearisation(point, r @ r, -J.mT @ r, J.mT @ J, r @ r, ROUNDING, None)

    def with_updated_noise(
        self, linearisation: Linearisation[torch.Tensor]
    ) -> tuple[Linearisation[torch.Tensor], bool]:
        return linearisation, True

    def apply_step(self, point: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        return point + step

    @property
    def step_scale(self) -> torch.Tensor:
        return torch.ones(2, dtype=torch.float64)


class Swinging(AbstractLeastSquares[torch.Tensor]):
    """A length measured by two sensors, of which now one and now the other is believed."""

    def linearise(
        self, point: torch.Tensor, with_noise_of: Linearisation[torch.Tensor] | None
    ) -> Linearisation[torch.Tensor]:
        believed = 1.0 if with_noise_of is None else float(with_noise_of.problem_data)
        r = torch.stack([point[0] - believed, torch.ones(()).double()])
        return Linearisation(point, r @ r, -r[:1], torch.eye(1).double(), r @ r, ROUNDING, believed)

    def with_updated_noise(
        self, linearisation: Linearisation[torch.Tensor]
    ) -> tuple[Linearisation[torch.Tensor], bool]:
        other = replace(linearisation, problem_data=-float(linearisation.problem_data))
        return self.linearise(linearisation.point, other), False

    def apply_step(self, point: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        return point + step

    @property
    def step_scale(self) -> torch.Tensor:
        return torch.ones(1, dtype=torch.float64)


START = torch.tensor([-1.2, 1.0], dtype=torch.float64)


@pytest.mark.parametrize("steepness", [1.0, 10.0, 1000.0])
def test_curved_valleys_are_followed(steepness: float) -> None:
    solution = levenberg_marquardt(Curve(steepness), START)
    assert solution.status is SolutionStatus.EXACT
    assert solution.iterations < 20
    assert_close(solution.linearisation.point, torch.ones(2), atol=1e-12)


def test_the_best_point_is_kept_and_costs_fall() -> None:
    solution = levenberg_marquardt(Curve(100.0), START)
    assert list(solution.rms_path) == sorted(solution.rms_path, reverse=True)
    assert len(solution.rms_path) > 2
    assert_close(solution.linearisation.cost.sqrt(), solution.rms_path[-1], rtol=1e-12)


def test_a_remaining_residual_ends_by_convergence() -> None:
    solution = levenberg_marquardt(Curve(10.0, offset=0.5), START)
    assert solution.status is SolutionStatus.CONVERGED
    assert solution.status.is_minimum
    assert_close(solution.linearisation.point, torch.ones(2), atol=1e-3)


def test_the_iteration_limit_is_reported() -> None:
    solution = levenberg_marquardt(Curve(10.0), START, maximum_iterations=1)
    assert solution.status is SolutionStatus.ITERATION_LIMIT
    assert not solution.status.is_minimum
    assert "iteration limit" in solution.status.value


def test_a_noise_that_swings_is_taken_as_it_is_in_the_end() -> None:
    solution = levenberg_marquardt(Swinging(), torch.zeros(1, dtype=torch.float64), maximum_iterations=100)
    assert solution.status is SolutionStatus.CONVERGED
    assert MAX_NOISE_UPDATES < solution.iterations < MAX_NOISE_UPDATES + 10
    assert_close(solution.linearisation.point.abs(), torch.ones(1), atol=1e-3)


def test_the_search_can_go_on_from_a_linearisation() -> None:
    problem = Curve(10.0)
    first = levenberg_marquardt(problem, START, maximum_iterations=2)
    again = levenberg_marquardt(problem, first.linearisation)
    assert_close(again.linearisation.point, torch.ones(2), atol=1e-12)


def test_badly_scaled_systems_are_solved(generator: torch.Generator) -> None:
    scale = torch.tensor([1e-6, 1.0, 1e6, 1e3], dtype=torch.float64)
    A = torch.randn(20, 4, generator=generator, dtype=torch.float64) * scale
    x = torch.randn(4, generator=generator, dtype=torch.float64) / scale
    seen = Linearisation(x, ONE, A.mT @ (A @ x), A.mT @ A, ONE, 0 * ONE, None)
    assert_close(solve_damped(seen, 1 / scale, 1e-14), x, rtol=1e-9)
    assert_close(covariance_of(A.mT @ A) @ (A.mT @ A) * scale[:, None] / scale, torch.eye(4), atol=1e-9)


def test_singular_systems_give_the_short_step(generator: torch.Generator) -> None:
    A = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    A[:, 2] = A[:, 1]
    b = torch.randn(20, generator=generator, dtype=torch.float64)
    seen = Linearisation(b[:3], ONE, A.mT @ b, A.mT @ A, ONE, 0 * ONE, None)
    expected = torch.linalg.pinv(A) @ b
    assert_close(solve_damped(seen, torch.ones(3).double(), 1e-9), expected, atol=1e-5)
    assert_close(covariance_of(A.mT @ A), torch.linalg.pinv(A.mT @ A), atol=1e-10)
