"""Would a program over several plants (multi-stage MPC) be better than that of the fitted plant alone?

    python benchmarks/control/scenarios.py [--seeds 0,1] [--draws 8]

Closed loops of ``mismatch.py``: its model, its rows of other gains and of every number off, and plants that
the posterior of the model calls as likely as any, from 25 to 38 and to 23 degC.  Beside the controller as it
is stands one whose program has five scenarios, the fitted plant and four draws: they share the first move and
each has its own plan after it (one branching, as in Lucia et al., J. Process Control 23 (2013) 1306); costs
count a fifth each, and a limit holds in all.  Both have the same filter, design and solver.  The skin is
limited to what is 0.15 degC beyond each target, as a soft limit; figures are settling over the bound of full
drive, by how much and for how long the limit is exceeded, and the CPU time of a step.
"""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
from mismatch import CASES, TARGETS, asked, close_loop, draws, model_of
from simulator import OUTPUTS, SKIN

from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import default_design
from thermogrip.mpc.optimiser.qp import CondensedQP
from thermogrip.mpc.optimiser.rti import Optimiser, Outcome
from thermogrip.mpc.plant.prediction import prediction_model

ROWS, BEYOND, SCENARIOS = ("model is right", "every number off", "gain -30 %", "gain +30 %"), 0.15, 5


def program(one, sample):
    """Return H, f, A, bounds, and the free response and its derivatives of one plant's optimiser."""
    more = 0.0 if sample.slew_s is None else sample.slew_s / one.design.dt - 1.0
    one._move = sample.caution * one.design.move
    target = np.broadcast_to(sample.target, (one.N, len(sample.target)))
    y0, G = one.model.trajectory(sample.x, sample.guess + sample.drive_bias, sample.d, one.blocks)
    G = G.reshape(one.N, one.model.n_y, -1) * np.tile(one.model.span, one.n_b)
    free = y0 + sample.bias - G @ (sample.guess / one.model.span).ravel()
    H, f = one._cost(G, free, target, sample.last)
    ends = one._range(sample.guess, sample.drive_bias, one._authority(G), sample.last, more)
    bounds = one._constraints(G, free, target, sample.side, sample.last, ends, more)
    return H, f, *bounds, free, G


class ScenarioOptimiser(Optimiser):
    """The program of a design over several plants that share the first move."""

    def __init__(self, plants, design, *, own=False):
        """With ``own`` each plant is linearised along its own plan of the sample before, not along the first
        one's."""
        models = [prediction_model(plant, design.dt) for plant in plants]
        super().__init__(models[0], design)
        if (
            design.iterations > 1
        ):  # improved until it stays, it is judged by its simulation, not by a gain at rest
            self.seen[:] = False
        self.others = [Optimiser(model, design) for model in models[1:]]
        n, n_u, count = self.n_b * self.model.n_u, self.model.n_u, len(models)
        self.places, self.own, self.kept = [], own, None
        for s in range(count):
            place = np.zeros((n, n_u + count * (n - n_u)))
            place[:n_u, :n_u] = np.eye(n_u)
            place[n_u:, n_u + s * (n - n_u) : n_u + (s + 1) * (n - n_u)] = np.eye(n - n_u)
            self.places.append(place)
        whole = self.qp
        self.joint = CondensedQP(
            soft=np.tile(whole.soft, count),
            linear=np.tile(whole.linear, count) / count,
            quadratic=np.tile(whole.quadratic, count) / count,
            time_limit_s=10.0,
        )

    def solve(self, sample):
        """Improve a plan."""
        guesses = [sample.guess] * (1 + len(self.others))
        if self.own and self.kept is not None:
            begun, plans = self.kept
            # the same sample once more, or the next one
            guesses[1:] = plans if np.array_equal(begun, sample.x) else [self._later(plan) for plan in plans]
        each = (self, *self.others)
        programs = [program(one, sample._replace(guess=guess)) for one, guess in zip(each, guesses)]
        count = len(programs)
        H = sum(E.T @ p[0] @ E for E, p in zip(self.places, programs)) / count
        f = sum(E.T @ p[1] for E, p in zip(self.places, programs)) / count
        A = np.vstack([p[2] @ E for E, p in zip(self.places, programs)])
        answer = self.joint.solve(H, f, A, *(np.concatenate([p[k] for p in programs]) for k in (3, 4)))
        authority = self._authority(programs[0][6])[0]
        plan = (self.places[0] @ answer.x * np.tile(self.model.span, self.n_b)).reshape(self.n_b, -1)
        unit = np.tile(self.model.span, self.n_b)
        plans = [(E @ answer.x * unit).reshape(self.n_b, -1) for E in self.places[1:]]
        self.kept = (sample.x, plans) if answer.solved else None
        if not answer.solved:
            return Outcome(plan, programs[0][5], answer.status, {}, answer.iterations, authority)
        y = self._simulate(sample.x, plan[None] + sample.drive_bias, sample.d)[0] + sample.bias
        return Outcome(plan, y, "solved", self._broken(y), answer.iterations, authority)

    def _later(self, plan):
        """Return a plan (n_b, n_u) a sample on."""
        plan, ends = np.repeat(plan, self.blocks, axis=0), np.cumsum([0, *self.blocks])
        plan = np.vstack([plan[1:], plan[-1:]])
        return np.array([plan[a:b].mean(axis=0) for a, b in pairwise(ends)])

    def forget(self):
        """Start afresh."""
        super().forget()
        self.joint.forget()
        self.kept = None


def figures(controller, case, seed):
    """Return settling over the bound, the most beyond the limits [degC], seconds beyond, and ms a step."""
    begin, ratios = time.process_time(), []
    run = close_loop(controller, case.truth, seed, TARGETS[:2])
    spent = time.process_time() - begin
    for (settled, _, _), bound in zip(run.segments(), run.reached()):
        ratios.append(settled / bound)
    over = np.maximum(run.skin - (TARGETS[0] + BEYOND), (TARGETS[1] - BEYOND) - run.skin)
    return (
        max(ratios, default=np.nan),
        max(0.0, over.max()),
        0.1 * (over > 0).sum(),
        1e3 * spent / len(run.moves),
    )


def main():
    """Measure and print."""
    given, model = asked(__doc__, "0,1", draws="of the posterior, beside the rows"), model_of()
    design = default_design(model)
    limit = {OUTPUTS[SKIN]: (TARGETS[1] - BEYOND, TARGETS[0] + BEYOND)}
    design = replace(design, limits=design.limits | limit)
    plants = [model, *(model.draw(k) for k in range(SCENARIOS - 1))]
    cases = [case for case in CASES if case.name in ROWS and given.only in case.name]
    groups = [(case.name, [case]) for case in cases]
    groups += [(f"{given.draws} draws", draws(given.draws))] if given.draws else []
    print(
        "plant: settling / bound, worst; most beyond [degC]; seconds beyond; ms a step; one plant, then five"
    )
    for name, group in groups:
        rows = []
        for many in (False, True):
            found = []
            for case in group:
                for seed in given.seeds.split(","):
                    controller = Controller(model, design, compiled=False)
                    if many:
                        controller.optimiser = ScenarioOptimiser(plants, design)
                    found.append(figures(controller, case, int(seed)))
            worst, mean = np.nanmax(found, axis=0), np.mean(found, axis=0)
            rows.append(f"{worst[0]:.2f}; {worst[1]:.2f}; {mean[2]:.0f}; {mean[3]:.1f}")
        print(f"{name}: {rows[0]} | {rows[1]}", flush=True)


if __name__ == "__main__":
    main()
