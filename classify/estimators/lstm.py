r"""The paper's network: one LSTM layer and a linear readout of its last state.

With :math:`\sigma` the logistic function and :math:`x_t` the standardised temperature,

.. math::
   i, f, o = \sigma(W x_t + U h_{t-1} + b), \quad g = \tanh(\cdot), \quad
   c_t = f c_{t-1} + i g, \quad h_t = o \tanh c_t, \quad p = \mathrm{softmax}(V h_T + v).

As in Osawa et al. (arXiv 2111.15344), but for what the paper does not give.  PyTorch trains; prediction does
not need it.
"""

from __future__ import annotations

from dataclasses import dataclass
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
    unit_names,
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
    # white noise on every sample, and one shift of the whole trace, which is what another initial temperature
    # is to a network that sees temperatures
    source = np.repeat(np.arange(y.size), copies)
    noise = noise_sd * rng.standard_normal((source.size, x.shape[1]))
    shift = shift_sd * rng.standard_normal((source.size, 1))
    return Augmented(x[source] + noise + shift, y[source], source)


# Osawa et al.: batches of 100, 2000 epochs, training grasps copied with noise and shifts of the initial
# temperature up to a hundred series a material
PAPER_EPOCHS = 2000
QUICK_EPOCHS = 200
FEEDS = ("each_time", "trace")  # how grasps differ at each time; the plain reading, as in the paper
_LEAST_SD = 0.05  # degC; before contact a smaller spread is noise, not to be blown up
_LEAST_GAIN = 1e-3  # nats: a loss of nearly nothing falls for thousands of epochs and names no grasp better


@dataclass(eq=False, repr=False)
class LstmClassifier(JoinedClassifier):
    """The paper's LSTM, fed with what differs between grasps (``"lstm"``); ``loss_curve_`` has each epoch's
    mean training cross entropy."""

    reads_both_sensors: ClassVar[bool] = True
    needs: ClassVar[tuple[str, str] | None] = ("torch", "lstm")
    own_feed: ClassVar[str] = "each_time"

    # hidden size, Adam and its rate are ours, the paper does not give them
    hidden: int = 32  # size of the state
    epochs: int = PAPER_EPOCHS  # over the augmented training set, at most; 200 is quick and undertrained
    patience: int | None = 200  # epochs without a lower loss of held-out grasps; None: all epochs
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
        target = np.searchsorted(self.classes_, labels).astype(np.int64)
        epochs = self.epochs
        split = _early_stopping_rows(grasps, labels, seed=self.random_state)
        # A network that has found what tells materials apart goes on to learn the grasps by heart.  So one of
        # five groups (sessions, else blocks) is held out first, to see for how long to train; then all
        # grasps train for as many.
        if split is not None and self.patience is not None and self.epochs > self.patience:
            fitted, held_out = split
            self.mean_, self.sd_ = self._standard(real[fitted])
            held_out_series = self._series(real[held_out]), target[held_out]
            series, classes = self._copies(real[fitted], target[fitted])
            epochs = _train(self, series, classes, epochs=epochs, held_out=held_out_series).best
        self.mean_, self.sd_ = self._standard(real)
        series, classes = self._copies(real, target)
        self.weights_, self.loss_curve_, _ = _train(self, series, classes, epochs=epochs)

    def _copies(
        self, real: Floats, target: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Return augmented series of traces, and their classes."""
        made = augment(
            real,
            target,
            series_per_class=self.series_per_class,
            noise_sd=self.noise_sd,
            shift_sd=self.shift_sd,
            seed=self.random_state,
        )
        return self._series(made.traces), target[made.source]

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
        if self.patience is not None and self.patience < 1:
            raise UserError(f"patience is {self.patience}", hint="use at least 1 epoch; None: all of them")

    def _standard(self, real: Floats) -> tuple[Floats, Floats]:
        """Return what is taken off the traces and what they are divided by."""
        # One mean and one scale for all temperatures: copper and iron, 0.4 K apart on a rise of 5 K, are then
        # a few percent of the input's spread and take the network long to find.  Else the mean training trace
        # is taken off and every sample time has spread 1: how grasps differ and not what they share.
        if (self.feed or self.own_feed) == "trace":
            return np.full(real.shape[1], real.mean()), np.full(real.shape[1], max(real.std(), _LEAST_SD))
        return real.mean(axis=0), np.maximum(real.std(axis=0), _LEAST_SD)

    def _series(self, x: Floats) -> NDArray[np.float32]:
        """Return traces as the network sees them, (n_series, n_time, n_sensor)."""
        cube = ((x - self.mean_) / self.sd_).reshape(x.shape[0], -1, self.times_.size)
        return np.ascontiguousarray(cube.transpose(0, 2, 1), dtype=np.float32)

    def _log_proba(self, grasps: Grasps) -> Floats:
        weights, series = self.weights_, self._series(as_array(grasps, times=self.times_))
        # in doubles a series' answer is the same in any batch, to 1e-12
        inputs, recurrent = (weights[f"lstm.weight_{kind}_l0"].T.astype(float) for kind in ("ih", "hh"))
        bias = weights["lstm.bias_ih_l0"].astype(float) + weights["lstm.bias_hh_l0"]
        state = cell = np.zeros((series.shape[0], recurrent.shape[0]))
        for t in range(series.shape[1]):
            i, f, g, o = np.split(series[:, t] @ inputs + state @ recurrent + bias, 4, axis=1)
            cell = expit(f) * cell + expit(i) * np.tanh(g)
            state = expit(o) * np.tanh(cell)
        return np.asarray(state @ weights["readout.weight"].T + weights["readout.bias"], dtype=float)

    def get_state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        arrays = {"times": self.times_, "mean": self.mean_, "sd": self.sd_, "loss_curve": self.loss_curve_}
        return {}, arrays | {f"weights.{k}": v for k, v in self.weights_.items()}

    def set_state(self, numbers: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
        self.times_ = arrays["times"]
        self.mean_ = arrays["mean"]
        self.sd_ = arrays["sd"]
        self.loss_curve_ = arrays["loss_curve"]
        n, k = self.times_.size * (getattr(self, "sensors_", None) or 1), self.classes_.size
        check_shapes(arrays, mean=(n,), sd=(n,))
        prefix = "weights."
        self.weights_ = {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
        check_shapes(self.weights_, **{"readout.weight": (k, self.hidden), "readout.bias": (k,)})


@dataclass(eq=False, repr=False)
class PaperLstm(LstmClassifier):
    """The paper's LSTM as described there, fed with plain temperatures for all epochs (``"lstm-paper"``)."""

    own_feed: ClassVar[str] = "trace"

    patience: int | None = None


def _early_stopping_rows(
    grasps: Grasps, labels: Labels, *, seed: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
    """Return rows to train on and a fifth that is held out, whole sessions apart, or whole grasps where a
    session has all of a class; None where a class has too few of either."""
    from sklearn.model_selection import StratifiedGroupKFold

    units = unit_names(grasps)
    for groups in (grasps["session"].values.astype(str) if "session" in grasps else units, units):
        fewest = min(np.unique(groups[labels == name]).size for name in np.unique(labels))
        if fewest > 1:
            folds = StratifiedGroupKFold(min(5, fewest), shuffle=True, random_state=seed)
            fitted, held_out = next(folds.split(labels, labels, groups))
            if held_out.size and np.unique(labels[fitted]).size == np.unique(labels).size:
                return fitted, held_out
    return None


Weights = dict[str, NDArray[Any]]


class _Trained(NamedTuple):
    weights: Weights
    loss_curve: Floats  # (n_epoch,) mean cross entropy of the training series
    best: int  # epochs until the least loss


def _train(
    model: LstmClassifier,
    x: NDArray[np.float32],
    y: NDArray[np.int64],
    *,
    epochs: int,
    held_out: tuple[NDArray[np.float32], NDArray[np.int64]] | None = None,
) -> _Trained:
    """Return a network trained on series ``x`` (n_series, n_time, n_sensor) of classes ``y``, for so many
    epochs or until the loss of ``held_out`` has not fallen for ``patience`` of them; with a patience it is
    that of the epoch with the least loss, for the loss of a small set leaps now and then."""
    import torch

    device = _device(model.device)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # products of 100 x 32 numbers are too small to share
    try:
        with torch.random.fork_rng(devices=[]):
            # weights and batches are drawn by PyTorch's generator: a seed is one training on one machine
            torch.manual_seed(model.random_state)
            network = torch.nn.LSTM(x.shape[2], model.hidden, batch_first=True).to(device)
            readout = torch.nn.Linear(model.hidden, model.classes_.size).to(device)
            adam = torch.optim.Adam([*network.parameters(), *readout.parameters()], lr=model.learning_rate)
            series, target = torch.from_numpy(x).to(device), torch.from_numpy(y).to(device)
            held_out_tensors = (
                None if held_out is None else tuple(torch.from_numpy(array).to(device) for array in held_out)
            )

            def loss_of(series: Any, target: Any) -> Any:
                return torch.nn.functional.cross_entropy(readout(network(series)[1][0][0]), target)

            curve = []
            least = float("inf")
            best = epochs
            weights = _weights_by_name(network, readout)
            for epoch in range(1, epochs + 1):
                total = torch.zeros((), device=device)
                for rows in torch.randperm(len(y)).split(model.batch):  # type: ignore[no-untyped-call]
                    rows_there = rows.to(device)
                    loss = loss_of(series[rows_there], target[rows_there])
                    adam.zero_grad(set_to_none=True)
                    loss.backward()
                    adam.step()
                    total += loss.detach() * len(rows)
                curve.append(total / len(y))
                if model.patience is None:
                    continue
                with torch.no_grad():
                    now = float(curve[-1] if held_out_tensors is None else loss_of(*held_out_tensors))
                if now < least - _LEAST_GAIN:  # the weights of the least loss: losses leap
                    least = now
                    best = epoch
                    weights = _weights_by_name(network, readout)
                elif held_out_tensors is not None and epoch - best >= model.patience:
                    break
            if model.patience is None:
                weights = _weights_by_name(network, readout)
            losses = torch.stack(curve).double().cpu().numpy()
    finally:
        torch.set_num_threads(threads)
    return _Trained(weights, losses, best)


def _device(name: str) -> str:
    """Return where to train."""
    import torch

    has_gpu = torch.cuda.is_available()
    if name == "cuda" and not has_gpu:
        raise UserError("PyTorch finds no GPU", hint="use device cpu or auto")
    return "cuda" if has_gpu and name != "cpu" else "cpu"


def _weights_by_name(network: Any, readout: Any) -> Weights:
    """Return the weights of both PyTorch modules by name."""
    modules = {"lstm": network.state_dict(), "readout": readout.state_dict()}
    return {
        f"{name}.{k}": v.cpu().numpy().copy() for name, state in modules.items() for k, v in state.items()
    }
