r"""Does the rig do what its identified model says?  Heating and cooling alike, with a sign.

A filter follows the rig: state x, a bias w on each drive (a fraction of its range; a driver is never quite
what its command says) and a bias b on each output but the reference (thermocouples are plugged anew),

    x+ = f(x, u + w, d),    w+ = w + noise,    b+ = b + noise,    y = h(x) + y0 + b + noise,

an extended Kalman filter with the model's own Jacobian by differences.  Three questions are put to it.

*One step.*  Is this reading where the last ones say it must be?  An innovation beyond ``jump_k`` of its own
standard deviations and ``jump_floor`` kelvin is not a temperature of this rig.  It is not believed.

*A window.*  The state of H seconds ago is carried on under the drives that were applied since, without
looking at a reading, and the last ``smooth`` seconds of readings are compared with where it ends.  The
residual r may be

    |r| <= floor(H) + share * swing,

swing the largest change that either path makes in the window: a model is wrong by a share of what it
predicts, and by a floor when it predicts nothing.  This is the "not heating at the expected rate" of
printers, with a sign, for cooling too, and with the expected number at hand.

*A bias.*  A sensor that drifts slowly, or a driver that weakens, is followed by b and w.  Beyond
``bias_limit`` it is no plugging anew any more.

Where a window objects, :meth:`ModelWatch.explain` runs it again under what may have gone wrong (the pump
stands still, the driver gives nothing, gives everything, is wired the wrong way round, one sensor alone lies)
and names what fits the readings best, and the next best where the readings cannot tell them apart.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thermogrip.sysid.plant import Plant

__all__ = ["ModelWatch", "Surprise", "WatchSettings"]

Array = NDArray[np.float64]

# what explains a window as well may be less likely: nobody rewires a rig that runs
_RARE = (("stuck at full", 1.2), ("wrong way", 2.0))
_ONSETS = (0.0, 0.25, 0.5, 0.75, 0.85, 0.9, 0.95)  # of a window, where something may have gone wrong
_UNIT_RANGES = {"1": (-1.0, 1.0), "percent": (0.0, 100.0), "0_255": (0.0, 255.0)}


@dataclass(frozen=True)
class WatchSettings:
    """How far the rig may be from its model; measured in docs/reference/faults.md.

    Attributes
    ----------
    windows : tuple of float
        Lengths H [s], rising.
    floors : tuple of float
        Allowed residual of each where the model predicts no change [K].
    share : float
        Allowed part of the change in the window.
    switching : float
        Allowed besides where the pump was switched in the window [K].
    smooth : float
        Readings of so long are averaged [s].
    jump_k, jump_floor : float
        One-step innovation that is not believed: standard deviations, and kelvin.
    bias_limit : float
        Of an output bias [K].
    drive_limit : float
        Of a drive bias, as a fraction of its range's half.
    state, drive, output, reading : float
        What the filter believes: heat in the states [K/sqrt(s)], wander of a drive bias [1/sqrt(s)] and of an
        output bias [K/sqrt(s)], noise of a reading [K].
    warm_up : float
        Where it starts away from rest nothing is known of what cannot be read (a hot heatsink), and for so
        long nothing is compared [s].
    """

    windows: tuple[float, ...] = (10.0, 30.0, 90.0)
    floors: tuple[float, ...] = (0.55, 0.35, 0.45)
    share: float = 0.25
    switching: float = 0.5
    smooth: float = 3.0
    jump_k: float = 8.0
    jump_floor: float = 3.0
    bias_limit: float = 2.0
    drive_limit: float = 0.25
    state: float = 0.01
    drive: float = 0.002
    output: float = 0.002
    reading: float = 0.08
    warm_up: float = 60.0


@dataclass(frozen=True)
class Surprise:
    """What the rig does against its model.

    Attributes
    ----------
    kind : str
        ``window`` or ``bias``.
    subject : str
        Output or drive.
    window : float
        Seconds that were compared; 0 for a bias.
    expected, measured : float
        Change over the window [K], or the bias and 0.
    allowed : float
        What the difference may be.
    """

    kind: str
    subject: str
    window: float
    expected: float
    measured: float
    allowed: float

    @property
    def excess(self) -> float:
        """How many times what is allowed."""
        return abs(self.measured - self.expected) / self.allowed


@dataclass
class _Moment:
    """The estimate at a tick, and the reading that came with it."""

    time: float
    step: int
    x: Array
    w: Array
    b: Array
    y: Array  # NaN where it is not compared


@dataclass
class _Grid:
    """Inputs as native steps: what was applied is averaged over each, as the twin and the fits do."""

    dt: float
    start: float
    time: float
    done: int = 0
    total: Array = field(default_factory=lambda: np.zeros(0))
    passed: float = 0.0
    first: int = 0
    u: deque[Array] = field(default_factory=deque)
    d: deque[Array] = field(default_factory=deque)

    def add(self, until: float, u: Array, d: Array, keep: int) -> int:
        """Hold u and d until a time; return how many steps that completed."""
        before = self.done
        while (grid := self.start + (self.done + 1) * self.dt) <= until + 1e-9:
            self._accumulate(max(grid - self.time, 0.0), u)
            self.u.append(self.total / self.passed if self.passed > 0 else u.copy())
            self.d.append(d.copy())
            self.total, self.passed, self.time = np.zeros_like(u), 0.0, grid
            self.done += 1
        self._accumulate(max(until - self.time, 0.0), u)
        self.time = max(until, self.time)
        while len(self.u) > keep:
            self.u.popleft()
            self.d.popleft()
            self.first += 1
        return self.done - before

    def rows(self, since: int) -> tuple[Array, Array]:
        """Return inputs and disturbances of the steps from this one on."""
        at = range(since - self.first, len(self.u))
        return np.array([self.u[k] for k in at]), np.array([self.d[k] for k in at])

    def _accumulate(self, seconds: float, u: Array) -> None:
        if self.total.size == 0:
            self.total = np.zeros_like(u)
        self.total = self.total + seconds * u
        self.passed += seconds


class ModelWatch:
    """Follow a rig with its plant; pure: times are passed in.

    Parameters
    ----------
    plant : Plant
    settings : WatchSettings, optional

    Examples
    --------
    A heater that is asked for full power and gives none (``compared_from`` is when windows may begin [s]):

    >>> from thermogrip.sysid.statespace import StateSpaceModel
    >>> block = StateSpaceModel(("q",), (), ("t",), A=[[0.99]], B=[[0.5]], C=[[1.0]], dt=1.0, y0=[25.0])
    >>> watch = ModelWatch(Plant(block, {}, dt=1.0, units={"q": "1"}))
    >>> watch.reset(0.0, {"t": 25.0})
    >>> for k in range(1, 20):
    ...     said = watch.follow(float(k), {"q": 1.0}, 1, {"t": 25.0})
    ...     if said:
    ...         print(k, said[0].subject, round(said[0].expected, 1), said[0].measured)
    ...         print(watch.explain(said[0]))
    ...         break
    10 t 4.3 0.0
    the driver gives nothing
    """

    def __init__(self, plant: Plant, settings: WatchSettings | None = None) -> None:
        self.plant = plant
        self.settings = WatchSettings() if settings is None else settings
        model = plant.model
        self.drives = tuple(name for name in plant.inputs if name != "pump")
        self._drive_at = np.array([plant.inputs.index(name) for name in self.drives], dtype=int)
        self._ranges = np.array([self._range(name) for name in self.drives]).reshape(-1, 2)
        self._half = 0.5 * (self._ranges[:, 1] - self._ranges[:, 0])
        reference = plant.reference or plant.outputs[0]
        self._reference = plant.outputs.index(reference)
        self._biased = np.array([k for k, name in enumerate(plant.outputs) if name != reference], dtype=int)
        self._p = plant.p
        self._y0 = np.array([plant.offsets.get(name, 0.0) for name in plant.outputs])
        s = self.settings
        unit = np.sqrt(np.maximum(np.diag(np.atleast_2d(model.spread)), 1e-12))
        self._unit = unit / max(float(unit.max()), 1e-12)
        n_v, n_b = len(self.drives), len(self._biased)
        walk = [np.full(n_v, s.drive), np.full(n_b, s.output)]
        self._q = np.concatenate([s.state * np.maximum(self._unit, 0.1), *walk]) ** 2
        self._p0 = (
            np.concatenate([0.5 * np.maximum(self._unit, 0.1), np.full(n_v, 0.03), np.full(n_b, 0.3)]) ** 2
        )
        self._R = np.array([max(plant.noise.get(n, s.reading), s.reading) for n in plant.outputs]) ** 2
        self._keep = int(np.ceil(max(s.windows) / plant.dt)) + 8

    def _range(self, name: str) -> tuple[float, float]:
        # not what the logs covered: a drive beyond it is still a drive
        unit = self.plant.units.get(name, "1")
        return _UNIT_RANGES.get(unit) or self.plant.valid.get(name) or (-1.0, 1.0)

    def reset(self, time: float, values: Mapping[str, float]) -> None:
        """Start at rest at these readings."""
        plant = self.plant
        y = self._outputs(values)
        usual = float(np.nanmean(y)) if np.isfinite(y).any() else 25.0
        self._d = np.array([values.get(n, usual) for n in plant.disturbances], dtype=float)
        self._d = np.where(np.isfinite(self._d), self._d, usual)
        rest = np.where(np.isfinite(y), y - self._y0, usual)
        if not self._at_rest(y):  # outputs that disagree are at no rest: the reference says how warm it is
            rest[:] = rest[self._reference]
        u = np.array([1.0 if n in plant.model.switches else 0.0 for n in plant.inputs])
        self._x = np.asarray(plant.model.rest(rest, u, self._d, self._p), dtype=float)
        self._w, self._b = np.zeros(len(self.drives)), np.zeros(len(plant.outputs))
        self._P = np.diag(self._p0)
        self.compared_from = time
        if not self._at_rest(y):
            self.compared_from += self.settings.warm_up
            n = self._x.size
            self._P[np.arange(n), np.arange(n)] *= 100.0
        self._grid = _Grid(plant.dt, time, time)
        self._moments: deque[_Moment] = deque()
        self._blind: frozenset[str] = frozenset()
        self._since: dict[str, float] = {}
        self._compared = 0
        self._push(time, y)

    def follow(
        self,
        time: float,
        drive: Mapping[str, float],
        pump: int,
        values: Mapping[str, float],
        blind: frozenset[str] = frozenset(),
    ) -> list[Surprise]:
        """Take what was applied since the last call and what is read now; return what does not fit.

        Parameters
        ----------
        time : float
            Of the reading [s].
        drive, pump
            What was applied since the call before.
        values : mapping of str to float
            Readings that are believed; NaN or absent where not.
        blind : frozenset of str
            Outputs that the plant does not describe now (a skin that touches an object).
        """
        self.predict(time, drive, pump, values)
        return self.update(time, values, blind)

    def predict(
        self, time: float, drive: Mapping[str, float], pump: int, values: Mapping[str, float]
    ) -> None:
        """Carry the estimate on to a time under what was applied since the last call."""
        plant = self.plant
        d = np.array([values.get(n, np.nan) for n in plant.disturbances], dtype=float)
        self._d = np.where(np.isfinite(d), d, self._d)
        u = np.array([float(pump) if n == "pump" else float(drive[n]) for n in plant.inputs])
        steps = self._grid.add(time, u, self._d, self._keep)
        if steps:
            self._carry(*self._grid.rows(self._grid.done - steps))
        self._u_now, self._time = u, time
        self._expected = self._now(time)

    def expected(self) -> dict[str, float]:
        """Return the readings that are expected now, by output."""
        return dict(zip(self.plant.outputs, self._expected.tolist()))

    def spread(self) -> dict[str, float]:
        """Return the standard deviations of the innovations now, by output [K]."""
        H = self._H(np.arange(len(self.plant.outputs)))
        S = H @ self._P @ H.T + np.diag(self._R)
        return dict(zip(self.plant.outputs, np.sqrt(np.diag(S)).tolist()))

    def is_jump(self, name: str, value: float) -> bool:
        """Say whether a reading is not one of this rig, given all before it."""
        if self._time < self.compared_from:
            return False
        if (
            name not in self.plant.outputs
            or name in self._blind
            or self._since.get(name, -np.inf) > self._time
        ):
            return False
        off = abs(value - self.expected()[name])
        return bool(off > max(self.settings.jump_floor, self.settings.jump_k * self.spread()[name]))

    def past_optimum(self, seconds: float = 120.0) -> str:
        """Return the drive with which more cooling would cool less, "" where there is none.

        A Peltier element pumps heat in proportion to its current and makes heat with its square.  Beyond the
        optimum a controller that wants it colder drives harder and gets it warmer: a runaway with the wrong
        sign in it.  Asked of the model: from now on, does a tenth less drive end colder?
        """
        n = max(1, round(seconds / self.plant.dt))
        for j, at in enumerate(self._drive_at):
            now = float(self._u_now[at])
            if now >= -0.3 * self._half[j] or self._ranges[j, 0] >= 0:
                continue
            u = np.repeat(self._with_bias(self._u_now)[None, None], 2, axis=0).repeat(n, axis=1)
            u[1, :, at] += 0.1 * self._half[j]
            d = np.repeat(np.repeat(self._d[None, None], 2, axis=0), n, axis=1)
            end = self._run(np.repeat(self._x[None], 2, axis=0), u, d)[:, -1]
            if np.isfinite(end).all() and float((end[1] - end[0]).min()) < -0.02:
                return self.drives[j]
        return ""

    def update(
        self, time: float, values: Mapping[str, float], blind: frozenset[str] = frozenset()
    ) -> list[Surprise]:
        """Correct the estimate with the readings and return what does not fit."""
        self._note_blind(time, blind)
        y = self._outputs(values)
        y[[name in blind for name in self.plant.outputs]] = np.nan
        seen = np.flatnonzero(np.isfinite(y))
        if seen.size:
            H = self._H(seen)
            PH = self._P @ H.T
            gain = np.linalg.solve(H @ PH + np.diag(self._R[seen]), PH.T).T
            change = gain @ (y - self._expected)[seen]
            n, m = self._x.size, self._w.size
            self._x = self._x + change[:n]
            self._w = np.clip(self._w + change[n : n + m], -0.5, 0.5)
            self._b[self._biased] += change[n + m :]
            left = np.eye(self._P.shape[0]) - gain @ H
            self._P = left @ self._P @ left.T + (gain * self._R[seen]) @ gain.T
        self._push(time, y)
        if self._grid.done == self._compared:
            return []
        self._compared = self._grid.done
        return self._windows(time) + self._biases(time)

    def explain(self, surprise: Surprise) -> str:
        """Return what fits the readings of the window best, in words; "" where nothing fits better."""
        if surprise.kind != "window":
            return ""
        begin = self._begin(self._moments[-1].time - surprise.window)
        if begin is None:
            return ""
        labels, u, x0 = self._hypotheses(begin)
        d = np.repeat(self._grid.rows(begin.step)[1][None], len(labels), axis=0)
        y = self._run(np.repeat(x0[None], len(labels), axis=0), u, d) + self._y0 + begin.b
        errors = self._errors(begin, y)
        cost = np.nansum(errors**2, axis=(1, 2))
        best: dict[str, float] = {}
        for label, c in zip(labels, cost):
            rarity = next((r for words, r in _RARE if words in label), 1.0)
            best[label] = min(rarity * float(c), best.get(label, np.inf))
        own = np.nansum(errors[0] ** 2, axis=0)
        best |= self._sensor_costs(begin, y[0], own)
        ranked = sorted((c, label) for label, c in best.items() if label)
        if not ranked or ranked[0][0] >= 0.35 * float(cost[0]):
            return ""
        near = [label for k, (c, label) in enumerate(ranked[:2]) if k == 0 or c < 2.5 * ranked[0][0]]
        return ", or ".join(near)

    def _sensor_costs(self, begin: _Moment, path: Array, own: Array) -> dict[str, float]:
        """Return what is left (sum of squares) where one sensor alone lies, or is late."""
        found = {}
        for k, name in enumerate(self.plant.outputs):
            others = float(own.sum() - own[k])
            if len(own) > 1:
                found[f"{name} alone is wrong"] = others + 0.15 * float(own[k])
            for late in (3.0, 5.0, 8.0):
                shift = min(round(late / self.plant.dt), len(path) - 1)
                slow = np.concatenate([np.full(shift, path[0, k]), path[: len(path) - shift, k]])
                error = self._errors(begin, np.repeat(slow[:, None], len(own), axis=1)[None])[0, :, k]
                label = f"{name} is late"
                found[label] = min(found.get(label, np.inf), others + 1.2 * float(np.nansum(error**2)))
        return found

    # ---- the filter ----

    def _at_rest(self, y: Array) -> bool:
        """Say whether all readings agree, and with the room: then the rig has not run for long.

        A tank that is a little warmer than the skin is not at rest: what stands in the tubes is not known.
        """
        rooms = [d for n, d in zip(self.plant.disturbances, self._d) if "ambient" in n]
        if not np.isfinite(y).any():
            return False
        level = (y - self._y0)[np.isfinite(y)]
        near = not rooms or abs(float(level.mean()) - rooms[0]) < 2.0
        return bool(near and np.ptp(level) < 0.7)

    def _outputs(self, values: Mapping[str, float]) -> Array:
        return np.array([values.get(name, np.nan) for name in self.plant.outputs], dtype=float)

    def _run(self, x: Array, u: Array, d: Array) -> Array:
        return np.asarray(self.plant.model.rollout(x, u, d, self._p[None], self.plant.dt)[0])

    def _with_bias(self, u: Array) -> Array:
        out = u.copy()
        out[..., self._drive_at] = np.clip(
            out[..., self._drive_at] + self._w * self._half,
            self._ranges[:, 0] - 0.5 * self._half,
            self._ranges[:, 1] + 0.5 * self._half,
        )
        return out

    def _carry(self, u: Array, d: Array) -> None:
        """Take the estimate over whole native steps: u (N, n_u), d (N, n_d)."""
        n, m = self._x.size, self._w.size
        tiny = 1e-4 * np.maximum(1.0, np.abs(self._x))
        x = np.repeat(self._x[None], 1 + n + m, axis=0)
        x[np.arange(1, n + 1), np.arange(n)] += tiny
        many = np.repeat(self._with_bias(u)[None], 1 + n + m, axis=0)
        for j, at in enumerate(self._drive_at):
            many[1 + n + j, :, at] += 1e-3 * self._half[j]
        rows = np.repeat(d[None], 1 + n + m, axis=0)
        _, after = self.plant.model.rollout(x, many, rows, self._p[None], self.plant.dt)
        if not np.isfinite(after).all():
            return  # a model that runs away says nothing; the readings go on being compared by the limits
        size = self._P.shape[0]
        F = np.eye(size)
        F[:n, :n] = ((after[1 : n + 1] - after[0]) / tiny[:, None]).T
        F[:n, n : n + m] = ((after[n + 1 :] - after[0]) / 1e-3).T
        self._x = after[0]
        self._P = F @ self._P @ F.T
        self._P[np.diag_indices(size)] += self._q * len(u) * self.plant.dt

    def _now(self, time: float) -> Array:
        """Return the readings expected at a time that may lie between two native steps."""
        y = np.array(self.plant.model.output(self._x.tolist(), self._p.tolist()), dtype=float)
        part = (time - self._grid.start) / self.plant.dt - self._grid.done
        if part > 1e-6:
            u = self._with_bias(self._u_now)[None, None]
            y = y + part * (self._run(self._x[None], u, self._d[None, None])[0, -1] - y)
        return np.asarray(y + self._y0 + self._b)

    def _H(self, seen: NDArray[np.intp]) -> Array:
        """Return how readings (n_seen,) depend on state, drive biases and output biases."""
        n, m, n_y = self._x.size, self._w.size, len(self.plant.outputs)
        moved = np.repeat(self._x[:, None], n + 1, axis=1)
        moved[np.arange(n), np.arange(1, n + 1)] += 1e-3
        y = self.plant.model.output(list(moved), self._p.tolist())
        rows = np.array([np.broadcast_to(row, n + 1) for row in y], dtype=float)
        C = (rows[:, 1:] - rows[:, :1]) / 1e-3
        return np.hstack([C, np.zeros((n_y, m)), np.eye(n_y)[:, self._biased]])[seen]

    def _note_blind(self, time: float, blind: frozenset[str]) -> None:
        """Where an output is described again, its states are known less, and windows start afresh."""
        for name in self._blind - blind:
            self._since[name] = time
            n = self._x.size
            self._P[np.arange(n), np.arange(n)] += self._p0[:n]
        for name in blind:
            self._since[name] = np.inf
        self._blind = blind

    # ---- the windows ----

    def _push(self, time: float, y: Array) -> None:
        self._moments.append(
            _Moment(time, self._grid.done, self._x.copy(), self._w.copy(), self._b.copy(), y)
        )
        while time - self._moments[0].time > max(self.settings.windows) + 4 * self.settings.smooth + 5:
            self._moments.popleft()

    def _begin(self, time: float) -> _Moment | None:
        """Return the newest moment that is at least so old, if the inputs since are kept."""
        found = None
        for moment in self._moments:
            if moment.time > time + 1e-6:
                break
            found = moment
        return found if found is not None and found.step >= self._grid.first else None

    def _errors(self, begin: _Moment, y: Array) -> Array:
        """Return reading less path (B, n_readings, n_y) for paths y (B, N + 1, n_y) from a moment on."""
        last = y.shape[1] - 1
        later = [m for m in self._moments if m.time > begin.time and m.step - begin.step <= last]
        at = [m.step - begin.step for m in later]
        return np.asarray(np.array([m.y for m in later])[None] - y[:, at])

    def _windows(self, time: float) -> list[Surprise]:
        found = []
        for length, floor in zip(self.settings.windows, self.settings.floors):
            begin = self._begin(time - length)
            if begin is None or begin.step >= self._grid.done or begin.time < self.compared_from:
                continue
            found += self._window(time, begin, length, floor)
        return found

    def _window(self, time: float, begin: _Moment, length: float, floor: float) -> list[Surprise]:
        u, d = self._grid.rows(begin.step)
        path = self._run(begin.x[None], self._biased_as(begin, u)[None], d[None])[0] + self._y0 + begin.b
        recent = [m for m in self._moments if m.time > time - self.settings.smooth and m.time > begin.time]
        if not recent:
            return []
        switched = [at for at, name in enumerate(self.plant.inputs) if name in self.plant.model.switches]
        if np.ptp(u[:, switched], axis=0).any():
            floor += self.settings.switching
        readings = np.array([m.y for m in recent])
        model = np.array([path[min(m.step - begin.step, len(path) - 1)] for m in recent])
        found = []
        for k, name in enumerate(self.plant.outputs):
            if self._since.get(name, -np.inf) > begin.time or not np.isfinite(readings[:, k]).all():
                continue
            measured, expected = float(readings[:, k].mean()), float(model[:, k].mean())
            start = float(path[0, k])
            swing = max(float(np.ptp(path[:, k])), abs(measured - start))
            allowed = floor + self.settings.share * swing
            if abs(measured - expected) > allowed:
                found.append(Surprise("window", name, length, expected - start, measured - start, allowed))
        return found

    def _biased_as(self, moment: _Moment, u: Array) -> Array:
        out = u.copy()
        out[:, self._drive_at] += moment.w * self._half
        return out

    def _biases(self, time: float) -> list[Surprise]:
        if time < self.compared_from + 60.0:  # not before it has seen something
            return []
        s, found = self.settings, []
        for k in self._biased:
            name = self.plant.outputs[k]
            if abs(self._b[k]) > s.bias_limit and self._since.get(name, -np.inf) < time:
                found.append(Surprise("bias", name, 0.0, 0.0, float(self._b[k]), s.bias_limit))
        for j, name in enumerate(self.drives):
            if abs(self._w[j]) > s.drive_limit:
                found.append(Surprise("bias", name, 0.0, 0.0, float(self._w[j]), s.drive_limit))
        return found

    # ---- what may have gone wrong ----

    def _hypotheses(self, begin: _Moment) -> tuple[list[str], Array, Array]:
        """Return labels ("" is: nothing), inputs (B, N, n_u) and the state to start from."""
        u, _ = self._grid.rows(begin.step)
        labels, rows = [""], [self._biased_as(begin, u)]
        for part in _ONSETS:
            since = int(part * len(u))
            for label, wrong in self._wrong(u[since:]):
                labels.append(label)
                rows.append(np.concatenate([rows[0][:since], wrong]))
        return labels, np.array(rows), begin.x

    def _wrong(self, u: Array) -> list[tuple[str, Array]]:
        out = []
        for j, at in enumerate(self._drive_at):
            low, high = self._ranges[j]
            for label, values in (
                ("the driver gives nothing", np.clip(0.0, low, high)),
                ("the driver is stuck at full drive", high),
                ("the driver is stuck at full cooling", low),
                ("the module is wired the wrong way round", np.clip(-u[:, at], low, high)),
                ("the driver gives half of what is asked", 0.5 * u[:, at]),
            ):
                if label == "the driver is stuck at full cooling" and low >= 0:
                    continue
                changed = u.copy()
                changed[:, at] = values
                if np.max(np.abs(changed[:, at] - u[:, at]), initial=0.0) > 0.1 * self._half[j]:
                    out.append((label, changed))
        if "pump" in self.plant.inputs:
            at = self.plant.inputs.index("pump")
            if u[:, at].max(initial=0.0) > 0.5:
                still = u.copy()
                still[:, at] = 0.0
                out.append(("the pump stands still", still))
        return out
