"""Training on mini-batches: as good as the exact fit, reproducible, resumable; nonsense is refused."""

import dataclasses
import functools
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.hybrid import NOISE, joints_in, true_robot
from testing.models import no_type_checker

from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.mini_batches import BatchRows, MiniBatches
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.files.errors import TrainingError
from pisigma.measurement.dataset import Measurements
from pisigma.network.mini_batches import BatchSchedule
from pisigma.robot import Robot

SETTINGS = MiniBatches(batch_rows=1_000, epochs=10)
ROWS = 5_000


@pytest.fixture(scope="module", autouse=True)
def _few_rows_are_searched():
    """Choose models on fewer rows, so that there are many more."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pisigma.calibration.hybrid.calibrator.SEARCHED_ROWS", 1_500)
        yield


def measured(rows: int, seed: int, noise: float) -> Measurements:
    """Positions of a simulated robot, a few of them grossly wrong where there is noise."""
    with no_type_checker():
        true = true_robot(Robot.load("rb5"))
    q = joints_in(true.nominal, rows, seed=seed)
    rng = np.random.default_rng(seed + 1)
    position = true.forward(q)[:, :3, 3] + noise * torch.from_numpy(rng.normal(size=(rows, 3)))
    if noise:
        position[::50] += 1e-3
    return Measurements(q=q, position=position)


@functools.cache
def data() -> tuple[Measurements, Measurements]:
    """To train on, and exact positions to judge by."""
    return measured(ROWS, 0, NOISE), measured(1_000, 7, 0.0)


@functools.cache
def calibrator(products: bool, mini_batches: MiniBatches | bool | str = SETTINGS) -> HybridCalibrator:
    """That tries one series, and product units."""
    robot = Robot.load("rb5")
    return HybridCalibrator(
        robot, features=("series",), harmonics=(4,), products=products, mini_batches=mini_batches
    )


@functools.cache
def exact(products: bool) -> HybridResult:
    """Fitted with the normal equations of all rows."""
    with no_type_checker():
        return calibrator(products, False).fit(data()[0])


@functools.cache
def trained(products: bool) -> HybridResult:
    """The same on mini-batches."""
    with no_type_checker():
        return calibrator(products).fit(data()[0])


def rms(result: HybridResult) -> float:
    """Of the positions' errors on rows that were not trained on [m]."""
    return float(result.errors_of(data()[1])["position"].square().sum(1).mean().sqrt())


@pytest.mark.parametrize("products", [False, True], ids=["additive", "products"])
def test_held_out_rows_err_by_as_much_as_after_the_exact_fit(products):
    found = trained(products)
    assert found.learned is not None
    assert bool(found.learned.correction.orders) == products
    assert set(found.learned.correction.orders) <= {2}
    assert rms(found) < 1.05 * rms(exact(products))
    assert rms(found) < 0.6 * rms(dataclasses.replace(found, learned=None))


def test_base_and_tool_are_found_as_by_the_exact_fit():
    found, wanted = trained(False).learned, exact(False).learned
    assert found is not None
    assert wanted is not None
    for name, base in wanted.geometry.bases.items():
        assert_close(torch.from_numpy(found.geometry.bases[name]), torch.from_numpy(base), atol=2e-5)
    for name, tool in wanted.geometry.tools.items():
        assert_close(torch.from_numpy(found.geometry.tools[name][:3]), torch.from_numpy(tool[:3]), atol=2e-5)


def test_uncertainty_is_that_of_the_exact_fit():
    few = data()[1].select(torch.arange(50))
    assert_close(trained(False).deviation(few), exact(False).deviation(few), atol=0, rtol=0.25)


def test_the_verdict_says_how_near_to_the_optimum_it_came():
    assert "to within 0." in trained(False).verdict
    assert "more than" not in trained(False).verdict
    with no_type_checker():
        settings = MiniBatches(batch_rows=ROWS, epochs=1, learning_rate=1e-3)
        short = calibrator(False, settings).fit(data()[0])
    assert "give more than 1 epochs" in short.verdict


def test_a_seed_repeats_exactly_and_another_differs():
    with no_type_checker():
        again = calibrator(False).fit(data()[0])
        other = calibrator(False, SETTINGS.model_copy(update={"seed": 1})).fit(data()[0])
    poses = trained(False).predicted_poses(data()[1])
    assert_close(again.predicted_poses(data()[1]), poses, atol=0)
    assert float((other.predicted_poses(data()[1]) - poses).abs().max()) > 1e-9


def test_an_interrupted_training_goes_on_where_it_was(tmp_path: Path):
    def interrupt(what: str) -> None:
        if "epoch 5" in what:
            raise InterruptedError

    with no_type_checker():
        with pytest.raises(InterruptedError):
            calibrator(False).fit(data()[0], interrupt, checkpoints=tmp_path)
        epochs: list[str] = []
        resumed = calibrator(False).fit(data()[0], epochs.append, checkpoints=tmp_path, resume=True)
    assert not any("epoch 3 " in what for what in epochs)
    assert any("epoch 6 " in what for what in epochs)
    assert_close(resumed.predicted_poses(data()[1]), trained(False).predicted_poses(data()[1]), atol=0)


def test_a_checkpoint_of_other_settings_is_refused(tmp_path: Path):
    with pytest.raises(TrainingError, match="without --resume"):
        calibrator(False).fit(data()[0], checkpoints=tmp_path, resume=True)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"batch_rows": 0}, "batch_rows\n  Input should be greater than 0"),
        ({"batch_rows": 2.5}, "batch_rows\n  Input should be a valid integer"),
        ({"epochs": -1}, "epochs\n  Input should be greater than 0"),
        ({"seed": -1}, "seed\n  Input should be greater than or equal to 0"),
        ({"learning_rate": 0.0}, "learning_rate\n  Input should be greater than 0"),
        ({"learning_rate": float("nan")}, "learning_rate\n  Input should be a finite number"),
        ({"batch": 10}, "batch\n  Extra inputs"),
    ],
)
def test_nonsense_is_refused(wrong, said):
    with pytest.raises(ValueError, match=said):
        MiniBatches(**wrong)


def test_an_epoch_counts_all_rows_equally_and_keeps_pairs_together():
    rows, pairs = 23, 3
    tape = SimpleNamespace(certain=True, present=torch.arange(rows) >= 21)
    tracker = SimpleNamespace(certain=False, present=torch.arange(rows) < 21)
    problem = SimpleNamespace(q=torch.zeros(rows, 6), pairs=pairs, sensors=(tracker, tape))
    schedule = BatchSchedule(batches=4, epochs=2, learning_rate=0.1, seed=0)
    total, orders = torch.zeros(rows).double(), []
    with no_type_checker():
        batches = BatchRows(problem, schedule)
        for epoch in range(2):
            for number in range(4):
                chosen, counts = batches.of(epoch, number)
                total[chosen] += counts
                assert {21, 22} <= set(chosen.tolist())
                assert all((row ^ 1) in chosen for row in chosen.tolist() if row < 2 * pairs)
                orders.append(chosen.tolist())
    assert_close(total, torch.full((rows,), 8.0).double(), atol=0)
    assert orders[:4] != orders[4:]


def test_a_training_that_diverges_says_so():
    with no_type_checker(), pytest.raises(TrainingError, match="diverged in epoch 1; lower learning_rate"):
        calibrator(False, SETTINGS.model_copy(update={"learning_rate": 1e200})).fit(data()[0])


def test_very_many_rows_are_trained_on_mini_batches(monkeypatch):
    monkeypatch.setattr("pisigma.calibration.hybrid.calibrator.MANY_ROWS", ROWS)
    with no_type_checker():
        automatic = calibrator(False, "auto")
        assert automatic._batches(ROWS) == MiniBatches()
        assert automatic._batches(ROWS - 1) is None
        assert calibrator(False, True)._batches(1) == MiniBatches()
        assert calibrator(False, False)._batches(ROWS) is None
