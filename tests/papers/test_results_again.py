"""The small recipes give again what is stored of them."""

import json

import pytest
from testing.closeness import assert_close
from testing.models import no_type_checker, shipped_training

from recipe_runs import extra_figures, figures_of
from stored_results import read_results

RELATIVE = 1e-6
"""Figures agree to this, those near rounding level to `ABSOLUTE`."""
ABSOLUTE = 1e-9
UNDETERMINED = 1e-3
"""[mm or deg] More parameters are estimated than the rank allows: along what the data cannot determine, values are the
processor's rounding. What is determined (errors after every step, of held-out rows too) agrees far better."""
ROUNDING_MM = 1e-9
"""RMSE below which only the order of the sums counts; the last step may then be missing or one more."""


@pytest.fixture
def again(repository):
    """A recipe that is run again as by the script, and its stored result."""

    def run(name: str) -> tuple[dict, dict]:
        folder = repository / "training"
        with no_type_checker():
            training = shipped_training(name)
            result = {**figures_of(training), **extra_figures(folder, name, training)}
        stored = dict(read_results(folder)[name])
        assert stored.pop("model") == f"runs/{name}"
        return json.loads(json.dumps(result, allow_nan=False)), stored

    return run


def same(found: object, stored: object, place: str = "") -> None:
    """Everything is the same, numbers to the tolerance."""
    assert type(found) is type(stored) or isinstance(found, int | float), place
    if isinstance(stored, dict):
        assert list(found) == list(stored), place
        for key, value in stored.items():
            same(found[key], value, f"{place}.{key}")
    elif isinstance(stored, list):
        assert len(found) == len(stored), place
        for index, (one, other) in enumerate(zip(found, stored, strict=True)):
            same(one, other, f"{place}[{index}]")
    elif isinstance(stored, float):
        assert_close(found, stored, rtol=RELATIVE, atol=ABSOLUTE)
    else:
        assert found == stored, place


def test_the_papers_way_with_kiro3(again):
    found, stored = again("kiro3_paper")
    assert set(found) == set(stored)
    for key in set(stored) - {"seconds"}:
        same(found[key], stored[key], key)


@pytest.mark.parametrize("name", ["rb5_redundancy", "panda_redundancy"])
def test_redundant_parameters(again, name):
    found, stored = again(name)
    assert set(found) == set(stored)
    for key in ("redundant_sets", "no_effect", "pairwise_parameters", "rank", "true_values", "paper"):
        same(found[key], stored[key], key)
    for kind, table in stored["correlations"].items():
        assert found["correlations"][kind]["names"] == table["names"]
        for one, other in zip(found["correlations"][kind]["values"], table["values"], strict=True):
            assert [value is None for value in one] == [value is None for value in other]
            known = [(a, b) for a, b in zip(one, other, strict=True) if b is not None]
            assert_close([a for a, _ in known], [b for _, b in known], atol=2e-6)  # stored with six decimals
    for case, other in zip(found["elimination_cases"], stored["elimination_cases"], strict=True):
        assert (case["removed"], case["parameters"]) == (other["removed"], other["parameters"])
        assert list(case["values"]) == list(other["values"])
        assert_close(list(case["values"].values()), list(other["values"].values()), atol=UNDETERMINED)
        assert case["status"] == other["status"]
        steps = [value for value in other["rmse_mm"] if value > ROUNDING_MM]
        assert len(steps) >= 3
        assert_close(case["rmse_mm"][: len(steps)], steps, rtol=1e-4, atol=ROUNDING_MM)
        assert max(case["rmse_mm"][-1], case["held_out_rms_mm"], other["rmse_mm"][-1]) < ROUNDING_MM
