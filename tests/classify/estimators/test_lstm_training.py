"""The compiled training is PyTorch's, step by step, on any number of threads and for any size."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from thermogrip.classify.estimators.lstm_training import _CURVE, _to_tanh, train_network

Reals = NDArray[Any]


def problem(
    real: type, *, hidden: int, sensors: int = 1, n: int = 60, n_time: int = 20, classes: int = 3
) -> tuple[dict[str, Reals], Reals, NDArray[np.int64]]:
    """Return weights as PyTorch draws them, series whose drift identifies their class, and the classes."""
    rng = np.random.default_rng(0)
    target = rng.integers(0, classes, n)
    drift = target[:, None, None] * np.linspace(0, 1, n_time)[None, :, None]
    x = (drift + 0.3 * rng.standard_normal((n, n_time, sensors))).astype(real)
    edge = hidden**-0.5
    shapes = {
        "lstm.weight_ih_l0": (4 * hidden, sensors),
        "lstm.weight_hh_l0": (4 * hidden, hidden),
        "lstm.bias_ih_l0": (4 * hidden,),
        "lstm.bias_hh_l0": (4 * hidden,),
        "readout.weight": (classes, hidden),
        "readout.bias": (classes,),
    }
    return {k: rng.uniform(-edge, edge, s).astype(real) for k, s in shapes.items()}, x, target


def shuffled(n: int, batch: int, epochs: int) -> list[list[NDArray[np.int64]]]:
    """Return the rows of each batch of each epoch."""
    rng = np.random.default_rng(1)
    orders = [rng.permutation(n) for _ in range(epochs)]
    return [[order[k : k + batch] for k in range(0, n, batch)] for order in orders]


def by_pytorch(
    weights: dict[str, Reals], x: Reals, target: NDArray[np.int64], epochs: list[list[NDArray[np.int64]]]
) -> tuple[dict[str, Reals], Reals]:
    """Train with torch.nn.LSTM, cross entropy and torch.optim.Adam."""
    tensors = {k: torch.from_numpy(v.copy()) for k, v in weights.items()}
    kind = tensors["readout.bias"].dtype
    classes, hidden = tensors["readout.weight"].shape
    network = torch.nn.LSTM(x.shape[2], hidden, batch_first=True, dtype=kind)
    readout = torch.nn.Linear(hidden, classes, dtype=kind)
    network.load_state_dict({k[5:]: v for k, v in tensors.items() if k.startswith("lstm.")})
    readout.load_state_dict({k[8:]: v for k, v in tensors.items() if k.startswith("readout.")})
    adam = torch.optim.Adam([*network.parameters(), *readout.parameters()], lr=0.003)
    series, truth, losses = torch.from_numpy(x), torch.from_numpy(target), []
    for batches in epochs:
        total = 0.0
        for rows in map(torch.from_numpy, batches):
            loss = torch.nn.functional.cross_entropy(readout(network(series[rows])[1][0][0]), truth[rows])
            adam.zero_grad()
            loss.backward()
            adam.step()
            total += float(loss.detach()) * rows.numel()
        losses.append(total / x.shape[0])
    state = {f"lstm.{k}": v.numpy() for k, v in network.state_dict().items()}
    state |= {f"readout.{k}": v.numpy() for k, v in readout.state_dict().items()}
    return state, np.array(losses)


# double precision compiles all of it once more
@pytest.mark.parametrize(
    ("real", "error"),
    [(np.float32, 5e-6), pytest.param(np.float64, 1e-9, marks=pytest.mark.slow)],
)
@pytest.mark.parametrize(
    ("hidden", "sensors", "batch", "n_time"), [(32, 1, 60, 20), (12, 2, 24, 20), (40, 1, 7, 6), (1, 3, 60, 1)]
)
def test_steps_are_pytorchs(
    hidden: int, sensors: int, batch: int, n_time: int, real: type, error: float
) -> None:
    weights, x, target = problem(real, hidden=hidden, sensors=sensors, n_time=n_time)
    epochs = shuffled(60, batch, 4)
    got, losses = train_network(weights, x, target, epochs, learning_rate=0.003)
    expected, reference = by_pytorch(weights, x, target, epochs)
    np.testing.assert_allclose(losses, reference, rtol=error)
    for name, value in expected.items():
        assert got[name].shape == value.shape
        np.testing.assert_allclose(got[name], value, atol=max(100 * error, 1e-7))


def test_the_numbers_do_not_depend_on_threads() -> None:
    weights, x, target = problem(np.float32, hidden=8)
    epochs = shuffled(60, 60, 5)
    before = {k: v.copy() for k, v in weights.items()}
    alone, losses = train_network(weights, x, target, epochs, learning_rate=0.01)
    assert all(np.array_equal(before[k], weights[k]) for k in weights)  # what was given is left alone
    for threads in (2, 3):
        shared, others = train_network(weights, x, target, epochs, learning_rate=0.01, threads=threads)
        assert np.array_equal(losses, others)
        assert all(np.array_equal(alone[k], shared[k]) for k in alone)


def test_what_is_not_a_number_is_not_hidden() -> None:
    weights, x, target = problem(np.float32, hidden=8)
    x[3, 5] = np.nan
    _, losses = train_network(weights, x, target, shuffled(60, 60, 1), learning_rate=0.01)
    assert np.isnan(losses[0])


def test_tanh_is_cut_at_8_where_it_is_2e_7_from_1() -> None:
    z = np.linspace(-30, 30, 3201, dtype=np.float32)[None]
    expected = np.tanh(z.astype(float))
    _to_tanh(z, tuple(map(np.float32, _CURVE)))
    np.testing.assert_allclose(z, expected, atol=2e-7)
