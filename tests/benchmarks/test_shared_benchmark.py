"""The benchmark of calibration: fixed splits, methods in their own processes, stored results and the page."""

import dataclasses
import importlib
import sys
from types import ModuleType

import numpy as np
import pytest
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError

RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def module(repository):
    """Function that imports a module of the benchmark, which is not part of the package."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(repository / "benchmarks"))
        yield lambda name: importlib.import_module(f"shared_benchmark.{name}")
        for name in [name for name in sys.modules if name.partition(".")[0] == "shared_benchmark"]:
            del sys.modules[name]


@pytest.fixture(scope="module")
def arm_task(module):
    """A UR5 with errors, whose positions are exact: (task, errors of the held-out rows under a prediction)."""
    rows, dh = module("rows"), module("methods._dh")
    nominal = module("series").series_of("ur5_grid").arm.dh
    direction = np.ones(6)
    true = nominal + 1e-3 * np.array([1.0, 1.0, 1.0, 1.0, 1.0]) * RNG.standard_normal(nominal.shape)
    frames = dh.Frames(np.eye(4), {"": np.array([0.03, -0.02, 0.1])}, np.eye(3))
    q, target = RNG.uniform(-3, 3, (80, 6)), np.full(80, "")
    position = dh.Geometry(true, direction, frames).poses(rows.Rows(q, target))[:, :3, 3]
    every = rows.Rows(q, target, position)
    train, test = every.select(np.arange(60)), every.select(np.arange(60, 80))
    task = rows.Task("ur5_grid", nominal, direction, train, test.without_measurements(), {}, 0)
    return task, lambda prediction: np.linalg.norm(prediction.T[:, :3, 3] - test.position, axis=1).max()


def test_splits_are_those_of_the_benchmark_and_hold_configurations_out(module, shared_data):
    """Row numbers have the published hashes, and no configuration is on both sides."""
    splits, scores = module("splits"), module("scores")
    for name in module("series").NAMES:
        series = module("series").series_of(name)
        assert series.missing() is None
        group = scores.groups_of(series)
        for split in series.splits:
            for fold in splits.folds_of(series, split):
                assert len(fold.train)
                assert not set(group[fold.train]) & set(group[fold.test])
    wrong = dataclasses.replace(series, splits=dict.fromkeys(series.splits, "0"))
    with refused(MeasurementError):
        splits.folds_of(wrong, split)


def test_a_missing_or_changed_file_is_named(module):
    series = module("series").series_of("ur5_grid")
    assert series.url in dataclasses.replace(series, file="nowhere.csv").missing()
    with refused(MeasurementError):
        dataclasses.replace(series, file="nowhere.csv").measurements  # noqa: B018


def test_least_squares_finds_an_exact_arm(module, arm_task):
    """The fitted DH parameters predict other poses exactly, the nominal ones do not; a stored task is the same."""
    task, error = arm_task
    assert error(module("methods.scipy_dh").fit(task)(task.test)) < 1e-6
    assert error(module("methods.nominal").fit(task)(task.test)) > 1e-3


def test_a_fit_runs_in_its_own_process_and_a_crash_is_a_status(module, arm_task, monkeypatch):
    task, error = arm_task
    fits = module("fits")
    fit, prediction = fits.predict(task, "nominal", sys.executable)
    assert fit["status"] == "done"
    assert fit["memory_mb"] > 1
    assert_close(error(prediction), error(module("methods.nominal").fit(task)(task.test)), rtol=1e-9)
    assert fits.predict(task, "no_such_method", sys.executable)[0]["status"].startswith(
        "failed: exit status 1"
    )
    few = dataclasses.replace(task, train=task.train.select(np.arange(1)))
    assert fits.predict(few, "geometric", sys.executable)[0]["status"].startswith("failed: ")
    monkeypatch.setattr(fits, "LIMIT_S", 1)
    assert fits.predict(task, "hybrid", sys.executable)[0]["status"] == "over 1 s"


def test_larger_fits_are_not_tried_after_an_overrun(module, shared_data, monkeypatch):
    """Fits to fewer rows still run; a method that cannot use the rows has one status."""
    fits, series = module("fits"), module("series").series_of("fanuc")
    tried = []

    def overrun(task, method, python):
        tried.append(len(task.train.q))
        return {"status": "over 300 s"}, None

    monkeypatch.setattr(fits, "predict", overrun)
    method = module("methods").method_of("nominal")
    found = [fit for fit, _ in fits.fits_of(series, "random", method, sys.executable)]
    assert tried == [570]
    assert [fit["status"] for fit in found][1:] == ["not tried after an overrun with 570 rows"] * 4
    assert fits.overrun_rows(found) == 570
    sockets = fits.fits_of(
        module("series").series_of("panda"),
        "placements",
        module("methods").method_of("pybotics"),
        sys.executable,
    )
    assert [fit["status"] for fit, _ in sockets] == ["does not use rows of the kind 'socket'"]


def test_positions_alone_are_not_compared_with_another_session(module, shared_data, monkeypatch):
    """Base and tool, which have moved, could not be fitted to them."""
    fits, series = module("fits"), module("series").series_of("ur10_c")

    def positions(task, method, python):
        T = np.tile(np.eye(4), (len(task.test.q), 1, 1))
        T[:, :3, :3] = np.nan
        return {"status": "done"}, module("rows").Prediction(T)

    monkeypatch.setattr(fits, "predict", positions)
    ((fit, errors),) = fits.fits_of(series, "session", module("methods").method_of("nominal"), sys.executable)
    assert errors is None
    assert fit["status"].startswith("predicts no rotations")


def make_errors(scores: ModuleType, scale: float) -> object:
    error = scale * np.random.default_rng(1).standard_normal((400, 3))
    return scores.RowErrors(
        np.arange(400),
        np.arange(400) // 2,
        np.arange(400) // 80,
        error,
        np.full((400, 3), scale),
        np.zeros(400),
    )


def test_scores(module):
    """The ratio of proportional errors has no uncertainty, and normal errors are covered as stated."""
    scores = module("scores")
    one, two = make_errors(scores, 1.0), make_errors(scores, 2.0)
    assert_close(scores.ratio_interval(two, one), [2.0, 2.0], rtol=1e-12)
    assert_close(two.rms / one.rms, 2.0, rtol=1e-12)
    assert_close([one.coverage(0.9), one.coverage(0.95)], [0.9, 0.95], atol=0.02)


def test_other_rows_of_a_socket_place_a_row(module):
    """Two rows of a socket are wrong by their difference, whatever the frame; the distance adds the scale."""
    rows, scores = module("rows"), module("scores")
    socket = np.array(["a/0", "a/0", "a/1"])
    T = np.broadcast_to(np.eye(4), (3, 4, 4)).copy()
    T[:, 0, 3] = 0.0, 0.002, 0.051
    held_out = rows.Rows(np.zeros((3, 6)), np.full(3, ""), socket=socket)
    assert_close(scores.from_other_rows(T[:, :3, 3], held_out)[:, 0], [0.002, -0.002, 0.0], atol=1e-12)
    distance = scores.errors_between_sockets(rows.Prediction(T), held_out, {("a/0", "a/1"): 0.05})
    assert_close(distance, 0.0, atol=1e-9)


def test_results_of_a_split_replace_those_before(module, tmp_path):
    store, scores = module("store"), module("scores")
    fit = {
        "series": "s",
        "split": "x",
        "fold": 0,
        "status": "done",
        "train_rows": 3,
        "seconds": 1.0,
        "memory_mb": 1.0,
    }
    for method, scale in (("b", 1.0), ("a", 1.0), ("a", 2.0)):
        store.replace(tmp_path, store.tables_of([({**fit, "method": method}, make_errors(scores, scale))]))
    fits, rows = store.read(tmp_path)
    assert fits["method"].to_pylist() == ["a", "b"]
    for method, scale in (("a", 2.0), ("b", 1.0)):
        found = store.errors_of(rows, "s", "x", method)
        assert_close(found.rms, make_errors(scores, scale).rms, rtol=1e-6)
        assert found.group.tolist() == (np.arange(400) // 2).tolist()


def test_stored_fits_with_the_same_inputs_are_not_run_again(module, tmp_path):
    """A fold that is missing, waited too long or has another hash is run again."""
    store, fits = module("store"), module("fits")
    series = module("series").series_of("fanuc")
    inputs = fits.inputs_of(series, "random", module("methods").method_of("nominal"))

    def stored(*statuses, wanted=2, **changed):
        found = [{**inputs, "fold": fold, "status": status} for fold, status in enumerate(statuses)]
        store.replace(tmp_path, store.tables_of((fit, None) for fit in found))
        return store.stored_fits(tmp_path, {**inputs, **changed}, wanted)

    assert len(stored("done", "over 300 s")) == 2
    assert len(stored("does not use rows of the kind 'socket'")) == 1
    assert stored("done") is None
    assert stored("done", f"{fits.WAITED} 1800 s of other programs") is None
    assert stored("done", "not installed: pybotics") is None
    assert stored("done", "done", code_sha256="0") is None


def test_a_network_has_the_derivatives_of_its_outputs_and_learns(module):
    network_of = module("methods.lm_network")._Network
    x = np.concatenate([RNG.uniform(-1, 1, (60, 3)), np.ones((60, 1))], 1)
    network = network_of(3, 8, 2, np.random.default_rng(0))
    weights, step = network.weights, 1e-6
    columns = [
        (network.outputs(weights + step * one, x) - network.outputs(weights - step * one, x)).ravel()
        for one in np.eye(len(weights))
    ]
    assert_close(network.jacobian(weights, x), np.stack(columns, 1) / (2 * step), atol=1e-8)
    y = np.stack([np.sin(2 * x[:, 0]), x[:, 1] * x[:, 2]], 1)
    assert network.train(x, y, np.arange(60) % 6 == 0) < 0.02 * y.var()


def test_intervals_of_an_error_and_of_a_coverage(module):
    """The interval of an RMS error scales with it, and exact intervals are within binomial scatter."""
    scores, coverage = module("scores"), module("coverage")
    one, two = make_errors(scores, 1.0), make_errors(scores, 2.0)
    low, high = scores.rms_interval(one)
    assert low < one.rms < high
    assert_close(scores.rms_interval(two), [2 * low, 2 * high], rtol=1e-12)
    low, high = coverage.binomial_interval(one, 0.95)
    assert low < one.coverage(0.95) < high
    assert coverage.agrees(one, 0.95)
    assert not coverage.agrees(dataclasses.replace(one, sigma=1.3 * one.sigma), 0.95)
    shared = 1.2 * np.array([1.0, 0.6, 1.5, 0.8, 1.2])[one.fold, None]  # as of fits with unequal errors
    unequal = dataclasses.replace(one, error=shared * one.error)
    assert unequal.coverage(0.95) < low
    assert coverage.agrees(unequal, 0.95)


def test_the_page_is_made_from_the_stored_results_and_explains_every_loss(module):
    page, store, comparison = module("page"), module("store"), module("comparison")
    results = module("results").Results(*store.read(store.RESULTS))
    assert page.PAGE.read_text(encoding="utf-8") == page.page_of(results)
    assert set(comparison.losses(results)) <= set(comparison.LOSSES)
    assert set(comparison.below_geometric(results)) <= set(comparison.BELOW_GEOMETRIC)
