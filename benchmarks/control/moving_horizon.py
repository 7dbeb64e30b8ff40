"""Would moving-horizon estimation be better than the controllers' Kalman filter?

    python benchmarks/control/moving_horizon.py [--seeds 0,1] [--horizon 40]

Closed loops of ``mismatch.py`` (its model, plants, first two targets) by the filter as it is; beside it, on
the same readings and drives, the estimate that minimises

    |xi_0 - filter's prediction|^2 by its P + sum |xi_j+1 - f(xi_j)|^2 by Q + sum |y_j - h(xi_j)|^2 by R

over the last N samples, with the filter's own f, h, Q and R, lags and scales among the states: Gauss-Newton
with a line search, each step by an iterated extended Kalman smoother, until it stands still.  Sensors are
whole, or the skin's is lost for 120 s from the 20th second of a target on.  Figures are errors of the skin's
reading predicted 5 and 15 s ahead under the drives that came, against what it showed without noise: rms over
all samples, in degC, of filter and horizon, and the horizon's CPU time a sample beside the filter's.
"""

from __future__ import annotations

import time

import numpy as np
from mismatch import CASES, GRID, SECONDS, TARGETS, asked, close_loop, model_of
from simulator import OUTPUTS, SKIN

from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.design.design import default_design

AHEAD, LOST = (5.0, 15.0), (20.0, 140.0)
ROWS = (
    "model is right",
    "every number off",
    "lag +8 s",
    "lag +15 s",
    "second layer inside",
    "fouling 5 % a minute",
)
_ROUNDS, _STILL, _SHORTEST = 8, 1e-3, 0.1
_TIED = 1e-8  # variance of what follows from one sample to the next without noise


class Filter:
    """The observer's equations as functions of its whole state xi = (x, w, shown, lag, scale)."""

    def __init__(self, observer):
        self.observer, n_x, n_w, n_l = observer, observer.model.n_x, observer.w.size, observer.lag.size
        self.parts = np.cumsum([n_x, n_w, n_l, n_l])

    def read(self):
        """Return the state of the observer."""
        o = self.observer
        return np.concatenate([o.x, o.w, o.shown, o.lag, o.scale])

    def put(self, xi):
        """Set it, with lags in their range."""
        o = self.observer
        o.x, o.w, o.shown, lag, o.scale = np.split(xi, self.parts)
        o.lag = np.maximum(lag, 0.0)
        o._on_sample()

    def step(self, xi, u, d):
        """Return the next state and the Jacobian."""
        self.put(xi)
        after, shown, F = self.observer._sample(u, d)
        return np.concatenate([after, self.observer.w, shown, self.observer.lag, self.observer.scale]), F

    def shows(self, xi):
        """Return the readings, their Jacobian, and the variance of each."""
        self.put(xi)
        y, H = self.observer._shows(self.observer.x, self.observer.shown)
        return y + self.observer._sensor_bias, H


class Recorded(Controller):
    """A controller that keeps what its filter saw, and predicted just before."""

    def reset(self, reading):
        super().reset(reading)
        self.kept, self.seconds = [], 0.0
        own = self.observer
        update = type(own).update

        def noting(y):
            self.kept.append((Filter(own).read(), own._P.copy(), np.array(y), own.R + own._doubt()))
            begin = time.process_time()
            found = update(own, y)
            self.seconds += time.process_time() - begin
            return found

        own.update = noting


def horizon(equations, begin, covariance, ys, Rs, us, ds, Q):
    """Return the last state of the window's least squares, searched from the filter's own path."""
    prior = begin[0]
    n, weight, root = (
        len(ys),
        1 / (Q + _TIED),
        np.linalg.inv(np.linalg.cholesky(covariance + _TIED * np.eye(len(Q)))),
    )

    def cost(path):
        total = np.square(root @ (path[0] - prior)).sum()
        for j, xi in enumerate(path):
            h = equations.shows(xi)[0]
            total += np.nansum((ys[j] - h) ** 2 / Rs[j])
            if j < n - 1:
                total += (weight * (path[j + 1] - equations.step(xi, us[j], ds[j])[0]) ** 2).sum()
        return total

    path = list(begin)
    for _ in range(_ROUNDS):
        mean, P, filtered, predicted, steps = prior, covariance, [], [], []
        for j in range(n):
            h, H = equations.shows(path[j])
            seen = np.isfinite(ys[j])
            H, S = H[seen], H[seen] @ P @ H[seen].T + np.diag(Rs[j][seen])
            gain = np.linalg.solve(S, H @ P).T
            mean = mean + gain @ ((ys[j] - h)[seen] + H @ (path[j] - mean))
            P = P - gain @ H @ P
            P = 0.5 * (P + P.T)
            filtered.append((mean, P))
            if j < n - 1:
                after, F = equations.step(path[j], us[j], ds[j])
                mean = after + F @ (mean - path[j])
                P = F @ P @ F.T + np.diag(Q)
                predicted.append((mean, P))
                steps.append(F)
        smooth = [filtered[-1][0]]
        for j in range(n - 2, -1, -1):
            (own, cov), (ahead, wide) = filtered[j], predicted[j]
            back = np.linalg.lstsq(wide, steps[j] @ cov, rcond=1e-13)[0].T
            smooth.insert(0, own + back @ (smooth[0] - ahead))
        least, share = cost(path), 1.0
        while share > _SHORTEST:
            tried = [a + share * (b - a) for a, b in zip(path, smooth)]
            if cost(tried) < least:
                break
            share /= 2
        else:
            break  # no step is better: it stands at a least
        moved = max(np.abs(a - b).max() for a, b in zip(tried, path))
        path = tried
        if moved < _STILL:
            break
    return path[-1]


def errors(controller, case, seed, n, lose):
    """Return squared errors (samples, 2, 2) of filter and horizon by time ahead, and seconds of both."""
    if lose:
        step = controller.step

        def blind(reading, target):
            at = reading["time_s"] % SECONDS
            gone = {OUTPUTS[SKIN]: float("nan")} if LOST[0] <= at < LOST[1] else {}
            return step(reading | gone, target)

        controller.step = blind
    run = close_loop(controller, case.truth, seed, TARGETS[:2])
    controller.step = type(controller).step.__get__(controller)
    observer, equations, dt = controller.observer, Filter(controller.observer), controller.dt
    kept, us = controller.kept, [np.array([c]) for c in run.current]
    d = np.array([case.truth.room])
    skin = run.skin[:: round(dt / GRID)]
    row, squares, seconds = controller.model.outputs.index(OUTPUTS[SKIN]), [], 0.0
    far = [round(s / dt) for s in AHEAD]
    for k in range(n, len(kept) - far[-1], 3):
        first = k - n + 1
        P = kept[first][1]
        window = kept[first : k + 1]
        begin = time.process_time()
        ys, Rs = [w[2] for w in window], [w[3] for w in window]
        found = horizon(equations, [w[0] for w in window], P, ys, Rs, us[first:k], [d] * (n - 1), observer.Q)
        seconds += time.process_time() - begin
        both = []
        for xi in (kept[k + 1][0], equations.step(found, us[k], d)[0]):
            own = []
            for j in range(k + 1, k + far[-1] + 1):
                if j - k in far:
                    own.append((equations.shows(xi)[0][row] - skin[j]) ** 2)
                xi = equations.step(xi, us[j], d)[0]
            both.append(own)
        squares.append(both)
    return np.array(squares), controller.seconds / len(kept), seconds / len(squares)


def main():
    """Measure and print."""
    given, model = asked(__doc__, "0,1", horizon="samples of the window [40]"), model_of()
    print(
        "plant, sensors: filter 5 s, 15 s; horizon 5 s, 15 s [degC]; ms of CPU a sample, filter and horizon"
    )
    for case in CASES:
        if case.name not in ROWS or given.only not in case.name:
            continue
        for lose in (False, True):
            found = []
            for seed in given.seeds.split(","):
                controller = Recorded(model, default_design(model), compiled=False)
                found.append(errors(controller, case, int(seed), given.horizon or 40, lose))
            rms = np.sqrt(np.concatenate([f[0] for f in found]).mean(axis=0))
            own, other = 1e3 * np.mean([f[1:] for f in found], axis=0)
            words = "skin lost 120 s" if lose else "whole"
            print(
                f"{case.name}, {words}: {rms[0].round(3)}; {rms[1].round(3)}; {own:.2f}, {other:.0f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
