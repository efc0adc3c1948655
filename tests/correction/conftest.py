"""Fixtures for corrections."""

from collections.abc import Iterator

import pytest
from testing.models import no_type_checker


@pytest.fixture
def without_type_checker() -> Iterator[None]:
    """Call pisigma as users do, whom no type checker stops before our own complaints."""
    with no_type_checker():
        yield
