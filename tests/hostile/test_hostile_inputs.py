"""A seeded run of hostile inputs: none may end in a traceback, a hang, a lost file or a wrong model."""

import resource
from pathlib import Path

import pytest
from hostile.clean import Clean, write_clean
from hostile.kinds import KINDS, make, shares
from hostile.outcome import attempt
from testing.models import no_type_checker

COUNT, SEED = 200, 0
MAX_MEMORY_GROWTH = 10**6
"""Maximum growth of the tests' memory [kB]."""


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Clean:
    with no_type_checker():
        return write_clean(tmp_path_factory.mktemp("clean"))


@pytest.mark.parametrize("kind", KINDS)
def test_no_hostile_input_does_harm(kind: str, clean: Clean, tmp_path: Path):
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    bad = []
    for number in range(shares(COUNT)[kind]):
        (folder := tmp_path / str(number)).mkdir()
        with no_type_checker():
            case = make(kind, SEED, number, clean, folder)
        outcome = attempt(case, folder)
        if not outcome.ending.allowed:
            bad.append(f"{number}: {outcome.ending.value}: {case.what}: {outcome.said[-300:]}")
    assert not bad, (
        f"{len(bad)} of '{kind}', see `python tests/hostile/run.py --kind '{kind}'`:\n" + "\n".join(bad)
    )
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - used < MAX_MEMORY_GROWTH
