"""Training with Lightning: seeds, independent outputs, divergence, resuming at the end, silence."""

import csv
import dataclasses

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import TrainingError
from pisigma.network.energy import energy_gradient
from pisigma.network.levenberg_marquardt import Patterns
from pisigma.network.networks import NetworkTraining, fit_networks
from pisigma.network.pi_sigma import PiSigma
from pisigma.network.sections import GradientDescentSection, LevenbergMarquardtSection, MiniBatchSection
from pisigma.network.trainer import Checkpoints

NAMES = ["a", "b"]
DESCENT = GradientDescentSection(
    method="gradient_descent", learning_rate={"a": 0.02, "b": 0.01}, epochs=50, spread=0.2
)
SQUARES = LevenbergMarquardtSection(method="levenberg_marquardt", epochs=12, starts=2)
BATCHES = MiniBatchSection(method="mini_batches", batch_rows=8, epochs=10, learning_rate=0.05)
METHODS = [DESCENT, SQUARES, BATCHES]
ALL = pytest.mark.parametrize("fit", METHODS, ids=[fit.method for fit in METHODS])
BOTH = pytest.mark.parametrize("fit", METHODS[:2], ids=[fit.method for fit in METHODS[:2]])


@pytest.fixture
def data(generator) -> Patterns:
    x = 2 * torch.rand(30, 2, generator=generator, dtype=torch.float64) - 1
    d = 1 + 0.3 * torch.randn(30, 2, generator=generator, dtype=torch.float64)
    return Patterns(x, d, torch.zeros(30, dtype=torch.bool))


def fit_one(data: Patterns, fit, **options) -> tuple[PiSigma, torch.Tensor]:
    network = PiSigma(2, 2, (2,), fixed_product=0.5)
    history = fit_networks([network], [data], [NAMES], fit, **options)
    return network, history.energies


@ALL
def test_a_seed_repeats_exactly_and_another_differs(data, fit):
    first, energies = fit_one(data, fit)
    second, again = fit_one(data, fit)
    other, _ = fit_one(data, fit.model_copy(update={"seed": 1}))
    assert_close(again, energies, atol=0)
    assert_close(second.weight, first.weight, atol=0)
    assert_close(second.bias, first.bias, atol=0)
    assert float((other.weight - first.weight).detach().abs().max()) > 1e-6


@BOTH
def test_targets_of_one_output_do_not_affect_the_other(data, fit):
    changed = dataclasses.replace(data, d=torch.stack([data.d[:, 0], data.d[:, 1] + data.x[:, 0]], 1))
    first, second = fit_one(data, fit)[0], fit_one(changed, fit)[0]
    assert_close(second.weight[0], first.weight[0], atol=0)
    assert_close(second.bias[0], first.bias[0], atol=0)
    assert float((second.weight[1] - first.weight[1]).detach().abs().max()) > 1e-6


def test_the_learning_rate_of_one_output_does_not_affect_the_other(data):
    faster = DESCENT.model_copy(update={"learning_rate": {"a": 0.02, "b": 0.03}})
    first, second = fit_one(data, DESCENT)[0], fit_one(data, faster)[0]
    assert_close(second.weight[0], first.weight[0], atol=0)
    assert float((second.weight[1] - first.weight[1]).detach().abs().max()) > 1e-6


def test_gradient_descent_is_the_papers_rule(data):
    network = PiSigma(2, 2, (2,), fixed_product=0.5)
    network.initialise(0.2, torch.Generator().manual_seed(0))
    energies = []
    for _ in range(50):
        E, weight_gradient, bias_gradient = energy_gradient(network, data.x, data.d)
        energies.append(E)
        with torch.no_grad():
            rates = torch.tensor([0.02, 0.01], dtype=torch.float64)
            network.weight -= rates[:, None, None] * weight_gradient
            network.bias -= rates[:, None] * bias_gradient
    trained, history = fit_one(data, DESCENT)
    assert_close(history, torch.stack(energies), rtol=1e-12)
    assert_close(trained.weight, network.weight, rtol=1e-12)
    assert_close(trained.bias, network.bias, rtol=1e-12)
    assert float((history[-1] / history[0]).max()) < 1


@BOTH
def test_fixed_weights_are_not_optimised(data, fit):
    network, _ = fit_one(data, fit)
    assert_close(network.fixed, torch.full((2, 2), 0.5**0.5, dtype=torch.float64), atol=0)
    module = NetworkTraining([network], fit, [NAMES])
    assert {name for name, _ in module.named_parameters()} == {"networks.0.weight", "networks.0.bias"}
    optimiser = module.configure_optimizers()
    parameters = [p.data_ptr() for group in optimiser.param_groups for p in group["params"]]
    assert parameters == [network.weight.data_ptr(), network.bias.data_ptr()]


def test_a_step_follows_the_rates(data):
    rates = {"a": 1e-300, "b": 0.02}
    fit = DESCENT.model_copy(update={"learning_rate": rates, "epochs": 1})
    network = PiSigma(2, 2, (2,), fixed_product=0.5)
    network.initialise(fit.spread, torch.Generator().manual_seed(fit.seed))
    _, _, bias_gradient = energy_gradient(network, data.x, data.d)
    trained, _ = fit_one(data, fit)
    assert_close(trained.bias[0], network.bias[0], atol=0)
    assert_close(trained.bias[1], network.bias[1] - 0.02 * bias_gradient[1], rtol=1e-15)


@pytest.mark.parametrize("epochs", [400, 9])
def test_a_diverging_training_is_reported(data, epochs):
    fit = DESCENT.model_copy(update={"learning_rate": {"a": 0.01, "b": 1e60}, "epochs": epochs})
    with refused(TrainingError, value="b", option="fit.learning_rate.b"):
        fit_one(data, fit)


def test_a_diverging_last_step_is_reported(data):
    fit = DESCENT.model_copy(update={"learning_rate": {"a": 1e-3, "b": 1e308}, "epochs": 1})
    scaled = dataclasses.replace(data, d=data.d * torch.tensor([1.0, 1e3], dtype=torch.float64))
    with refused(TrainingError, value="b", option="fit.learning_rate.b"):
        fit_one(scaled, fit)


@ALL
@pytest.mark.parametrize("part", ["x", "d"])
def test_patterns_that_are_not_finite_are_rejected(data, fit, part):
    values = getattr(data, part).clone()
    values[7, 1] = torch.nan
    with refused(TrainingError, expected="finite patterns", value=7):
        fit_one(dataclasses.replace(data, **{part: values}), fit)


@ALL
def test_resuming_a_completed_training_changes_nothing(data, fit, tmp_path):
    fit = fit.model_copy(update={"epochs": 20})
    first, energies = fit_one(data, fit, checkpoints=Checkpoints(tmp_path, "f"))
    second, again = fit_one(data, fit, checkpoints=Checkpoints(tmp_path, "f", resume=True))
    assert_close(again, energies, atol=0)
    assert_close(second.weight, first.weight, atol=0)
    assert_close(second.bias, first.bias, atol=0)
    with refused(TrainingError, file=tmp_path, expected="the same recipe and data"):
        fit_one(data, fit, checkpoints=Checkpoints(tmp_path, "g", resume=True))


def test_nothing_is_printed_without_a_terminal_or_written_to_the_working_folder(
    data, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    fit_one(data, DESCENT, show_progress=True)
    captured = capfd.readouterr()
    assert (captured.out, captured.err) == ("", "")
    assert list(tmp_path.iterdir()) == []


def test_the_number_of_threads_is_restored(data):
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        fit_one(data, DESCENT)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def interrupt_after(epochs: int, monkeypatch) -> None:
    """Simulate Ctrl-C after a number of epochs."""
    step = NetworkTraining.training_step

    def interrupting(self, batch, batch_idx):
        if int(self.epochs_done) == epochs:
            raise KeyboardInterrupt
        return step(self, batch, batch_idx)

    monkeypatch.setattr(NetworkTraining, "training_step", interrupting)


@ALL
def test_an_interrupted_training_resumes_to_the_same(data, fit, tmp_path, monkeypatch):
    whole, energies = fit_one(data, fit)
    checkpoints = Checkpoints(tmp_path, "f")
    with monkeypatch.context() as patch:
        interrupt_after(6, patch)
        with pytest.raises(KeyboardInterrupt):
            fit_one(data, fit, checkpoints=checkpoints)
    assert [entry.name for entry in tmp_path.iterdir()] == ["last.ckpt"]
    network = PiSigma(2, 2, (2,), fixed_product=0.5)
    checkpoints = dataclasses.replace(checkpoints, resume=True)
    history = fit_networks([network], [data], [NAMES], fit, checkpoints=checkpoints)
    assert 0 < history.resumed_from <= 6
    assert_close(history.energies, energies, atol=0)
    assert_close(network.weight, whole.weight, atol=0)
    assert_close(network.bias, whole.bias, atol=0)


@pytest.mark.parametrize("optimiser", ["adam", "adamw", "sgd"])
def test_mini_batches_approach_least_squares(generator, optimiser):
    x = 2 * torch.rand(400, 2, generator=generator, dtype=torch.float64) - 1
    d = 0.05 * (1 + 0.4 * x[:, :1]) * torch.stack([1 + 0.3 * x[:, 1], 1 - 0.2 * x[:, 1]], 1)
    exact = Patterns(x, d, torch.zeros(400, dtype=torch.bool))
    rate = 0.5 if optimiser == "sgd" else 0.05
    fit = MiniBatchSection(
        method="mini_batches", batch_rows=50, epochs=80, learning_rate=rate, optimiser=optimiser
    )
    network = PiSigma(2, 2, (2,), fixed_product=0.05)
    energies = fit_networks([network], [exact], [NAMES], fit).energies
    assert energies.shape == (80, 2)
    assert float((energies[-1] / energies[0]).max()) < 1e-3


def test_logs_contain_every_epoch(data, tmp_path):
    _, energies = fit_one(data, BATCHES, logs=tmp_path)
    rows = list(csv.DictReader((tmp_path / "metrics.csv").read_text().splitlines()))
    assert_close([float(row["energy_b"]) for row in rows], energies[:, 1], rtol=1e-6)
