"""Tests of lifetime check no types and try few features and robots: the tests of those rooms check them."""

from collections.abc import Iterator

import pytest
from testing.hybrid import few_choices, few_robots
from testing.models import no_type_checker


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """Call pisigma as users do."""
    with no_type_checker(), few_choices(), few_robots():
        yield
