"""Steps of the workflow write blank figures: what is drawn is tested in `reporting`."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def without_pictures(blank_pictures: None) -> None:
    """See `blank_pictures`."""
