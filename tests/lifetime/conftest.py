"""Tests of lifetime check no types: they fit whole calibrations, whose types the tests of those rooms check."""

from collections.abc import Iterator

import pytest
from testing.models import no_type_checker


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """Call pisigma as users do."""
    with no_type_checker():
        yield
