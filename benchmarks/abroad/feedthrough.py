"""What direct feedthrough would give subspace models on the sets of ``foreign_sets.py``.

    python benchmarks/abroad/feedthrough.py FOLDER [--sets luca,house]

Prints by set, without and with D, and with inputs that were applied up to their row: the error over the folds
that choose a structure, that structure, and its mean RMSE on the other half.  A model y = C x + D w is one
without D of the inputs one row earlier, with these inputs as states more, so nothing else need change.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from foreign_sets import ForeignSet, load, present
from score import mean_rmse, run_over

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.blackbox.fit import _plant, _warmup_rows
from thermogrip.sysid.blackbox.order_selection import (
    Structure,
    as_state_space,
    choose,
    default_terms,
    drives,
    with_spread,
)
from thermogrip.sysid.blackbox.subspace import _unit_responses, subspace_family
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.log_grid import Grid, make_grid


def with_feedthrough(grid: Grid, *, only: Structure | None = None) -> Mapping[Structure, StateSpaceModel]:
    """Return the subspace models of a grid whose inputs end at their row, with D fitted beside B."""
    late = [np.vstack([s.u[:1], s.u[:-1]]) for s in grid.segments]
    later = [np.vstack([s.d[:1], s.d[:-1]]) for s in grid.segments]
    usual = grid.having([replace(s, u=u, d=d) for s, u, d in zip(grid.segments, late, later)])
    plain = only and Structure(only.label.removesuffix(", D"), only.size - _numbers(grid))
    found = subspace_family(usual, terms=[()], only=plain)
    return {
        Structure(f"{structure.label}, D", structure.size + _numbers(grid)): _fed(grid, usual, model)
        for structure, model in found.items()
    }


def _numbers(grid: Grid) -> int:
    return len(grid.outputs) * (len(grid.inputs) + len(grid.disturbances))


def _fed(grid: Grid, usual: Grid, base: StateSpaceModel) -> StateSpaceModel:
    """Return the model of the same A and C with B, D, constant and starts of the least free-run error."""
    A, C, n, n_y = base.A, base.C, base.n_x, len(grid.outputs)
    w = drives(usual, ())
    centre, n_w = np.concatenate(w).mean(axis=0), w[0].shape[1]
    scale = np.maximum(grid.output_spread(), 1e-9)
    y0 = np.nanmean(np.concatenate([s.y for s in grid.segments]), axis=0)
    rows, right = [], []
    shared, many = n * (n_w + 1), len(grid.segments)
    for at, (segment, drive) in enumerate(zip(grid.segments, w)):
        columns = _unit_responses(drive - centre, A, C)
        direct = np.einsum("km,ab->makb", drive - centre, np.eye(n_y)).reshape(-1, len(drive), n_y)
        starts = np.zeros((n * many, *segment.y.shape))
        starts[at * n : (at + 1) * n] = columns[shared:]
        known = np.isfinite(segment.y)
        rows.append((np.concatenate([columns[:shared], direct, starts]) / scale)[:, known])
        right.append(((segment.y - y0) / scale)[known])
    X = np.hstack(rows).T
    size = np.linalg.norm(X, axis=0)
    size[size < 1e-9 * size.max()] = np.inf
    solved = np.linalg.lstsq(X / size, np.concatenate(right), rcond=1e-9)[0] / size
    W = solved[:shared].reshape(n_w + 1, n).T
    D = solved[shared : shared + n_w * n_y].reshape(n_w, n_y).T
    whole = np.block([[A, W[:, :-1]], [np.zeros((n_w, n + n_w))]])
    push = np.vstack([np.zeros((n, n_w)), np.eye(n_w)])
    constant = np.concatenate([W[:, -1] - W[:, :-1] @ centre, np.zeros(n_w)])
    model = as_state_space(
        grid, whole, push, np.hstack([C, D]), constant, terms=(), origin="subspace", y0=y0 - D @ centre
    )
    first = solved[shared + n_w * n_y :].reshape(many, n)
    return with_spread(model, grid, [np.append(x, drive[0]) for x, drive in zip(first, w)])


def score_set(some: ForeignSet) -> None:
    usual = make_grid([some.train])
    moved = usual.of([some.train], ends=True)
    for what, grid, family in (
        ("without D", usual, lambda g, only=None: subspace_family(g, terms=default_terms(g)[:1], only=only)),
        ("with D", moved, with_feedthrough),
        ("row's own input", moved, lambda g, only=None: subspace_family(g, terms=[()], only=only)),
    ):
        try:
            choice = choose(grid, family, warmup=_warmup_rows(grid, None))
            error = mean_rmse(run_over(_plant(grid, choice, [some.train]), some))
            line = f"folds {choice.error:.4f}, other half {error:.3f}  {choice.structure.label}"
        except UserError as refused:
            line = str(refused)
        print(f"{some.name:10s} {what:16s} {line}", flush=True)


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("folder", type=Path)
    words.add_argument("--sets", help="separated by commas; where absent, all whose files are there")
    given = words.parse_args()
    for name in given.sets.split(",") if given.sets else present(given.folder):
        score_set(load(given.folder, name))


if __name__ == "__main__":
    main()
