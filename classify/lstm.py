r"""The paper's network: one LSTM layer and a linear readout of its last state.

With :math:`\sigma` the logistic function and :math:`x_t` the standardised temperature,

.. math::
   i, f, o = \sigma(W x_t + U h_{t-1} + b), \quad g = \tanh(\cdot), \quad
   c_t = f c_{t-1} + i g, \quad h_t = o \tanh c_t, \quad p = \mathrm{softmax}(V h_T + v).

As in Osawa et al. (arXiv 2111.15344): batches of 100, 2000 epochs, training grasps copied with noise and
shifts of the initial temperature up to a hundred series a material.  Hidden size (32), Adam and its rate are
ours, the paper does not say.  The copies are made in ``fit``, so from training grasps only.  Each time is
standardised over the training traces: with one mean and one scale for all times, copper and iron (0.4 K apart
on a rise of 5 K) are hard to learn apart.

One matrix product a step bounds the time on a CPU (about 10 ms for 100 series of 100 steps, forwards and
backwards); stacking several networks into one batched product was measured and does not win, so folds go to
worker processes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.classify.augment import augment
from thermogrip.classify.base import Floats, JoinedClassifier, Labels, as_array, times_from
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps

if TYPE_CHECKING:
    import torch

__all__ = ["PAPER_EPOCHS", "QUICK_EPOCHS", "LstmClassifier"]

PAPER_EPOCHS = 2000
QUICK_EPOCHS = 200
_LEAST_SD = 0.05  # degC; before contact a smaller spread is noise, not to be blown up


class LstmClassifier(JoinedClassifier):
    """The paper's LSTM (``"lstm"``).

    Parameters
    ----------
    hidden : int, optional
        Size of the hidden state.
    epochs : int, optional
        Passes over the augmented training set; 2000 in the paper, 200 is quick and undertrained.
    batch : int, optional
        Series in a batch.
    learning_rate : float, optional
        Of Adam.
    series_per_class, noise_sd, shift_sd : optional
        The augmentation, see :func:`~thermogrip.classify.augment.augment`.
    start : float, optional
        First time [s] that the network sees.
    random_state : int, optional
        Seed of weights, copies and batches; the same seed gives the same network on the same machine.

    Attributes
    ----------
    classes_ : (K,) ndarray of str
    loss_curve_ : (epochs,) ndarray
        Mean training cross entropy of each epoch.
    """

    def __init__(
        self,
        hidden: int = 32,
        epochs: int = PAPER_EPOCHS,
        batch: int = 100,
        learning_rate: float = 1e-3,
        series_per_class: int = 100,
        noise_sd: float = 0.05,
        shift_sd: float = 0.3,
        start: float = 0.0,
        random_state: int = 0,
    ) -> None:
        self.hidden = hidden
        self.epochs = epochs
        self.batch = batch
        self.learning_rate = learning_rate
        self.series_per_class = series_per_class
        self.noise_sd = noise_sd
        self.shift_sd = shift_sd
        self.start = start
        self.random_state = random_state

    def _fit(self, grasps: Grasps, labels: Labels) -> None:
        if min(self.hidden, self.epochs, self.batch) < 1 or not self.learning_rate > 0:
            raise UserError(
                f"cannot train with hidden={self.hidden}, epochs={self.epochs}, batch={self.batch}, "
                f"learning_rate={self.learning_rate}",
                mend="all must be positive",
            )
        self.times_ = times_from(grasps, self.start)
        real = as_array(grasps, times=self.times_)
        self.mean_ = real.mean(axis=0)
        self.sd_ = np.maximum(real.std(axis=0), _LEAST_SD)
        made = augment(
            real,
            labels,
            series_per_class=self.series_per_class,
            noise_sd=self.noise_sd,
            shift_sd=self.shift_sd,
            seed=self.random_state,
        )
        target = np.searchsorted(self.classes_, made.labels)
        x = (made.traces - self.mean_) / self.sd_
        self.weights_, self.loss_curve_ = self._train(self._series(x), target)

    def _series(self, x: Floats) -> NDArray[np.float32]:
        """Return (n_time, n_series, n_sensor), as torch's LSTM reads it fastest."""
        sensors = x.shape[1] // self.times_.size
        cube = x.reshape(x.shape[0], sensors, self.times_.size)
        return np.ascontiguousarray(cube.transpose(2, 0, 1), dtype=np.float32)

    def _train(
        self, series: NDArray[np.float32], target: NDArray[np.int64]
    ) -> tuple[dict[str, NDArray[np.float32]], Floats]:
        import torch

        x, y = torch.from_numpy(series), torch.from_numpy(target.astype(np.int64))
        with _one_thread(), torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.random_state)
            network, readout = self._network(series.shape[2])
            steps = torch.optim.Adam([*network.parameters(), *readout.parameters()], lr=self.learning_rate)
            losses = []
            for _ in range(self.epochs):
                total = 0.0
                for rows in torch.randperm(y.numel()).split(self.batch):  # type: ignore[no-untyped-call]
                    last = network(x[:, rows])[1][0][0]
                    loss = torch.nn.functional.cross_entropy(readout(last), y[rows])
                    steps.zero_grad(set_to_none=True)
                    loss.backward()  # type: ignore[no-untyped-call]
                    steps.step()
                    total += float(loss.detach()) * rows.numel()
                losses.append(total / y.numel())
        state = {f"lstm.{k}": v for k, v in network.state_dict().items()}
        state |= {f"readout.{k}": v for k, v in readout.state_dict().items()}
        return {k: v.numpy().copy() for k, v in state.items()}, np.asarray(losses)

    def _network(self, sensors: int) -> tuple[torch.nn.LSTM, torch.nn.Linear]:
        import torch

        return torch.nn.LSTM(sensors, self.hidden), torch.nn.Linear(self.hidden, self.classes_.size)

    def _log_proba(self, grasps: Grasps) -> Floats:
        import torch

        x = (as_array(grasps, times=self.times_) - self.mean_) / self.sd_
        series = self._series(x)
        with _one_thread(), torch.random.fork_rng(devices=[]), torch.no_grad():
            network, readout = self._network(series.shape[2])
            tensors = {k: torch.from_numpy(v) for k, v in self.weights_.items()}
            network.load_state_dict(_part(tensors, "lstm."))
            readout.load_state_dict(_part(tensors, "readout."))
            logits = readout(network(torch.from_numpy(series))[1][0][0])
        return np.asarray(logits.numpy(), dtype=float)

    def get_state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return what ``fit`` learnt as named arrays: times, standardisation, weights and the loss curve."""
        arrays: dict[str, NDArray[Any]] = {
            "times": self.times_,
            "mean": self.mean_,
            "sd": self.sd_,
            "loss_curve": self.loss_curve_,
        }
        return {}, arrays | {f"weights.{k}": v for k, v in self.weights_.items()}

    def set_state(self, numbers: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
        """Take up what :meth:`get_state` returned."""
        self.times_, self.mean_, self.sd_ = arrays["times"], arrays["mean"], arrays["sd"]
        self.loss_curve_ = arrays["loss_curve"]
        self.weights_ = _part(arrays, "weights.")


def _part(named: dict[str, Any], prefix: str) -> dict[str, Any]:
    return {key[len(prefix) :]: value for key, value in named.items() if key.startswith(prefix)}


class _one_thread:
    """Torch on one thread: sums in one order, so a seed gives the same bits, and no fight among workers."""

    def __enter__(self) -> None:
        import torch

        self.before = torch.get_num_threads()
        torch.set_num_threads(1)

    def __exit__(self, *_: object) -> None:
        import torch

        torch.set_num_threads(self.before)
