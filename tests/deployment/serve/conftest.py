"""One server of two models for the tests of the protocols."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from testing.serving import running

from pisigma.deployment.serve.server import Server


@pytest.fixture(scope="session")
def served(repository: Path) -> Iterator[Server]:
    """A server of kiro4 and kiro3, in this order."""
    with running(repository / "models" / "kiro4", repository / "models" / "kiro3") as server:
        yield server


@pytest.fixture(autouse=True)
def _as_users_do(without_type_checker: None) -> None:
    """Answer without the type checker in the threads of the servers."""
