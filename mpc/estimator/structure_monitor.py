r"""Whether the last minute of closed loop is the model's: a bank of one-parameter alternatives.

Over a window of 7.5 apparent delays (a minute on the gripper) the model is run on the drives that were
applied.  Its state z at the start, the biases w, the plant's free parameters theta and each drive's gain are
unknown, with the spread that an honest plant has about the filter's z_s and w_s,

    z ~ N(z_s, 1 degC in its unit),    w ~ N(w_s, P_0 + w_s^2),
    theta ~ N(theta, posterior),       gain ~ N(1, 0.2^2),

and a sensor may drift by 0.1 degC.  Two Gauss-Newton steps find the most likely of them.  Linearised there,
the readings are y ~ N(y_0, V) with V = R + J J', J in these standard deviations, and what the model lacks
adds a column a of its own, with a parameter that is nothing but for what nobody would call another structure
(``_Alternative.tolerated``).  Freed one at a time it is

    s = a' V^-1 r / a' V^-1 a  +-  (a' V^-1 a)^-1/2,      z = s / sqrt(sd^2 + tolerated^2),

whose square is twice the logarithm of the generalised likelihood ratio [1]_, and N(0, 1) where the plant is a
draw of its posterior.  The alternatives, with D the apparent delay of an output and y(t) what the model has:

* y(t - s): a delay that is longer, or shorter; y through a lag: a slower sensor;
* a share s of y through a lag of 6 D: a second mass, which takes up its heat later;
* u(t - s), a drive that acts later, or sooner; one that does nothing within s of none: a dead zone.

The plant is reported at z >= 5, or where r' V^-1 r exceeds 4 a reading, whatever the alternative: 1 is what
an honest plant has, 4 allows for readings twice as noisy as the model says.  A report stays until a window
that would have shown it as well (its sd at most twice that of then) has z < 2.  A plant without a posterior
is not watched.  A window is of calls at the sample time, with drive biases below 30 % of the range.

References
----------
.. [1] A. S. Willsky, H. L. Jones, "A generalized likelihood ratio approach to the detection and estimation of
   jumps in linear systems", IEEE Transactions on Automatic Control 21(1), 1976.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.signal import lfilter

from thermogrip.datasets.arrays import Array
from thermogrip.mpc.estimator.reading_checks import too_weak
from thermogrip.mpc.plant.prediction import PredictionModel, apparent_delays

if TYPE_CHECKING:
    from thermogrip.mpc.estimator.observer import Observer
    from thermogrip.sysid.plant.plant import Plant


@dataclass(frozen=True)
class StructureSettings:
    """What a window is, what an honest plant may have, and what is reported."""

    reported_z: float = 5.0  # of N(0, 1): 3e-7 by chance
    taken_back_z: float = 2.0
    misfit: float = 4.0  # of a reading, of which an honest plant has 1: readings twice as noisy
    window_delays: float = 7.5  # of a window, in apparent delays: a minute on the gripper
    fewest_samples: int = 20  # of a window
    first_look: float = 0.7  # of a window, from which on it is looked at
    state_sd: float = 1.0  # of each state at its start, in its unit
    gain_sd: float = 0.2  # of a drive's gain
    drift: float = 0.1  # degC of a sensor in a window
    lag_delays: float = 0.5  # of a slower sensor, tried
    second_mass_delays: float = 6.0  # lag of a second mass
    dead_zone: float = 0.02  # of a drive's range, tried
    difference: float = 0.3  # standard deviations, of a difference quotient
    steps: int = 2  # of Gauss-Newton
    diverged: float = 1e9  # degC, or standard deviations


_SET = StructureSettings()
_MEND = "identify the plant anew"


class _Alternative(NamedTuple):
    """What a model may lack: ``unit`` times its parameter is reported, as more than ``most`` beyond that."""

    words: str
    unit: float
    most: float
    tolerated: float
    two_sided: bool = False
    granted: bool = False  # whether an honest plant may have as much as is tolerated

    def reported(self, size: float) -> str:
        """Return it in words."""
        amount = abs(size) * self.unit
        about = f"about {amount:.2g}" if amount < self.most else f"more than {self.most:.2g}"
        return self.words.format(about, "slower" if size > 0 else "faster")


@dataclass(frozen=True)
class Misfit:
    """What a window says: of each alternative its parameter, the standard deviation of that, and z."""

    size: Array
    sd: Array
    z: Array
    chi: float  # r' V^-1 r, of a reading


class _Row(NamedTuple):
    x: Array
    w: Array
    shown: Array  # (n_y,) expected
    y: Array
    u: Array  # applied until here
    d: Array


class _FittedWindow(NamedTuple):
    """A run of the model over some samples: what of the unknowns (m,) is most likely, and what it shows."""

    run: Callable[..., Array]
    z: Array
    J: Array  # (m, n) of the readings, in their standard deviations
    r: Array  # (n,) readings less those of the run
    shown: Array  # (N sub + 1, n_y)
    weight: Array  # (N, n_y)
    drives: Array  # (N, n_u)


class StructureMonitor:
    """Watches one closed loop; ``said`` is what is known of it, empty while the plant may be the model, and
    ``denies`` whether the last window was the model's."""

    def __init__(self, plant: Plant, model: PredictionModel, controlled: Sequence[str]) -> None:
        self.model = model
        self.plant = plant
        self.denies = False
        self.said = ""
        self.spread = _posterior(plant)
        self._rows = [model.outputs.index(name) for name in controlled]
        if self.spread is None:
            return
        self._delays = apparent_delays(plant, model.drives, tuple(controlled), model.dt)
        self.window = max(_SET.fewest_samples, round(_SET.window_delays * max(self._delays) / model.dt))
        self.bank = [
            alternative for name, D in zip(controlled, self._delays) for alternative in _of_output(name, D)
        ]
        self._share_late = min(1.0, max(self._delays) / 8 / model.dt)
        for name in model.drives:
            words = f"{name} acts {{1}} than in the model by {{0}} s"
            self.bank.append(
                _Alternative(words, self._share_late * model.dt, max(self._delays), 0.15, True, True)
            )
        for name, span in zip(model.drives, model.span):
            words = f"{name} has a dead zone of {{0}} {plant.units.get(name, '')}".strip()
            self.bank.append(_Alternative(words, _SET.dead_zone * float(span), 0.2 * float(span), 0.25))
        self.forget()

    def forget(self) -> None:
        """Start afresh."""
        self.said = ""
        self._at = 0
        self._sd = 0.0
        self.denies = False
        self.restart()

    def restart(self) -> None:
        """Begin a new window; what is known stays."""
        if self.spread is not None:
            self._history: deque[_Row] = deque(maxlen=2 * self.window + 1)
            self._count = 0

    def note(self, observer: Observer, y: Array, u: Array, d: Array) -> None:
        """Note a sample: the filter after reading y (n_y,), and what was applied before it, drives u (n_u,)
        and measured disturbances d (n_d,)."""
        if self.spread is None:
            return
        if too_weak(observer):
            self.restart()
            return
        x, w = observer.now.copy(), observer.w.copy()
        self._history.append(_Row(x, w, observer.reading(), y, u, d))
        self._count += 1
        enough = max(_SET.fewest_samples, _SET.first_look * self.window)
        if self._count >= enough and self._count % max(1, self.window // 6) == 0:
            misfit = self.misfit(observer)
            if misfit is not None:
                self._report(misfit)

    def _report(self, found: Misfit) -> None:
        side = np.where([one.two_sided for one in self.bank], np.sign(found.size), 1.0)
        z, of_outputs = side * found.z, 3 * len(self._rows)
        # what an output shows is named before what drives do, and a drive only with what it may do
        named = [
            worst < of_outputs or abs(found.size[worst]) * one.unit < one.most
            for worst, one in enumerate(self.bank)
        ]
        named = named[:of_outputs] if np.max(z[:of_outputs]) >= _SET.reported_z else named
        worst = int(np.argmax(np.where(named, (side * found.size / found.sd)[: len(named)], -np.inf)))
        if np.max(z) >= _SET.reported_z or found.chi >= _SET.misfit:
            self.said = f"{self.bank[worst].reported(float(found.size[worst]))}: {_MEND}"
            self._at, self._sd = worst, float(found.sd[worst])
        elif self.said and found.sd[self._at] <= 2 * self._sd and z[self._at] < _SET.taken_back_z:
            self.said = ""
        self.denies = not self.said

    def misfit(self, observer: Observer) -> Misfit | None:
        """Return what the last window says; None where the model's run over it is not finite."""
        rows = list(self._history)[-(2 * self.window + 1) :]
        fit = self._fitted(observer, rows[-self.window :])
        if fit is None:
            return None
        return self._tested(fit, self._structures(fit, rows))

    def _fitted(self, observer: Observer, rows: Sequence[_Row]) -> _FittedWindow | None:
        """Return the most likely run of the model over rows; None where it is not finite."""
        model, spread = self.model, self.spread
        if spread is None or len(rows) < _SET.fewest_samples:
            return None
        first, rows = rows[0], rows[1:]
        u, d, y = (np.array([getattr(row, name) for row in rows]) for name in ("u", "d", "y"))
        n_x = model.n_x
        n_w = len(first.w)
        n_t = spread.shape[1]
        scale = np.concatenate([_SET.state_sd * observer.unit, np.sqrt(observer.P0 + first.w**2)])
        offset, disturbance = observer.offset + observer.found_offset, observer.disturbance

        def run(z: Array, drives: Array) -> Array:
            """Return the outputs (B, N sub + 1, n_y) of unknowns z (B, m) under drives (B|1, N, n_u)."""
            xw = np.concatenate([first.x, first.w]) + z[:, : n_x + n_w] * scale
            x = xw[:, :n_x]
            w = xw[:, n_x:]
            plant_numbers = z[:, n_x + n_w :]
            pushed = drives * (1 + _SET.gain_sd * plant_numbers[:, None, n_t:])
            fine = np.repeat(
                model.inputs(pushed + (w @ disturbance.on_drive.T * model.span)[:, None]), model.sub, axis=1
            )
            measured = np.repeat(d + (w @ disturbance.on_disturbance.T)[:, None], model.sub, axis=1)
            parameters = _changed_parameters(self.plant, plant_numbers[:, :n_t] @ spread.T)
            y, _ = model.model.rollout(x, fine, measured, parameters, model.dt / model.sub)
            return np.asarray(np.asarray(y) + (w @ disturbance.on_output.T)[:, None] + offset)

        m = n_x + n_w + n_t + model.n_u
        z, weight = np.zeros(m), np.where(np.isfinite(y), 1 / np.sqrt(observer.R), 0.0)
        readings, tried = np.nan_to_num(y), np.vstack([np.zeros(m), _SET.difference * np.eye(m)])
        with np.errstate(all="ignore"):  # a run that diverges is found below
            for _ in range(_SET.steps):
                shown = run(z + tried, u[None])
                at_rows = shown[:, model.sub :: model.sub]
                J = ((at_rows[1:] - at_rows[0]) * weight / _SET.difference).reshape(m, -1)
                r = ((readings - at_rows[0]) * weight).ravel() + z @ J
                if not (np.abs(J).max() < _SET.diverged and np.abs(r).max() < _SET.diverged):
                    return None
                last, z = z, np.linalg.solve(J @ J.T + np.eye(m), J @ r)
        return _FittedWindow(run, last, J, r, shown[0], weight, u)

    def _structures(self, found: _FittedWindow, rows: Sequence[_Row]) -> Array:
        """Return what each alternative of the bank adds to the readings (n, N, n_y), by its unit."""
        model, u = self.model, found.drives
        before, first = rows[: -self.window], rows[-self.window :][0]
        per_drive = np.eye(model.n_u)[:, None]
        late = u + per_drive * self._share_late * (np.vstack([first.u, u[:-1]]) - u)
        cut = np.sign(u) * np.maximum(np.abs(u) - per_drive * _SET.dead_zone * model.span, 0.0)
        drives = np.concatenate([late, cut])
        with np.errstate(all="ignore"):
            other = found.run(np.repeat(found.z[None], 2 * model.n_u, axis=0), drives)
        of_drives = (other - found.shown)[:, model.sub :: model.sub]
        return np.concatenate([self._signatures(before, first, found.shown), of_drives])

    def _signatures(self, before: Sequence[_Row], first: _Row, shown: Array) -> Array:
        """Return what each alternative of an output adds to the readings (n, N, n_y), by its unit."""
        model, sub = self.model, self.model.sub
        step, made = model.dt / sub, []
        past = np.array([row.shown for row in (*before, first)])
        lead = sub * (len(past) - 1)
        t = step * (np.arange(lead + len(shown)) - lead)
        for i, D in zip(self._rows, self._delays):
            ahead = np.interp(t[:lead], t[: lead + 1 : sub], past[:, i])
            line = np.concatenate([ahead, shown[:, i]])

            def through(lag: float, line: Array = line) -> Array:
                keep = np.exp(-step / lag)
                return np.asarray(lfilter([1 - keep], [1, -keep], line, zi=[keep * line[0]])[0])

            late, lagged = (
                np.interp(t - D / 8, t, line),
                line + (through(_SET.lag_delays * D) - line) / (8 * _SET.lag_delays),
            )
            for changed in (late, lagged, through(_SET.second_mass_delays * D)):
                column = np.zeros(((len(shown) - 1) // sub, model.n_y))
                column[:, i] = (changed - line)[lead + sub :: sub]
                made.append(column)
        return np.array(made)

    def _tested(self, found: _FittedWindow, a: Array) -> Misfit:
        """Return what a fit says of the bank's alternatives, which add a (k, N, n_y)."""
        n_y, weight = self.model.n_y, found.weight
        drift = _SET.drift * np.linspace(0.0, 1.0, len(weight))[:, None] * np.eye(n_y)[:, None]
        nuisance = np.vstack([found.J, (drift * weight).reshape(n_y, -1)])
        return _test_alternatives(self.bank, nuisance, (a * weight).reshape(len(a), -1), found.r)


def _test_alternatives(bank: Sequence[_Alternative], J: Array, a: Array, r: Array) -> Misfit:
    """Return what residuals r (n,) say of alternatives a (k, n), all in standard deviations of readings;
    J (m, n) are the unknowns'."""
    tolerated = np.array([one.tolerated for one in bank])
    granted = np.array([one.granted for one in bank])
    tolerated_rows = np.vstack([J, (tolerated[:, None] * a)[granted]])
    K = np.linalg.inv(tolerated_rows @ tolerated_rows.T + np.eye(len(tolerated_rows)))
    by_r, by_a = (v - v @ tolerated_rows.T @ K @ tolerated_rows for v in (r, a))  # times V^-1
    q: Array = np.maximum(np.sum(a * by_a, axis=1), 1e-12)
    size = a @ by_r / q
    z = size / np.sqrt(1 / q + np.where(granted, 0.0, tolerated**2))
    return Misfit(size, 1 / np.sqrt(q), z, float(r @ by_r) / max(1, int(np.count_nonzero(r))))


def _of_output(name: str, D: float) -> list[_Alternative]:
    """Return what may be off about an output of apparent delay D [s]."""
    by = f"{name} is {{1}} than the model by {{0}} s"
    return [
        _Alternative(by, D / 8, 2 * D, 0.1, two_sided=True),
        _Alternative(by, D / 8, 2 * D, 0.1),
        _Alternative(f"{name} has a second mass, for {{0}} % of its heat", 100.0, 50.0, 0.015),
    ]


def _posterior(plant: Plant) -> Array | None:
    """Return L (n_free, n) with L L' the covariance of theta; None where nothing states it."""
    if plant.covariance is not None:
        covariance = np.asarray(plant.covariance)
    elif plant.samples is not None and len(plant.samples) > 1:
        drawn = np.asarray(plant.samples, dtype=float)
        logs = plant.log_scaled
        covariance = np.cov(np.where(logs, np.log(np.where(logs, drawn, 1.0)), drawn), rowvar=False)
    else:
        return None
    size, axes = np.linalg.eigh(np.atleast_2d(covariance))
    return np.asarray(axes * np.sqrt(np.maximum(size, 0.0)))


def _changed_parameters(plant: Plant, change: Array) -> Array:
    """Return the parameters (B, n_p) of changes (B, n_free) of theta."""
    p = np.repeat(plant.p[None], len(change), axis=0)
    p[:, [plant.model.parameters.index(name) for name in plant.free]] = plant.natural(plant.theta + change)
    return p
