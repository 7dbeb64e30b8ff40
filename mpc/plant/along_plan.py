"""The outputs along plans of fixed blocks, and their derivatives, in memory that stays.

A controller asks for the same runs in each sample: one along the plan of the last one, with a direction for
each block and drive, and a few of plans that may be better.  Making arrays for a run of the compiled step and
finding their addresses can take longer than the run itself.  So they are made once, and what changes is
written into them: state, drives and disturbances.  Each controller has its own :class:`AlongPlan`, which is
no place for two at once; a model's :class:`SampleDerivatives` lets one after the other in.
"""

from __future__ import annotations

from collections.abc import Sequence
from threading import Lock
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from thermogrip.datasets.arrays import Array

if TYPE_CHECKING:
    from thermogrip.sysid.models.jit_rollout import Batch, Kernel

__all__ = ["AlongPlan", "LinearStep", "SampleDerivatives"]

_PLANS = 8  # that take no longer than one


class Sizes(Protocol):
    """What of a prediction model says how large its runs are."""

    n_x: int
    n_u: int
    n_y: int
    n_d: int
    sub: int  # steps of the model in a sample
    dt: float  # s, of a sample


class AlongPlan:
    """Runs of one model, ``kernel`` its step with the derivative in one direction, over these blocks;
    derivatives are by drives in these units (n_u,)."""

    def __init__(self, model: Sizes, kernel: Kernel, blocks: Sequence[int], unit: Array) -> None:
        from thermogrip.sysid.models.jit_rollout import Batch

        self._sizes = model.n_x, model.n_u, model.n_y, model.n_d
        self._sub, n = model.sub, len(blocks) * model.n_u
        lengths = np.asarray(blocks) * model.sub
        self._block = np.repeat(np.arange(len(blocks)), lengths)  # of each step
        rows, step = int(lengths.sum()), model.dt / model.sub
        self._by_drive = Batch(kernel, batch=n, n=rows, h=step)
        along = np.eye(n).reshape(n, len(blocks), model.n_u) * unit
        self._by_drive.u[..., model.n_u :] = along[:, self._block]
        self._plans = Batch(kernel, batch=_PLANS, n=rows, h=step)

    def trajectory(self, x: Array, plan: Array, d: Array) -> tuple[Array, Array]:
        """Return outputs (N, n_y) of a plan (n_b, n_u) from state x (n_x,) under disturbances d (n_d,), and
        their derivatives (N, n_y, n_b, n_u), which lie output by output."""
        n_y, batch = self._sizes[2], self._by_drive
        self._run(batch, slice(None), x, plan[self._block], d)
        y = batch.y[:, self._sub :: self._sub]
        G = y[:, :, n_y:].transpose(1, 2, 0).copy(order="K")
        return y[0, :, :n_y].copy(), G.reshape(*G.shape[:2], *plan.shape)

    def outputs(self, x: Array, plans: Array, d: Array) -> Array:
        """Return the outputs (B, N, n_y) of plans (B, n_b, n_u)."""
        if len(plans) > _PLANS:
            batches = [
                self.outputs(x, plans[first : first + _PLANS], d) for first in range(0, len(plans), _PLANS)
            ]
            return np.concatenate(batches)
        members, batch = slice(len(plans)), self._plans
        self._run(batch, members, x, plans[:, self._block], d)
        return batch.y[members, self._sub :: self._sub, : self._sizes[2]].copy()

    def _run(self, batch: Batch, members: slice, x: Array, u: Array, d: Array) -> None:
        n_x, n_u, _, n_d = self._sizes
        batch.x0[members, :n_x] = x
        batch.u[members, :, :n_u] = u
        if n_d:
            batch.d[0, :, :n_d] = d
        batch.run()


class LinearStep(NamedTuple):
    """One sample, linearised."""

    after: Array  # (n_x,) the state after it
    A: Array  # (n_x, n_x) its derivative by the state
    B: Array  # (n_x, n_u) by the drives
    E: Array  # (n_x, n_d) by the disturbances


class SampleDerivatives:
    """One sample's next state and its derivatives."""

    def __init__(self, model: Sizes, kernel: Kernel) -> None:
        from thermogrip.sysid.models.jit_rollout import Batch

        n_x, n_u, n_d = self._sizes = model.n_x, model.n_u, model.n_d
        along = np.eye(n_x + n_u + n_d)
        self._batch = Batch(kernel, batch=len(along), n=model.sub, h=model.dt / model.sub, same_d=False)
        self._batch.x0[:, n_x:] = along[:, :n_x]
        self._batch.u[:, :, n_u:] = along[:, None, n_x : n_x + n_u]
        self._batch.d[:, :, n_d:] = along[:, None, n_x + n_u :]
        self._lock = Lock()

    def __call__(self, x: Array, u: Array, d: Array) -> LinearStep:
        """Return the state after x (n_x,) under u (n_u,) and d (n_d,), and its derivatives by each."""
        n_x, n_u, n_d = self._sizes
        batch = self._batch
        with self._lock:
            batch.x0[:, :n_x] = x
            batch.u[:, :, :n_u] = u
            batch.d[:, :, :n_d] = d
            batch.run()
            after, by = batch.x_end[0, :n_x].copy(), batch.x_end[:, n_x:].T.copy()
        return LinearStep(after, by[:, :n_x], by[:, n_x : n_x + n_u], by[:, n_x + n_u :])
