"""Training of the paper's network: this package beside a plain PyTorch loop with a DataLoader, in one run.

    python benchmarks/classify/lstm.py [--epochs 2000] [--measure 30] [--threads 2] [--out lstm.json]

500 series of 100 samples (five materials, a hundred copies of one grasp each), batches of 100, hidden size
32.  Both start from the same weights and see the same batches.  Time is taken in alternating blocks of
epochs, and the best block counts, for the machine may have other work; CPU time is given too.  With
``--epochs`` the two also train so long, one after the other, and their losses are compared: in double
precision (60 epochs) and in single precision.  Rounding differs between any two orders of a sum, and training
magnifies it; the yardstick ("again") is the plain loop once more, the rows of each batch in reverse order.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import numpy as np
import torch

from thermogrip.classify.estimators.lstm import augment
from thermogrip.classify.estimators.lstm_training import train_network
from thermogrip.datasets.examples import load_example_grasps

SERIES, SAMPLES, BATCH, HIDDEN, RATE = 500, 100, 100, 32, 1e-3


def data(real: type) -> tuple[np.ndarray, np.ndarray]:
    """Return 500 standardised copies of one grasp a material (n, time, 1), and their classes."""
    grasps = load_example_grasps()["exp1A_obj43_grip23"]
    labels = grasps["material"].values.astype(str)
    first = [int(np.argmax(labels == name)) for name in np.unique(labels)]
    after = np.flatnonzero(grasps["time"].values > 1e-6)[:SAMPLES]
    traces = grasps["t_surface"].interpolate_na("time").values[first][:, after]
    made = augment(traces, labels[first])
    x = (made.traces - traces.mean(axis=0)) / np.maximum(traces.std(axis=0), 0.05)
    return x[:, :, None].astype(real), np.searchsorted(np.unique(labels), made.labels)


def start(real: type, seed: int = 0) -> dict[str, np.ndarray]:
    """Return the first weights as PyTorch draws them."""
    torch.manual_seed(seed)
    network, readout = torch.nn.LSTM(1, HIDDEN), torch.nn.Linear(HIDDEN, 5)
    state = {f"lstm.{k}": v for k, v in network.state_dict().items()}
    state |= {f"readout.{k}": v for k, v in readout.state_dict().items()}
    return {k: v.numpy().astype(real) for k, v in state.items()}


def orders(epochs: int, seed: int = 0) -> list[list[np.ndarray]]:
    """Return the rows of each batch of each epoch."""
    torch.manual_seed(seed)
    return [[rows.numpy() for rows in torch.randperm(SERIES).split(BATCH)] for _ in range(epochs)]


class Plain:
    """The loop that one writes first: torch.nn.LSTM, a DataLoader, Adam."""

    def __init__(self, x: np.ndarray, y: np.ndarray, weights: dict[str, np.ndarray]):
        kind = torch.from_numpy(x[:1]).dtype
        self.network = torch.nn.LSTM(1, HIDDEN, batch_first=True, dtype=kind)
        self.readout = torch.nn.Linear(HIDDEN, 5, dtype=kind)
        named = {k: torch.from_numpy(v.copy()) for k, v in weights.items()}
        self.network.load_state_dict({k[5:]: v for k, v in named.items() if k.startswith("lstm.")})
        self.readout.load_state_dict({k[8:]: v for k, v in named.items() if k.startswith("readout.")})
        self.adam = torch.optim.Adam([*self.network.parameters(), *self.readout.parameters()], lr=RATE)
        self.set = torch.utils.data.TensorDataset(torch.from_numpy(x), torch.from_numpy(y))

    def train(self, epochs: list[list[np.ndarray]]) -> list[float]:
        """Return the mean loss of each epoch."""
        losses = []
        for batches in epochs:
            loader = torch.utils.data.DataLoader(self.set, batch_sampler=[b.tolist() for b in batches])
            total = 0.0
            for x, y in loader:
                loss = torch.nn.functional.cross_entropy(self.readout(self.network(x)[1][0][0]), y)
                self.adam.zero_grad()
                loss.backward()
                self.adam.step()
                total += float(loss.detach()) * y.numel()
            losses.append(total / SERIES)
        return losses


def times(x: np.ndarray, y: np.ndarray, epochs: int, threads: int) -> dict[str, dict[str, float]]:
    """Return the best milliseconds an epoch of alternating blocks, wall and CPU."""
    weights, plan = start(np.float32), orders(epochs)
    torch.set_num_threads(threads)
    plain = Plain(x, y, weights)
    runs = {
        "plain PyTorch": lambda: plain.train(plan),
        "ours, one thread": lambda: train_network(weights, x, y, plan, learning_rate=RATE),
        f"ours, {threads} threads": lambda: train_network(
            weights, x, y, plan, learning_rate=RATE, threads=threads
        ),
    }
    best = {name: {"wall_ms": np.inf, "cpu_ms": np.inf} for name in runs}
    for block in range(6):
        for name, run in runs.items():
            wall, cpu = time.perf_counter(), time.process_time()
            run()
            spent = {"wall_ms": time.perf_counter() - wall, "cpu_ms": time.process_time() - cpu}
            if block:  # the first compiles
                for key, seconds in spent.items():
                    best[name][key] = min(best[name][key], 1000 * seconds / epochs)
    return best


def curves(epochs: int, threads: int) -> dict[str, Any]:
    """Return how far the losses of ours and of a plain loop, and of two plain loops, are apart."""
    torch.set_num_threads(threads)
    found: dict[str, Any] = {}
    for real, length in ((np.float64, min(epochs, 60)), (np.float32, epochs)):
        x, y = data(real)
        weights, plan = start(real), orders(length)
        wall = time.perf_counter()
        _, ours = train_network(weights, x, y, plan, learning_rate=RATE, threads=threads)
        ours_s, wall = time.perf_counter() - wall, time.perf_counter()
        plain = np.array(Plain(x, y, weights).train(plan))
        plain_s = time.perf_counter() - wall
        entry = {"ours": ours.tolist(), "plain": plain.tolist(), "ours_s": ours_s, "plain_s": plain_s}
        reverse = [[rows[::-1] for rows in batches] for batches in plan]
        entry["again"] = Plain(x, y, weights).train(reverse)
        found[real.__name__] = entry
    return found


def shown(found: dict[str, Any]) -> None:
    """Print the largest relative differences of the losses up to some epochs."""
    for name, entry in found.items():
        plain = np.array(entry["plain"])
        print(f"{name}: {len(plain)} epochs, ours {entry['ours_s']:.0f} s, plain {entry['plain_s']:.0f} s")
        print(f"    loss at the end: ours {entry['ours'][-1]:.4g}, plain {plain[-1]:.4g}")
        for other in ("ours", "again"):
            if other in entry:
                gap = np.abs(np.array(entry[other]) - plain) / plain
                ends = [k for k in (10, 30, 60, 100, 300, 1000, 2000) if k <= len(plain)]
                print(f"    {other} against plain, largest relative difference until epoch: ", end="")
                print(", ".join(f"{k}: {gap[:k].max():.1e}" for k in ends))


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--epochs", type=int, default=0, help="compare the losses of so many epochs")
    parser.add_argument("--measure", type=int, default=20, help="epochs of a timed block")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", help="JSON file for the numbers")
    args = parser.parse_args()
    x, y = data(np.float32)
    result: dict[str, Any] = {"ms_an_epoch": times(x, y, args.measure, args.threads)}
    plain = result["ms_an_epoch"]["plain PyTorch"]
    for name, spent in result["ms_an_epoch"].items():
        shares = ", ".join(f"{key[:-3]} {ms:.1f} ms ({ms / plain[key]:.2f})" for key, ms in spent.items())
        print(f"{name}: {shares} an epoch")
    if args.epochs:
        result["losses"] = curves(args.epochs, args.threads)
        shown(result["losses"])
    if args.out:
        with open(args.out, "w", encoding="utf-8") as file:
            json.dump(result, file)


if __name__ == "__main__":
    main()
