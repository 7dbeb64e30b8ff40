"""CPU time of an epoch of the LSTM classifier beside a bare PyTorch loop over the same series.

    python benchmarks/classify/lstm.py [--epochs 20] [--blocks 5]

Five materials of one bundled set, a hundred copies of one grasp each, batches of 100, hidden size 32, one
thread.  Blocks of epochs alternate, and the least CPU time of a block counts, for the machine may have other
work.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch

from thermogrip.classify import make_classifier
from thermogrip.classify.estimators.base import as_array, pick
from thermogrip.classify.estimators.lstm import augment
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps

HIDDEN, BATCH, RATE = 32, 100, 1e-3


def one_of_each() -> Grasps:
    """Return one grasp of each material."""
    grasps = load_example_grasps()["exp1A_obj43_grip23"]
    labels = grasps["material"].values.astype(str)
    return pick(grasps, [int(np.argmax(labels == name)) for name in np.unique(labels)])


def bare_loop(x: torch.Tensor, y: torch.Tensor, epochs: int) -> None:
    """Train torch.nn.LSTM and a readout as one writes it first."""
    network, readout = torch.nn.LSTM(1, HIDDEN, batch_first=True), torch.nn.Linear(HIDDEN, 5)
    adam = torch.optim.Adam([*network.parameters(), *readout.parameters()], lr=RATE)
    for _ in range(epochs):
        for rows in torch.randperm(len(y)).split(BATCH):
            _, (state, _) = network(x[rows])
            loss = torch.nn.functional.cross_entropy(readout(state[0]), y[rows])
            adam.zero_grad()
            loss.backward()
            adam.step()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--epochs", type=int, default=20, help="of a block")
    parser.add_argument("--blocks", type=int, default=5)
    given = parser.parse_args()
    torch.set_num_threads(1)
    grasps = one_of_each()
    model = make_classifier("lstm", epochs=given.epochs, patience=None, device="cpu").fit(grasps)
    made = augment(as_array(grasps, times=model.times_), grasps["material"].values.astype(str))
    series = ((made.traces - model.mean_) / model.sd_)[:, :, None].astype(np.float32)
    x, y = torch.from_numpy(series), torch.from_numpy(np.unique(made.labels, return_inverse=True)[1])
    runs = {"bare loop": lambda: bare_loop(x, y, given.epochs), "classifier": lambda: model.fit(grasps)}
    least = dict.fromkeys(runs, np.inf)
    for _ in range(given.blocks):
        for name, run in runs.items():
            began = time.process_time()
            run()
            least[name] = min(least[name], (time.process_time() - began) * 1000 / given.epochs)
    for name, cpu_ms in least.items():
        print(f"{name}: {cpu_ms:.1f} ms of CPU an epoch ({cpu_ms / least['bare loop']:.2f})")


if __name__ == "__main__":
    main()
