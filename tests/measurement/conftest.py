"""Fixtures for measurements."""

from collections.abc import Iterator

import jaxtyping
import pytest


@pytest.fixture
def without_type_checker() -> Iterator[None]:
    """Call pisigma as users do, whom no type checker stops before our own complaints."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
