"""A plain network on the residuals of a fitted geometry, with torch."""

import numpy as np

from shared_benchmark.methods._residual import Correct, fit_residuals, names_of, turns, with_targets
from shared_benchmark.rows import Array, Method, Predict, Rows, Task

HIDDEN, EPOCHS, RATE, DECAY = 64, 2000, 3e-3, 1e-3
VALIDATION = 0.15
"""Share of the training rows at which training stops."""


def _regression(train: Rows, residual: Array, seed: int) -> Correct:
    import torch
    from torch import nn

    names, generator = names_of(train), torch.Generator().manual_seed(seed)
    x = torch.from_numpy(with_targets(turns(train.q), train, names))
    scale = residual.std()
    y = torch.from_numpy(residual / scale)
    groups = np.unique(train.q, axis=0, return_inverse=True)[1].ravel()
    order = torch.randperm(int(groups.max()) + 1, generator=generator).numpy()
    held_out = torch.from_numpy(np.isin(groups, order[: max(1, round(VALIDATION * len(order)))]))
    torch.manual_seed(seed)
    layers = (
        nn.Linear(x.shape[1], HIDDEN),
        nn.Tanh(),
        nn.Linear(HIDDEN, HIDDEN),
        nn.Tanh(),
        nn.Linear(HIDDEN, 3),
    )
    network = nn.Sequential(*layers).double()
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
    best, state = np.inf, network.state_dict()
    for _ in range(EPOCHS):
        optimiser.zero_grad()
        loss = (network(x[~held_out]) - y[~held_out]).square().mean()
        loss.backward()
        optimiser.step()
        with torch.no_grad():
            error = float((network(x[held_out]) - y[held_out]).square().mean())
        if error < best:
            best, state = error, {name: values.clone() for name, values in network.state_dict().items()}
    network.load_state_dict(state)

    def correct(rows: Rows) -> tuple[Array, None]:
        with torch.no_grad():
            shift = network(torch.from_numpy(with_targets(turns(rows.q), rows, names)))
        return shift.numpy() * scale, None

    return correct


def fit(task: Task) -> Predict:
    """Fit the geometry, and a network with two hidden layers to its residuals."""
    return fit_residuals(task, _regression)


METHOD = Method(
    name="mlp_residual",
    title="geometry, then a network of two hidden layers of 64 units",
    source="plain multilayer perceptron with early stopping, with torch",
    packages=("torch", "numpy", "scipy"),
    measured=("position", "pose"),
    fit=fit,
)
