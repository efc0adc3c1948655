"""Steps of the workflow write blank figures, as figures are tested in `reporting`."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def without_pictures(blank_pictures: None) -> None:
    """See `blank_pictures`."""
