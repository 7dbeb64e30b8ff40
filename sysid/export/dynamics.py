r"""Poles, gains, step and frequency responses of a plant about an operating point, with their uncertainty.

All follow from the matrices of :func:`thermogrip.sysid.plant.linearise.linearise_plant` at the plant's own
step h, and from the same of other plants that agree with the logs (:meth:`Plant.draw`: posterior samples, or
refits to resampled logs). Each pole z of the step has the continuous equivalent s = ln(z) / h and the time
constant -1 / Re s; poles at zero are delays. With G the quantity of the plant and G_k those of the draws, the
interval is

    G +- z_p sqrt(mean (G_k - G)^2 + (g G)^2),

g the spread of an input's gain between runs that few logs cannot show
(:data:`~thermogrip.sysid.plant.plant_data.RUN_GAIN_SD`), 0 for disturbances and phases.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.errors import UserError
from thermogrip.sysid.plant.linearise import LinearPlant, composed, linearise_plant
from thermogrip.sysid.plant.plant_data import RUN_GAIN_SD, SEVERAL

if TYPE_CHECKING:
    from thermogrip.sysid.plant.plant import Plant


@dataclass(frozen=True)
class ResponseSettings:
    """What is seen of a response."""

    delay: float = 1e-6  # modulus of a discrete pole that is part of a delay
    rounding: float = 1e-9  # of the largest entry of A
    dead: float = 1e-6  # of the largest coefficient of an impulse response: before it is dead time
    length: float = 5.0  # slowest time constants that a step response shows
    least_draws: int = 8  # of an interval
    points: int = 60  # of a response in JSON


RESPONSE = ResponseSettings()

_RISEN = 1 - np.exp(-1)


class Estimate(NamedTuple):
    """A quantity with its interval, arrays of one shape; ``nan`` where a plant has too few draws for one."""

    value: Array
    low: Array
    high: Array


class FrequencyResponse(NamedTuple):
    """Magnitude and phase (n, n_y, n_w) from inputs to outputs at frequencies."""

    omega: Array  # (n,) [rad/s]
    magnitude: Estimate
    phase: Estimate  # [deg]


@dataclass(frozen=True, eq=False)
class Dynamics:
    """How a plant responds to small changes about an operating point."""

    linear: LinearPlant  # the discrete linear plant, with its operating point and the names of its signals
    # the same of other plants that agree with the logs; empty where the plant has no uncertainty
    draws: tuple[LinearPlant, ...]
    # (n_w,), standard deviation of the gain of each input between runs [1, of the gain], 0 where the logs
    # show it
    gain_sd: Array
    units: dict[str, str]  # of inputs, disturbances and outputs
    level: ClassVar[float] = 0.9  # probability inside of the intervals

    @property
    def dt(self) -> float:
        """Step [s]."""
        assert self.linear.dt is not None
        return self.linear.dt

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Continuous equivalents [1/s] of the poles that are no delay, the slowest first."""
        A = self.linear.A  # rounding of a difference in a delay of n steps makes a pole of its n-th root
        is_seen = np.abs(A) > RESPONSE.rounding * np.abs(A).max()
        z = np.linalg.eigvals(np.where(is_seen, A, 0.0)).astype(complex)
        s = np.log(z[np.abs(z) > RESPONSE.delay]) / self.dt
        return np.asarray(s[np.argsort(-s.real, kind="stable")])

    @property
    def time_constants(self) -> Array:
        """Time constants [s] of the poles, the slowest first (``inf`` of an integrator)."""
        rate = -self.poles.real
        return np.asarray(np.divide(1.0, rate, out=np.full(rate.shape, np.inf), where=rate > 1e-12 / self.dt))

    @property
    def gain(self) -> Estimate:
        """Change of each output at rest for one unit of each input, (n_y, n_w)."""
        return self._estimate(LinearPlant.gain)

    @property
    def dead_time(self) -> Array:
        """Seconds from an input until each output begins to move, (n_y, n_w); ``nan`` where it never does."""
        linear = self.linear
        reach = self.linear.B
        impulse = []
        for _ in range(len(linear.A)):
            impulse.append(np.abs(linear.C @ reach))
            reach = linear.A @ reach
        size = np.array(impulse)
        moved = size > RESPONSE.dead * size.max(axis=(0, 2), keepdims=True)
        return np.where(moved.any(axis=0), moved.argmax(axis=0) * self.dt, np.nan)

    @property
    def rise_time(self) -> Array:
        """Seconds until a step has moved each output by 63 % of its gain, (n_y, n_w); ``nan``: never."""
        steps = self._steps(2000)
        rise = _rise(self.linear, steps, 2000)
        share = rise / np.where(rise[-1] == 0, np.nan, rise[-1])
        risen = share >= _RISEN
        return np.where(risen.any(axis=0), risen.argmax(axis=0) * steps * self.dt, np.nan)

    def step_response(self, n: int = 300) -> tuple[Array, Estimate]:
        """Return times (n + 1,) [s], to five of the slowest time constants, and the response (n + 1, n_y,
        n_w) to a unit step of each input at 0 s."""
        steps = self._steps(n)
        time = np.asarray(steps * self.dt * np.arange(n + 1), dtype=float)
        return time, self._estimate(lambda near: _rise(near, steps, n))

    @property
    def is_certain(self) -> Mask:
        """Whether each input (n_w,) acts for certain: the response to its step lies farther from 0 than that
        of any draw lies from it, rms over time and outputs in standard deviations of the draws."""
        steps = self._steps(300)
        response, *others = (_rise(near, steps, 300)[1:] for near in (self.linear, *self.draws))
        if len(others) < RESPONSE.least_draws:
            return np.ones(response.shape[-1], dtype=bool)
        # of 33 inputs without effect that were added to public logs 3 pass, and 14 where it is enough that
        # an interval leaves 0 out at any time; of the 44 others 2 fail
        off = np.array(others) - response
        sd = np.maximum(np.sqrt(np.mean(off**2, axis=0)), 1e-9 * np.abs(response) + 1e-150)
        size, *of_draws = (np.mean((each / sd) ** 2, axis=(0, 1)) for each in (response, *off))
        return np.asarray(size > np.max(of_draws, axis=0))

    def frequency_response(self, n: int = 100) -> FrequencyResponse:
        """Return frequencies (n,) [rad/s], from a tenth of the slowest pole to the step's Nyquist frequency,
        and magnitude and phase [deg] (n, n_y, n_w) from inputs to outputs."""
        omega = np.geomspace(min(0.1 / self._slowest, 0.1 / self.dt), np.pi / self.dt, n)

        def response(near: LinearPlant) -> NDArray[np.complex128]:
            turned = np.exp(1j * omega * self.dt)[:, None, None] * np.eye(len(near.A)) - near.A
            return np.asarray(near.C @ np.linalg.solve(turned, np.broadcast_to(near.B, (n, *near.B.shape))))

        def phase(near: LinearPlant) -> Array:
            whole = np.unwrap(np.angle(response(near)), axis=0)
            # from -270 to 90 deg at the first frequency: a gain below zero begins at -180 and not at +180
            return np.asarray(
                np.degrees(whole - 2 * np.pi * np.floor((whole[:1] + 1.5 * np.pi) / (2 * np.pi)))
            )

        magnitude = self._estimate(lambda near: np.abs(response(near)))
        return FrequencyResponse(omega, magnitude, self._estimate(phase, np.zeros(len(self.gain_sd))))

    def rows(self) -> list[dict[str, Any]]:
        """Return a record for each pair of an input and an output: gain with interval, times [s], unit."""
        table = np.array([*self.gain, self.dead_time, self.rise_time])
        out = []
        for (j, name), (i, output) in product(enumerate(self.linear.inputs), enumerate(self.linear.outputs)):
            value, low, high, late, risen = (v if np.isfinite(v) else None for v in table[:, i, j].tolist())
            # a change of the output for one unit of the input
            units = (self.units.get(key, "1") for key in (output, name))
            of, by = ("K" if of_signal == "degC" else of_signal for of_signal in units)
            unit = "1" if of == by else of if by == "1" else f"{of}/{by}"
            pair = {"input": name, "output": output, "gain": value, "low": low, "high": high, "unit": unit}
            out.append(pair | {"dead_time_s": late, "rise_time_s": risen})
        return out

    def to_dict(self) -> dict[str, Any]:
        """Return poles, gains, responses and the operating point as plain JSON."""
        linear = self.linear
        time, step = self.step_response(RESPONSE.points)
        omega, magnitude, phase = self.frequency_response(RESPONSE.points)
        return {
            "level": self.level,
            "draws": len(self.draws),
            "gain_sd_between_runs": float(self.gain_sd.max(initial=0.0)),
            "operating_point": dict(zip(linear.inputs, linear.w.tolist())),
            "at_rest": dict(zip(linear.outputs, linear.y.tolist())),
            "poles": [{"re": float(s.real), "im": float(s.imag)} for s in self.poles],
            "time_constants_s": [float(tau) if np.isfinite(tau) else None for tau in self.time_constants],
            "gains": self.rows(),
            "step_responses": {"time_s": time.tolist(), "pairs": self._pairs({"": step})},
            "frequency_responses": {
                "rad_per_s": omega.tolist(),
                "pairs": self._pairs({"magnitude": magnitude, "phase_deg": phase}),
            },
        }

    def _pairs(self, parts: Mapping[str, Estimate]) -> list[dict[str, Any]]:
        """Return a record for each pair of an input and an output: courses with their intervals, if any."""
        out = []
        for (j, name), (i, output) in product(enumerate(self.linear.inputs), enumerate(self.linear.outputs)):
            pair: dict[str, Any] = {"input": name, "output": output}
            for quantity, estimate in parts.items():
                for end, course in estimate._asdict().items():
                    key = quantity if quantity and end == "value" else f"{quantity}_{end}".strip("_")
                    pair[key] = course[:, i, j].tolist() if np.isfinite(course).all() else None
            out.append(pair)
        return out

    @property
    def _slowest(self) -> float:
        taus = self.time_constants
        return float(taus[np.isfinite(taus)].max(initial=self.dt))

    def _steps(self, n: int) -> int:
        """Return the number of steps of the plant between n points of a step response."""
        return max(1, round(RESPONSE.length * self._slowest / (n * self.dt)))

    def _estimate(self, of: Callable[[LinearPlant], Array], gain_sd: Array | None = None) -> Estimate:
        """Return a quantity whose last axis is that of the inputs, with its interval."""
        value = np.asarray(of(self.linear))
        if len(self.draws) < RESPONSE.least_draws:  # a plant that cannot be drawn is less certain, not more
            return Estimate(value, *np.full((2, *value.shape), np.nan))
        variance = np.mean([(of(other) - value) ** 2 for other in self.draws], axis=0)
        sd = np.sqrt(variance + ((self.gain_sd if gain_sd is None else gain_sd) * value) ** 2)
        half = NormalDist().inv_cdf(0.5 + self.level / 2) * sd
        return Estimate(value, value - half, value + half)


def _rise(near: LinearPlant, steps: int, n: int) -> Array:
    """Return the response (n + 1, n_y, n_w) to a unit step of each input, every so many steps."""
    A, B = composed(near.A, near.B, steps)
    x, out = np.zeros_like(B), [np.zeros((len(near.outputs), len(near.inputs)))]
    for _ in range(n):
        x = A @ x + B
        out.append(near.C @ x)
    return np.array(out)


def plant_dynamics(
    plant: Plant,
    *,
    inputs: Mapping[str, float] | None = None,
    disturbances: Mapping[str, float] | None = None,
    draws: int = 24,
) -> Dynamics:
    """Return poles, gains, step and frequency responses of a plant about an operating point.

    Parameters
    ----------
    plant : Plant
    inputs, disturbances : mapping of name to float, optional
        Where they are held, in their units.  By default in the middle of what the logs cover, an input that
        goes both ways in the middle of its positive half, and a switch on.
    draws : int, optional
        Other plants that agree with the logs; none of a plant without uncertainty.

    Raises
    ------
    UserError
        If a name is unknown, or the plant does not settle or runs away there.

    Examples
    --------
    A first-order lag of 20 s and gain 10, three steps of 1 s late:

    >>> from thermogrip.sysid.models.state_space import StateSpaceModel
    >>> from thermogrip.sysid.plant.plant import Plant
    >>> a = np.exp(-1 / 20)
    >>> A = [[a, 1, 0], [0, 0, 1], [0, 0, 0]]
    >>> late = StateSpaceModel(("q",), (), ("t",), A=A, B=[[0], [0], [10 * (1 - a)]], C=[[1, 0, 0]], dt=1.0)
    >>> found = plant_dynamics(Plant(late, {}, dt=1.0, units={"q": "percent", "t": "degC"}))
    >>> found.time_constants.round(6).tolist(), found.gain.value.round(6).tolist(), found.dead_time.tolist()
    ([20.0], [[10.0]], [[2.0]])
    >>> found.rows()[0]["unit"]
    'K/percent'
    """
    u, d = usual_point(plant, inputs, disturbances)

    def about(k: int) -> LinearPlant:
        return linearise_plant(plant.draw(k), inputs=u, disturbances=d, dt=plant.dt)

    linear, others = about(0), []
    for k in range(1, (draws if plant.uncertain else 0) + 1):
        try:
            others.append(about(k))
        except UserError:  # a draw that does not settle there has no gain
            continue
    few = 0 < len(plant.logs) < SEVERAL
    spread = np.array([RUN_GAIN_SD if few and name in plant.inputs else 0.0 for name in linear.inputs])
    return Dynamics(linear, tuple(others), spread, dict(plant.units))


def settled_dynamics(plant: Plant) -> Dynamics | None:
    """Return :func:`plant_dynamics` in the middle of what the logs cover, None where it does not settle."""
    try:
        return plant_dynamics(plant)
    except UserError:
        return None


def usual_point(
    plant: Plant, inputs: Mapping[str, float] | None, disturbances: Mapping[str, float] | None
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the inputs and disturbances that are named, and the others in the middle of what the logs cover;
    see :func:`plant_dynamics`."""
    u = {name: _middle(plant, name) for name in plant.inputs if name not in plant.model.switches}
    d = {name: _middle(plant, name) for name in plant.disturbances if name in plant.valid}
    return u | dict(inputs or {}), d | dict(disturbances or {})


def _middle(plant: Plant, name: str) -> float:
    low, high = plant.valid.get(name, (0.0, 0.0))
    return (max(low, 0.0) if high > 0 else low) / 2 + high / 2
