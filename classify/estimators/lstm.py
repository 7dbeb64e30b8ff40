r"""The paper's network: one LSTM layer and a linear readout of its last state.

With :math:`\sigma` the logistic function and :math:`x_t` the standardised temperature,

.. math::
   i, f, o = \sigma(W x_t + U h_{t-1} + b), \quad g = \tanh(\cdot), \quad
   c_t = f c_{t-1} + i g, \quad h_t = o \tanh c_t, \quad p = \mathrm{softmax}(V h_T + v).

As in Osawa et al. (arXiv 2111.15344): batches of 100, 2000 epochs, training grasps copied with noise and
shifts of the initial temperature up to a hundred series a material.  Hidden size (32), Adam and its rate are
ours, the paper does not give them.

What the network is fed matters more than its size.  ``"trace"`` is the plain reading of the paper: one mean
and one scale for all temperatures.  Copper and iron, 0.4 K apart on a rise of 5 K, are then a few percent of
the input's spread and take the network long to find.  ``"each_time"`` takes the mean training trace off and
brings every sample time to spread 1, so that the network sees how grasps differ and not what they share.

Training runs in compiled code (:mod:`thermogrip.classify.estimators.lstm_training`) or, where PyTorch finds
one, on a GPU; weights and batches are drawn by PyTorch's generator in either case, so that a seed is the
same training, to rounding.  PyTorch is the extra ``lstm``; prediction needs neither.

**Augmentation.**  Each copy is one real trace plus white noise on every sample and one shift of the whole
trace, which is what another initial temperature is to a network that sees temperatures.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import parent_process
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit

from thermogrip.classify.estimators.base import (
    Floats,
    JoinedClassifier,
    Labels,
    as_array,
    check_shapes,
    times_from,
)
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps


class Augmented(NamedTuple):
    """``traces`` (n_series, n_time) [degC], ``labels`` and ``source`` (row of the real trace) (n_series,)."""

    traces: NDArray[np.float64]
    labels: NDArray[np.str_]
    source: NDArray[np.int64]


def augment(
    traces: ArrayLike,
    labels: ArrayLike,
    *,
    series_per_class: int = 100,
    noise_sd: float = 0.05,
    shift_sd: float = 0.3,
    seed: int = 0,
) -> Augmented:
    """Return about ``series_per_class`` copies a class of traces (n_grasp, n_time) [degC], the same number of
    each of its grasps, with white noise and one shift each of these standard deviations [degC]."""
    x, y = np.asarray(traces, dtype=float), np.asarray(labels).astype(str)
    if min(noise_sd, shift_sd) < 0 or series_per_class < 1:
        raise UserError(
            f"cannot augment with {series_per_class=}, {noise_sd=:g}, {shift_sd=:g}",
            hint="use at least one series and no negative spread",
        )
    rng = np.random.default_rng(seed)
    grasps_of = dict(zip(*np.unique(y, return_counts=True)))
    copies = [-(-series_per_class // int(grasps_of[label])) for label in y]
    source = np.repeat(np.arange(y.size), copies)
    noise = noise_sd * rng.standard_normal((source.size, x.shape[1]))
    shift = shift_sd * rng.standard_normal((source.size, 1))
    return Augmented(x[source] + noise + shift, y[source], source)


PAPER_EPOCHS = 2000
QUICK_EPOCHS = 200
FEEDS = ("each_time", "trace")
_LEAST_SD = 0.05  # degC; before contact a smaller spread is noise, not to be blown up
_MOST_THREADS = 2  # a batch of 100 is two pieces


@dataclass(eq=False, repr=False)
class LstmClassifier(JoinedClassifier):
    """The paper's LSTM, fed with what differs between grasps (``"lstm"``); ``loss_curve_`` has each epoch's
    mean training cross entropy."""

    reads_both_sensors: ClassVar[bool] = True
    needs: ClassVar[tuple[str, str] | None] = ("torch", "lstm")
    own_feed: ClassVar[str] = "each_time"

    hidden: int = 32  # size of the state
    epochs: int = PAPER_EPOCHS  # over the augmented training set; 200 is quick and undertrained
    batch: int = 100  # series
    learning_rate: float = 1e-3  # of Adam
    series_per_class: int = 100  # of :func:`augment`, as the next two
    noise_sd: float = 0.05
    shift_sd: float = 0.3
    start: float = 0.0  # first time that the network sees [s]
    feed: str | None = None  # "each_time", or "trace", the default of ``lstm-paper``
    device: str = "auto"  # where to train: the GPU where there is one; "cpu" or "cuda"
    random_state: int = 0  # of weights, copies and batches: the same network on the same machine

    def _fit(self, grasps: Grasps, labels: Labels) -> None:
        self._check_params()
        self.times_ = times_from(grasps, self.start)
        real = as_array(grasps, times=self.times_)
        self.mean_, self.sd_ = self._standard(real)
        size, noise, shift = self.series_per_class, self.noise_sd, self.shift_sd
        made = augment(
            real, labels, series_per_class=size, noise_sd=noise, shift_sd=shift, seed=self.random_state
        )
        target = np.searchsorted(self.classes_, made.labels)
        series = self._series((made.traces - self.mean_) / self.sd_)
        weights, epochs = _drawn(self, series.shape, self.classes_.size)
        train, rate = _trainer(self.device), self.learning_rate
        self.weights_, self.loss_curve_ = train(weights, series, target, epochs, learning_rate=rate)

    def _check_params(self) -> None:
        if min(self.hidden, self.epochs, self.batch) < 1 or not self.learning_rate > 0:
            raise UserError(
                f"cannot train with hidden={self.hidden}, epochs={self.epochs}, batch={self.batch}, "
                f"learning_rate={self.learning_rate}",
                hint="all must be positive",
            )
        if self.feed not in (None, *FEEDS):
            raise UserError(f"feed is {self.feed!r}", hint=f"use {' or '.join(FEEDS)}")
        if self.device not in ("auto", "cpu", "cuda"):
            raise UserError(f"device is {self.device!r}", hint="use auto, cpu or cuda")

    def _standard(self, real: Floats) -> tuple[Floats, Floats]:
        """Return what is taken off the traces and what they are divided by."""
        if (self.feed or self.own_feed) == "trace":
            return np.full(real.shape[1], real.mean()), np.full(real.shape[1], max(real.std(), _LEAST_SD))
        return real.mean(axis=0), np.maximum(real.std(axis=0), _LEAST_SD)

    def _series(self, x: Floats) -> NDArray[np.float32]:
        """Return (n_series, n_time, n_sensor)."""
        cube = x.reshape(x.shape[0], -1, self.times_.size)
        return np.ascontiguousarray(cube.transpose(0, 2, 1), dtype=np.float32)

    def _log_proba(self, grasps: Grasps) -> Floats:
        x = (as_array(grasps, times=self.times_) - self.mean_) / self.sd_
        return _logits(self.weights_, self._series(x))

    def get_state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        arrays = {"times": self.times_, "mean": self.mean_, "sd": self.sd_, "loss_curve": self.loss_curve_}
        return {}, arrays | {f"weights.{k}": v for k, v in self.weights_.items()}

    def set_state(self, numbers: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
        self.times_, self.mean_, self.sd_ = arrays["times"], arrays["mean"], arrays["sd"]
        self.loss_curve_ = arrays["loss_curve"]
        n, k = self.times_.size * (getattr(self, "sensors_", None) or 1), self.classes_.size
        check_shapes(arrays, mean=(n,), sd=(n,))
        self.weights_ = _part(arrays, "weights.")
        check_shapes(self.weights_, **{"readout.weight": (k, self.hidden), "readout.bias": (k,)})


class PaperLstm(LstmClassifier):
    """The paper's LSTM as described there, fed with plain temperatures (``"lstm-paper"``)."""

    own_feed: ClassVar[str] = "trace"


Weights = dict[str, NDArray[Any]]
Trainer = Callable[..., tuple[Weights, Floats]]


def _drawn(
    model: LstmClassifier, shape: tuple[int, ...], classes: int
) -> tuple[Weights, list[list[NDArray[np.int64]]]]:
    """Return the first weights and the rows of each batch of each epoch, as PyTorch draws them."""
    import torch

    rows, orders = shape[0], []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(model.random_state)
        network, readout = torch.nn.LSTM(shape[2], model.hidden), torch.nn.Linear(model.hidden, classes)
        for _ in range(model.epochs):
            orders.append(torch.randperm(rows).split(model.batch))  # type: ignore[no-untyped-call]
    return _named(network, readout), [[b.numpy() for b in order] for order in orders]


def _trainer(device: str) -> Trainer:
    import torch

    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("PyTorch finds no GPU", hint="use device cpu or auto")
    if device == "cuda" or (device == "auto" and torch.cuda.is_available()):
        return partial(_train_torch, device="cuda")
    from thermogrip.classify.estimators.lstm_training import train_network

    # a worker process has its siblings for the other cores
    threads = 1 if parent_process() is not None else min(os.cpu_count() or 1, _MOST_THREADS)
    return partial(train_network, threads=threads)


def _train_torch(
    weights: Weights,
    series: NDArray[np.float32],
    target: NDArray[np.int64],
    epochs: Sequence[Sequence[NDArray[np.int64]]],
    *,
    learning_rate: float,
    device: str,
) -> tuple[Weights, Floats]:
    """Train in PyTorch, everything on the device from the start: no loader, no copies between the batches."""
    import torch

    classes, hidden = weights["readout.weight"].shape
    x, y = torch.from_numpy(series).to(device), torch.from_numpy(target.astype(np.int64)).to(device)
    network = torch.nn.LSTM(series.shape[2], hidden, batch_first=True)
    readout = torch.nn.Linear(hidden, classes)
    tensors = {k: torch.from_numpy(v.copy()) for k, v in weights.items()}
    network.load_state_dict(_part(tensors, "lstm."))
    readout.load_state_dict(_part(tensors, "readout."))
    network, readout = network.to(device), readout.to(device)
    adam = torch.optim.Adam([*network.parameters(), *readout.parameters()], lr=learning_rate)
    losses = torch.zeros(len(epochs), dtype=torch.float64, device=device)
    for k, batches in enumerate(epochs):
        for order in batches:
            rows = torch.from_numpy(order).to(device)
            loss = torch.nn.functional.cross_entropy(readout(network(x[rows])[1][0][0]), y[rows])
            adam.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            adam.step()
            losses[k] += loss.detach() * (rows.numel() / y.numel())
    return _named(network, readout), losses.cpu().numpy()


def _named(network: Any, readout: Any) -> Weights:
    """Return the weights of both PyTorch modules by name."""
    parts = {"lstm": network.state_dict(), "readout": readout.state_dict()}
    return {f"{name}.{k}": v.cpu().numpy() for name, part in parts.items() for k, v in part.items()}


def _logits(weights: Mapping[str, NDArray[Any]], series: NDArray[np.float32]) -> Floats:
    """Return the readout of the last state of each series, (n_series, K)."""
    # in doubles a series' answer is the same in any batch, to 1e-12
    inputs, recurrent = (weights[f"lstm.weight_{kind}_l0"].T.astype(float) for kind in ("ih", "hh"))
    bias = weights["lstm.bias_ih_l0"].astype(float) + weights["lstm.bias_hh_l0"]
    state = cell = np.zeros((series.shape[0], recurrent.shape[0]))
    for t in range(series.shape[1]):
        i, f, g, o = np.split(series[:, t] @ inputs + state @ recurrent + bias, 4, axis=1)
        cell = expit(f) * cell + expit(i) * np.tanh(g)
        state = expit(o) * np.tanh(cell)
    return np.asarray(state @ weights["readout.weight"].T + weights["readout.bias"], dtype=float)


def _part(named: dict[str, Any], prefix: str) -> dict[str, Any]:
    return {key[len(prefix) :]: value for key, value in named.items() if key.startswith(prefix)}
