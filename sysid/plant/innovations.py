r"""How noisy a plant and its sensors are, by maximum likelihood on the logs of its fit.

A Kalman filter of the plant with a bias w for each graded input,

    x+ = f(x, u + w, d) + noise of sd q s_x,    w+ = w + noise of sd b s_u,    y = C x + noise of sd r,

in a second, makes innovations e of covariance S; those q and b are kept whose likelihood is greatest.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from scipy.linalg import block_diag, solve_discrete_are

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.schema import Log
from thermogrip.sysid.plant.linearise import discrete_matrices, output_matrix, states_after
from thermogrip.sysid.plant.log_grid import Stretch, cut_stretches
from thermogrip.sysid.plant.plant_data import InnovationNoise, PlantData

_MOST_STEPS = 4000  # of the logs, from their start on: a second of work, and numbers good to some percent
_SETTLES = 20  # steps, in which a start that is not quite known dies out
_STATE_RATIOS = (0.0, *np.geomspace(1e-3, 3.0, 8).tolist())  # of q to r
_INPUT_RATIOS = (0.0, *np.geomspace(1e-5, 0.1, 9).tolist())  # b, before it is scaled


def innovation_noise(plant: PlantData, logs: Sequence[Log]) -> InnovationNoise | None:
    """Return the noise of a plant, and the fastest moves of its inputs, in logs of its fit; None where no
    filter settles, or a reading's noise is not known to begin with."""
    outputs, model = plant.outputs, plant.model
    reading_sd = plant.noise | plant.scores.reading_sd
    sd = np.array([reading_sd.get(name, 0.0) for name in outputs])
    stretches, steps = [], 0
    for stretch in (stretch for log in logs for stretch in cut_stretches(plant, log)):
        if steps < _MOST_STEPS:
            stretches.append(stretch)
        steps += len(stretch.u)
    moves = np.ptp(np.concatenate([stretch.u for stretch in stretches]), axis=0) if stretches else []
    graded = [j for j, move in enumerate(moves) if move > 0 and plant.inputs[j] not in model.switches]
    if not (np.all(sd > 0) and graded):
        return None
    names = [plant.inputs[j] for j in graded]
    fastest = dict.fromkeys(names, 0.0)
    for log, name in product(logs, names):
        time, values = (np.asarray(log[key].values, dtype=float) for key in ("time", name))
        rates = np.abs(np.diff(values)) / np.diff(time)
        fastest[name] = max(fastest[name], float(rates.max(initial=0.0)))
    try:
        with np.errstate(all="ignore"):  # a filter that diverges is the least likely one
            return _most_likely(plant, stretches, sd, graded, fastest)
    except np.linalg.LinAlgError:
        return None


class _Filter:
    """A plant with a bias for each graded input, linearised once, amid the logs."""

    def __init__(self, plant: PlantData, stretches: Sequence[Stretch], graded: list[int]) -> None:
        self.plant, self.graded = plant, graded
        model, n_x, n_w = plant.model, plant.model.n_x, len(graded)
        self.offset = np.array([plant.offsets.get(name, 0.0) for name in plant.outputs])
        C, self.level = output_matrix(plant)
        spread = np.atleast_2d(model.spread)
        # s_x s_x', the covariance of the states in the data of the fit over that of the outputs
        self.state_covariance = spread / np.einsum("ij,jk,ik->i", C, spread, C).max()
        u, d, y = (np.concatenate([getattr(stretch, key) for stretch in stretches]) for key in "udy")
        # s_u
        self.input_range = np.ptp(u, axis=0)[graded]
        self.middle = np.nanmean(y, axis=0)
        u0 = u.mean(axis=0)
        d0 = d.mean(axis=0)
        x0 = np.asarray(model.rest(self.middle - self.offset, u0, d0, plant.p), dtype=float)
        A, B = discrete_matrices(plant, x0, u0, d0, graded)
        # transition and readings of states and biases
        self.F = np.block([[A, B[:, :n_w]], [np.zeros((n_w, n_x)), np.eye(n_w)]])
        self.H = np.hstack([C, np.zeros((len(C), n_w))])

    def gains(self, sd: Array, ratios: Sequence[tuple[float, float]]) -> tuple[Array, Array]:
        """Return the gains and the covariances of innovations that the filter settles at, by ratio; NaN where
        it does not."""
        dt, r = self.plant.dt, float(np.sqrt(np.mean(sd**2)))
        states, inputs = r**2 * self.state_covariance, np.diag(self.input_range**2)
        # what moves nothing by itself has a gain all the same
        trace = 1e-12 * block_diag(np.diag(np.diag(states)), inputs)
        gains, spreads = [], []
        for q, b in ratios:
            drift = dt * block_diag(q**2 * states, b**2 * inputs)
            # the gains that the filter settles at; predictions are the plant's own
            try:
                P = solve_discrete_are(self.F.T, self.H.T, drift + trace, np.diag(sd**2))
            except ValueError:  # it settles nowhere, or the eigenvalues could not be ordered
                P = np.full_like(self.F, np.nan)
            S = self.H @ P @ self.H.T + np.diag(sd**2)
            gains.append(np.linalg.solve(S, self.H @ P).T)
            spreads.append(S)
        return np.array(gains), np.array(spreads)

    def squares(self, stretches: Sequence[Stretch], gains: Array, spreads: Array) -> tuple[Array, int]:
        """Return the sum of e' S^-1 e by gain, and the number of innovations."""
        model, n_x, inverse = self.plant.model, self.plant.model.n_x, np.linalg.inv(spreads)
        squares, count = np.zeros(len(gains)), 0
        for stretch in stretches:
            steps, dt = self.plant.dt * np.arange(len(stretch.u)), self.plant.dt
            rows = np.minimum(np.searchsorted(stretch.time, steps - 1e-9 * dt), len(stretch.time) - 1)
            is_near = stretch.time[rows] - steps < 0.5 * dt
            readings = np.where(is_near[:, None], stretch.y[rows], np.nan) - self.offset
            z = np.zeros((len(gains), self.F.shape[0]))
            first = np.where(np.isfinite(readings[0]), readings[0], self.middle - self.offset)
            z[:, :n_x] = model.rest(first, stretch.u[0], stretch.d[0], self.plant.p)
            for k, y in enumerate(readings):
                if np.isfinite(y).all():
                    e = y - (z @ self.H.T + self.level)
                    if k >= _SETTLES:
                        squares += np.einsum("bi,bij,bj->b", e, inverse, e)
                        count += 1
                    z = z + np.einsum("bij,bj->bi", gains, e)
                u = np.repeat(stretch.u[k][None], len(z), axis=0)
                u[:, self.graded] += z[:, n_x:]
                d = np.repeat(stretch.d[k][None], len(z), axis=0)
                z = np.hstack([states_after(self.plant, z[:, :n_x], u, d), z[:, n_x:]])
        return squares, count


def _most_likely(
    plant: PlantData, stretches: Sequence[Stretch], sd: Array, graded: list[int], fastest: dict[str, float]
) -> InnovationNoise | None:
    filtered = _Filter(plant, stretches, graded)
    if not np.isfinite(filtered.F).all():  # the plant diverges there
        return None
    gains, spreads = filtered.gains(sd, list(product(_STATE_RATIOS, _INPUT_RATIOS)))
    squares, count = filtered.squares(stretches, gains, spreads)
    if count <= _SETTLES:
        return None
    # of q and b on a grid, beside sensors as noisy as the fit found them, the scale of all three that is best
    # for each in closed form
    scale = squares / (count * len(sd))
    # -2 log L = sum_k log det S + e_k' S^-1 e_k: K. J. Astrom, "Maximum likelihood and prediction error
    # methods", Automatica 16(5), 1980
    cost = len(sd) * np.log(scale) + np.linalg.slogdet(spreads)[1]
    if not np.isfinite(cost).any():
        return None
    best = int(np.nanargmin(np.where(np.isfinite(cost), cost, np.nan)))
    by_state, by_input = divmod(best, len(_INPUT_RATIOS))
    table = cost.reshape(len(_STATE_RATIOS), len(_INPUT_RATIOS))
    q = _parabola_minimum(_STATE_RATIOS, table[:, by_input], by_state)
    b = _parabola_minimum(_INPUT_RATIOS, table[by_state], by_input)
    times = float(np.sqrt(scale[best]))
    return InnovationNoise(
        state=times * q * float(np.sqrt(np.mean(sd**2))),
        reading=dict(zip(plant.outputs, (times * sd).tolist())),
        input=dict(zip(fastest, (times * b * filtered.input_range).tolist())),
        fastest=fastest,
    )


def _parabola_minimum(ratios: Sequence[float], cost: Array, best: int) -> float:
    """Return the ratio at the least of the parabola through the best one and its neighbours."""
    ends = cost[max(best - 1, 0) : best + 2]
    if best < 2 or len(ends) < 3 or not np.isfinite(ends).all():
        return ratios[best]
    bend = ends[0] - 2 * ends[1] + ends[2]
    share = 0.5 * (ends[0] - ends[2]) / bend if bend > 0 else 0.0
    return float(ratios[best] * (ratios[best] / ratios[best - 1]) ** share)
