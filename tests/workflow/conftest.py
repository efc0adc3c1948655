"""Steps of the workflow write blank figures, check no types and try few features; these are tested in their rooms."""

from collections.abc import Iterator

import pytest
from testing.hybrid import few_choices, few_robots
from testing.models import no_type_checker


@pytest.fixture(scope="module", autouse=True)
def without_pictures(blank_pictures: None) -> None:
    """See `blank_pictures`."""


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """Whole steps call most functions many times; their types are checked by the tests of their rooms."""
    with no_type_checker(), few_choices(), few_robots():
        yield
