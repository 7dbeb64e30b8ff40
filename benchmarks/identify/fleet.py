"""Rigs of one kind alone and pooled: errors of parameters and free runs, the population's coverage, ill rigs.

    python benchmarks/identify/fleet.py [--rigs 30] [--seeds 4] [--workers 2] [--months 6] [--power 1000]

Each fleet has TCLab boards whose parameters are drawn about a mean that is off the network's own prior: with
sd 0.15 in the logarithm, of the lags 0.3.  Each board has three logs of 5 min, or one, with random steps,
white noise of 0.2 K, an AR(1) drift of 0.2 K and 100 s, steps of 0.1 K in the reading, and one room.
Each is scored by a free run of a log of 20 min that no fit saw, noise left out.  "refit" is a fit with the
population of the other rigs as prior, which takes the fit's whole curvature; "pooled" the update of its end.
In a second fleet the first board's G_amb is twice its own (a fan that blows on it).  Simulation and fit share
the equations: the network is right, and only the number of readings is short.

``--months M`` instead has one log of 15 min of a board a month, whose parameters differ from month to month
with sd 0.05 in the logarithm; G_amb of the first board grows by 10 % a month (a fan that is turned up), in a
second fleet it does not.

``--power DRAWS`` says how often the doubled G_amb is found where fits are what they say they are: normal
about the truth with the covariance that one board's fit has.  Beside it two tests that know what ours must
find out, at the same chance of an alarm in a healthy fleet: the population, and which parameter is ill.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.signal import lfilter
from scipy.stats import norm

from thermogrip.datasets.parallel import run_parallel
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.greybox.drift import find_drift
from thermogrip.sysid.greybox.fit import fit_network
from thermogrip.sysid.greybox.population import (
    ILL,
    Told,
    against_others,
    in_prior_units,
    is_of_rig,
    pool_rigs,
    pooled_plant,
    prior_units,
    told_by,
)
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network

NAMES = ("G_amb", "G_between", "power_1", "power_2", "lag_1", "lag_2")
SPREAD = np.array([0.15, 0.15, 0.15, 0.15, 0.3, 0.3])
OFF = np.array([0.3, -0.3, 0.2, 0.2, -0.3, -0.3])  # of the mean from the network's prior, in ln


def log_of(truth, rng, minutes, *, noise=True):
    """Return a log of a board."""
    t, room = np.arange(0.0, 60 * minutes, 2.0), truth.values["t_room"]
    drives = [np.repeat(rng.uniform(0, 80, t.size // 50 + 1), 50)[: t.size] for _ in range(2)]
    signals = {f"q{k + 1}": (u, "percent", "input") for k, u in enumerate(drives)}
    signals |= {name: (np.full(t.size, room), "degC", "output") for name in ("t1", "t2")}
    run = truth.simulate(make_log(t, signals))
    for name in ("t1", "t2") if noise else ():
        push = 0.2 * np.sqrt(1 - np.exp(-2 * 2.0 / 100)) * rng.normal(size=t.size)
        drift = lfilter([1.0], [1.0, -np.exp(-2.0 / 100)], push)
        value = run[name].values + drift + 0.2 * rng.normal(size=t.size)
        run[name] = ("time", 0.1 * np.round(value / 0.1), run[name].attrs)
    return run.assign_attrs(name=f"log{rng.integers(1e9)}")


def fleet(rng, n, n_logs, *, ill=False):
    """Return the truth of each board (n, 6) as logarithms, its logs, and the one that scores it."""
    board = prior_plant(load_network("tclab"))
    prior = np.log([board.values[name] for name in NAMES])
    theta = prior + OFF + SPREAD * rng.normal(size=(n, len(NAMES)))
    if ill:
        theta[0, 0] += np.log(2.0)
    values = [dict(zip(NAMES, np.exp(row).tolist())) | {"t_room": 23.0 + rng.normal()} for row in theta]
    truths = [replace(board, values=board.values | each) for each in values]
    logs = [[log_of(truth, rng, 5) for _ in range(n_logs)] for truth in truths]
    return theta, logs, [log_of(truth, rng, 20, noise=False) for truth in truths]


def fitted(given):
    """Return the fit of one board."""
    model, logs = given
    return fit_network(model, logs)


def over_months(rng, n, months, growth):
    """Return the logs of each board, one a month; G_amb of the first grows in ln by ``growth`` a month."""
    board = prior_plant(load_network("tclab"))
    prior = np.log([board.values[name] for name in NAMES])
    logs = []
    for theta in prior + OFF + SPREAD * rng.normal(size=(n, len(NAMES))):
        own = []
        for month in range(months):
            day = theta + 0.05 * rng.normal(size=theta.size)
            day[0] += growth * month * (not logs)
            values = dict(zip(NAMES, np.exp(day).tolist())) | {"t_room": 23.0 + rng.normal()}
            own.append(log_of(replace(board, values=board.values | values), rng, 15))
        logs.append(own)
    return logs


def drifts(run, model, n, months, seeds):
    """Print how often the board that changes is found, alarms among the others, and what is found."""
    found, alarms, steady, off, scatters = 0, 0, 0, [], []
    for seed in range(seeds):
        for growth in (float(np.log(1.1)), 0.0):
            logs = over_months(np.random.default_rng([seed, months]), n, months, growth)
            population, _ = pool_rigs(
                {f"r{k}": plant for k, plant in enumerate(run([(model, own) for own in logs]))}
            )
            narrow = population.prior_of(model)
            plants = run([(narrow, [log]) for own in logs for log in own])
            fits = {f"r{k}": plants[months * k : months * (k + 1)] for k in range(n)}
            rigs, scatter = find_drift(fits, {name: [30.0 * m for m in range(months)] for name in fits})
            changing, at = int(growth > 0), [population.parameters.index(name) for name in NAMES]
            found += changing * rigs[0].drifts
            alarms += sum(rig.drifts for rig in rigs[changing:])
            steady += n - changing
            scatters.append(scatter[at])
            truth = np.zeros((n, len(NAMES)))
            truth[0, 0] = growth * (months - 1)
            off += [(rig.change[at] - true) / rig.change_sd[at] for rig, true in zip(rigs, truth)]
            if changing:
                change, sd = rigs[0].change[at[0]], rigs[0].change_sd[at[0]]
                said = f"found {change:.2f} +- {sd:.2f}, chance {rigs[0].chance:.2g}"
                print(f"seed {seed}: ln G_amb changed by {truth[0, 0]:.2f}, {said}", flush=True)
    covered = np.mean(np.abs(off) < 1.645)
    print(f"found {found}/{seeds}; alarms {alarms}/{steady}; 90 % intervals of a change cover {covered:.3f}")
    print(f"scatter from month to month, true 0.05: {np.mean(scatters, axis=0).round(3)}")


def power(model, n, draws):
    """Print how often the ill board is found where fits are normal, by ours and by tests that know more."""
    print("logs  sd of ln G_amb by a fit   found by us   knowing the population   and the parameter   alarms")
    for n_logs in (3, 1):
        rng = np.random.default_rng([7, n_logs])
        _, [logs], _ = fleet(rng, 1, n_logs)
        plant = fit_network(model, logs)
        specs = [model.specs[name] for name in plant.free]
        centre, width = prior_units(specs)
        z, S = in_prior_units([plant], centre, width)
        own = np.array([is_of_rig(spec) for spec in specs])  # a room is integrated out
        z, S, width = z[:, own], S[:, own][:, :, own], width[own]
        precision = told_by(z, S).precision[0]
        size, axes = np.linalg.eigh(precision)
        seen = size > 1e-3
        root = axes[:, seen] / np.sqrt(size[seen])
        free = [name for name, part in zip(plant.free, own) if part]
        at = [free.index(name) for name in NAMES]
        sd = np.zeros(len(free))
        sd[at] = SPREAD / width[at]
        found, alarms = np.zeros(3), 0
        for _ in range(draws):
            theta = sd * rng.normal(size=(n, sd.size))
            theta[0, at[0]] += np.log(2.0) / width[at[0]]
            seen_as = theta + rng.normal(size=(n, int(seen.sum()))) @ root.T
            told = Told(np.tile(precision, (n, 1, 1)), seen_as @ precision)
            fits = told.information @ S[0]
            chances = [against_others(told, fits[i], S[0], i)[3] for i in (0, 1)]
            off = np.abs(fits[0]) / np.sqrt(np.diagonal(S[0] @ precision @ np.diag(sd**2) @ precision @ S[0]
                                                        + S[0] @ precision @ S[0]))  # fmt: skip
            known = [2 * n * len(NAMES) * norm.sf(off[at].max()), 2 * n * norm.sf(off[at[0]])]
            found += np.array([chances[0], *known]) < ILL
            alarms += chances[1] < ILL
        by_fit = width[at[0]] * np.sqrt(S[0, at[0], at[0]])
        shares = "   ".join(f"{share:.3f}" for share in found / draws)
        print(f"{n_logs:4d}  {by_fit:.3f}   {shares}   {alarms}/{draws}", flush=True)


def errors(plants, theta, checks):
    """Return the rms error of the parameters' logarithms, and of free runs [K]."""
    found = np.log([[plant.values[name] for name in NAMES] for plant in plants])
    squares = []
    for plant, log in zip(plants, checks):
        run = replace(plant, offsets={}).simulate(log)
        squares += [float(((run[name] - log[name]) ** 2).mean()) for name in ("t1", "t2")]
    return np.sqrt(((found - theta) ** 2).mean()), np.sqrt(np.mean(squares))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rigs", type=int, default=30)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--months", type=int, default=0)
    parser.add_argument("--power", type=int, default=0, metavar="DRAWS")
    given = parser.parse_args()
    run = partial(run_parallel, fitted, workers=given.workers)
    model, n = load_network("tclab"), given.rigs
    if given.power:
        power(model, n, given.power)
        return
    if given.months:
        drifts(run, model, n, given.months, given.seeds)
        return
    print("logs  alone ln p, K   pooled ln p, K   refit ln p, K   covered  spread found / true")
    print("      alarms among healthy boards  ill found (chance of each)  seconds of fits and pooling")
    for n_logs in (3, 1):
        rows, found, alarms, covered, spreads, seconds, chances = [], 0, 0, [], [], [], []
        for seed in range(given.seeds):
            rng = np.random.default_rng([seed, n_logs])
            theta, logs, checks = fleet(rng, n, n_logs)
            begin = time.perf_counter()
            alone = run([(model, each) for each in logs])
            population, rigs = pool_rigs({f"r{k}": plant for k, plant in enumerate(alone)})
            seconds.append(time.perf_counter() - begin)
            pooled = [pooled_plant(plant, rig) for plant, rig in zip(alone, rigs)]
            refit = run([(rig.others.prior_of(model), each) for rig, each in zip(rigs, logs)])
            rows.append([errors(plants, theta, checks) for plants in (alone, pooled, refit)])
            alarms += sum(rig.ill for rig in rigs)
            at = [population.parameters.index(name) for name in NAMES]
            spreads.append(np.array(population.spread)[at] / SPREAD)
            # a rig against the interval that the others give
            inside = [
                [r.others.intervals(0.9)[p][0] < v < r.others.intervals(0.9)[p][1]]
                for r, row in zip(rigs, np.exp(theta)) for p, v in zip(NAMES, row)
            ]  # fmt: skip
            covered += inside
            _, logs, _ = fleet(rng, n, n_logs, ill=True)
            plants = run([(model, each) for each in logs])
            with_ill = pool_rigs({f"r{k}": plant for k, plant in enumerate(plants)})[1]
            found += with_ill[0].ill
            chances.append(round(with_ill[0].chance, 4))
            alarms += sum(rig.ill for rig in with_ill[1:])
        healthy = (2 * n - 1) * given.seeds
        a, b, c = np.sqrt(np.mean(np.square(rows), axis=0))
        print(
            f"{n_logs:4d}  {a[0]:6.3f} {a[1]:6.2f}   {b[0]:6.3f} {b[1]:6.2f}   {c[0]:6.3f} {c[1]:6.2f}"
            f"   {np.mean(covered):6.3f}  {np.mean(spreads, axis=0).round(2)}  {alarms}/{healthy}"
            f"  {found}/{given.seeds} {chances}  {np.mean(seconds):.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
