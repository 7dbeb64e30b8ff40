"""The twin: an identified plant behind the rig's interface, with sensors and a hand to grasp with.

The plant is integrated with its own native step dt.  Between two steps the outputs are interpolated towards a
provisional step, so the twin can be read at any time.

A reading is  truth + offset + slow noise + white noise, rounded to the quantum.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.rig.guard.sensor_checks import room_disturbances
from thermogrip.rig.interface import Event, Reading, check_order, known_range
from thermogrip.sysid.contact.simulation import ContactModel, Touch
from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
from thermogrip.sysid.plant.plant import Plant

SLOW_S = 4.0  # memory of the slow sensor noise
RECOVERY_S = 20.0  # time constant with which a grasp is forgotten after release


@dataclass
class _Contact:
    """A closed gripper."""

    touch: Touch
    closed: float  # time [s]
    skin: float  # the skin's own temperature when it closed [degC]
    opened: float = np.inf  # time [s]
    left: float = 0.0  # addition at release [K]
    # the skin as it would be without the object, native step by native step
    times: list[float] = field(default_factory=list)
    alone: list[float] = field(default_factory=list)

    def addition(self, time: float, alone: float) -> float:
        """Return what the object adds to the skin's reading [K], which alone would be at ``alone``."""
        if time > self.opened:
            # the heat that soaks into the finger and the water, which the plant's states do not know
            return self.left * float(np.exp((self.opened - time) / RECOVERY_S))
        # heat conduction is linear: with the plant's skin y(t), the true time of contact t_c, the step
        # response F of sysid.contact.simulation and G, what the room does by the far face of the block,
        #     (T_obj - y(t_c)) F(t - t_c) + (T_room - T_obj) G(t - t_c) - int F(t - s) dy(s), s = t_c ... t;
        # the integral is Duhamel's: the object answers to the difference as it is, not as it was at contact
        since_closed = np.array([time - self.closed])
        share, room = float(self.touch.response(since_closed)[0]), float(self.touch.by_room(since_closed)[0])
        # what the skin did between closing and the touch counts from the touch on
        times, skin_alone = np.array([*self.times, time]), np.array([*self.alone, alone])
        onset = self.touch.onset
        since = np.maximum(0.5 * (times[1:] + times[:-1]), self.closed + onset)
        undone = float(self.touch.response(time - since + onset) @ np.diff(skin_alone))
        return (self.touch.t_object - self.skin) * share + room - undone

    def follow(self, time: float, alone: float) -> None:
        """Note where the skin would be without the object."""
        self.times.append(time)
        self.alone.append(alone)


class Twin:
    """A simulated rig; the same calls as hardware, its own clock.

    Parameters
    ----------
    plant : Plant
        What is simulated.
    contact : ContactModel, optional
        How grasps respond; default the example rig's gripper, whose skin reads a block as its calibration
        says, whatever the sensor's offset.
    seed : int, optional
        Of the sensor noise and of each grasp's circumstances.
    ambient : float, optional
        Room temperature [degC].
    disturbances : dict of str to float, optional
        Values of measured disturbances; by default the plant's own, of the room's temperature ``ambient``.
    t_start : float, optional
        Temperature of everything at the start [degC]; default ambient.
    noise : float, optional
        White sensor noise, standard deviation [K].
    slow_noise : float, optional
        Standard deviation of the slow sensor noise [K].
    quantum : float, optional
        Step of the sensors [K]; 0 for none.
    offsets : dict of str to float, optional
        Added to the reading of an output [K]; default the plant's own.
    limits : dict of str to (float, float), optional
        Range of an input; default -1 to 1, or what the plant's unit says (percent 0 to 100, 0_255 0 to 255).
    skin : str, optional
        The output that touches.
    pace : callable, optional
        Called with the seconds of each wait once they are simulated; the ``wait`` of a
        :class:`~thermogrip.rig.clock.Metronome` lets somebody watch.

    Attributes
    ----------
    disturbances : dict of str to float
        The plant's measured disturbances, which stay.
    history : list of dict
        One row a native step: time, inputs as integrated, true outputs, ``contact`` (0 or 1).

    Examples
    --------
    >>> from thermogrip.rig.simulation.virtual_device import example_plant
    >>> twin = Twin(example_plant(), ambient=20.0)
    >>> twin.apply({"drive": 0.5}, pump=1)
    >>> twin.wait(60.0)
    >>> twin.time, 21.0 < twin.read().values["t_tank"] < 30.0
    (60.0, True)
    """

    expires_s = 0.0  # its time stops with the program

    def __init__(
        self,
        plant: Plant,
        *,
        contact: ContactModel | None = None,
        seed: int = 0,
        ambient: float = 25.0,
        disturbances: Mapping[str, float] | None = None,
        t_start: float | None = None,
        noise: float = 0.04,
        slow_noise: float = 0.018,
        quantum: float = 1 / 16,
        offsets: Mapping[str, float] | None = None,
        limits: Mapping[str, tuple[float, float]] | None = None,
        skin: str = "t_surface",
        pace: Callable[[float], None] | None = None,
    ) -> None:
        self.plant = plant
        self.units = {name: plant.units.get(name, "1") for name in plant.inputs if name != "pump"}
        self.has_pump = "pump" in plant.inputs
        self.ambient = ambient
        self.skin = skin
        self.noise = noise
        self.slow_noise = slow_noise
        self.quantum = quantum
        self._pace = pace
        self.offsets = dict(plant.offsets if offsets is None else offsets)
        stated_limits = dict(limits or {})
        self.limits = {name: stated_limits.get(name) or _input_range(plant, name) for name in self.units}
        self._contact_model = contact  # the example rig's is read when something is grasped
        self._noise_rng, self._grasp_rng = (
            np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(2)
        )
        self._d = self._disturbance_vector(disturbances or {})
        self.disturbances = dict(zip(plant.disturbances, self._d.tolist()))
        self._drive = dict.fromkeys(self.units, 0.0)
        self._pump = 1
        self.time, self.closed = 0.0, False
        self.history: list[dict[str, float]] = []
        self._k = 0
        self._elapsed = 0.0
        self._slow_at = 0.0
        self._applied = np.zeros(len(plant.inputs))  # integral of the inputs over the step so far
        self._slow = {name: slow_noise * self._noise_rng.standard_normal() for name in plant.outputs}
        self._newest: Reading | None = None
        self._contact: _Contact | None = None
        self._alone: tuple[float, dict[str, float]] | None = None  # time, and the plant's outputs then
        level = np.full(len(plant.outputs), float(ambient if t_start is None else t_start))
        self._x = np.asarray(plant.model.rest(level, self._input_vector(), self._d, plant.p), dtype=float)
        self._y = np.array(plant.model.output(self._x.tolist(), plant.p.tolist()), dtype=float)
        self._write_history(self._input_vector())

    def read(self) -> Reading:
        """Return the sample at the present time; twice at one time gives the same sample."""
        if self._newest is None or self._newest.time_s != self.time:
            true = self.truth()
            values = {name: self._sensor(name, value) for name, value in true.items()}
            values |= {name: round(self.disturbances[name], 1) for name in room_disturbances(self.plant)}
            self._newest = Reading(self.time, values, dict(self._drive), self._pump)
        return Reading(self.time, self._newest.values, dict(self._drive), self._pump)

    def apply(self, drive: Mapping[str, float], pump: int) -> None:
        """Set drive and pump from now on; ValueError for an unknown input or a value outside its range."""
        check_order(drive, pump, self.limits)
        if self.closed and (pump or any(drive.values())):
            raise RuntimeError("the rig is closed")
        self._drive = {name: float(drive[name]) for name in self._drive}
        self._pump = int(pump)

    def wait(self, seconds: float) -> None:
        """Simulate so many seconds."""
        if not seconds >= 0:
            raise ValueError(f"cannot wait {seconds:g} s")
        # a clock that adds 0.1 s a hundred times must still meet the grid of the native steps
        end = round(self.time + seconds, 9)
        dt = self.plant.dt
        while (grid := round((self._k + 1) * dt, 9)) <= end:
            self._accumulate(grid - self.time)
            self.time = grid
            u = self._mean_input()
            self._x, self._y = self._advance(u)
            self._k += 1
            self._applied[:] = 0.0
            self._elapsed = 0.0
            if self._contact is not None and np.isinf(self._contact.opened):
                self._contact.follow(self.time, self._outputs_alone()[self.skin])
            self._write_history(u)
        self._accumulate(end - self.time)
        self.time = end
        if self._pace is not None:
            self._pace(seconds)

    def grasp(self, material: str, t_object: float) -> None:
        """Close the gripper on a block of this material, warmed to ``t_object`` [degC, nominal].

        Contact conductance, moment of contact and true object temperature are drawn from the populations of
        the contact model; an object whose temperature is not known (NaN) is as warm as the room.  Contact
        before the call shows from the call on.
        """
        if self.skin not in self.plant.outputs:
            problem = f"this plant has no {self.skin}, so it cannot grasp"
            raise UserError(problem, hint="use a plant with a skin")
        touch = self._draw(material, t_object, self._grasp_rng)
        alone = self._outputs_alone()[self.skin]
        self._contact = _Contact(touch, self.time, alone + self._added(alone))
        self._contact.follow(self.time, alone)

    def rehearse(self, material: str, t_object: float) -> None:
        """Load and compile what :meth:`grasp` needs, so that a host on a cable does not wait for it."""
        touch = self._draw(material, t_object, np.random.default_rng(0))
        _Contact(touch, self.time, self.ambient).addition(self.time + 1.0, self.ambient)

    def _draw(self, material: str, t_object: float, rng: np.random.Generator) -> Touch:
        if self._contact_model is None:
            grip = load_default_gripper().grip()
            # a calibration's bias is on the scale of its sensor, whose offset a reading gets anyhow
            self._contact_model = replace(grip, bias=grip.bias - self.offsets.get(self.skin, 0.0))
        temperature = self.ambient if np.isnan(t_object) else t_object
        return self._contact_model.draw(material, temperature, rng, ambient=self.ambient)

    def release(self) -> None:
        """Open the gripper."""
        if self._contact is not None and np.isinf(self._contact.opened):
            self._contact.left = self._added(self._outputs_alone()[self.skin])
            self._contact.opened = self.time

    def notices(self) -> list[Event]:
        """Return nothing: no line and no device can fail here."""
        return []

    def close(self) -> None:
        """Switch drive and pump off and refuse to switch them on again."""
        self._drive = dict.fromkeys(self._drive, 0.0)
        self._pump = 0
        self.closed = True

    def truth(self) -> dict[str, float]:
        """Return the true outputs now: no noise, offset or rounding; the skin with its object."""
        true = self._outputs_alone()
        if self._contact is not None:
            true[self.skin] += self._added(true[self.skin])
        return true

    def _input_vector(self) -> Array:
        """Return what is applied now in the order of the plant's inputs."""
        return np.array(
            [self._pump if n == "pump" else self._drive[n] for n in self.plant.inputs], dtype=float
        )

    def _disturbance_vector(self, given: Mapping[str, float]) -> Array:
        """Return the disturbances in the plant's order: as given, or where nobody reads them."""
        usual = dict(zip(self.plant.disturbances, self.plant.undisturbed(self.ambient).tolist(), strict=True))
        for name, value in usual.items():
            if name not in given and np.isnan(value):
                problem = f"the plant does not say what its disturbance {name!r} was in the logs"
                raise UserError(problem, hint=f"give it: disturbances={{{name!r}: ..}}")
        return np.array([given.get(name, value) for name, value in usual.items()], dtype=float)

    def _accumulate(self, seconds: float) -> None:
        self._applied += seconds * self._input_vector()
        self._elapsed += seconds

    def _mean_input(self) -> Array:
        """Return the inputs averaged over the native step so far; switches on or off."""
        mean = self._applied / self._elapsed if self._elapsed > 0 else self._input_vector()
        # what the fit did to its logs; a switch takes the value that it had for longer
        switch = np.array([name in self.plant.model.switches for name in self.plant.inputs])
        return np.where(switch, np.round(mean), mean)

    def _advance(self, u: Array) -> tuple[Array, Array]:
        y, x = self.plant.model.rollout(
            self._x[None], u[None, None], self._d[None, None], self.plant.p[None], self.plant.dt
        )
        return x[0], y[0, -1]

    def _outputs_alone(self) -> dict[str, float]:
        """Return the plant's outputs now, without any object; worked out once for a time."""
        if self._alone is not None and self._alone[0] == self.time:
            return dict(self._alone[1])
        y = self._y
        if self._elapsed > 0:
            y = y + self._elapsed / self.plant.dt * (self._advance(self._mean_input())[1] - y)
        self._alone = self.time, {name: float(value) for name, value in zip(self.plant.outputs, y)}
        return dict(self._alone[1])

    def _added(self, alone: float) -> float:
        """Return what an object adds now to a skin that alone would be at ``alone`` [K]."""
        return 0.0 if self._contact is None else self._contact.addition(self.time, alone)

    def _sensor(self, name: str, true: float) -> float:
        if name == self.plant.outputs[0]:  # the slow noise of all sensors moves on once a sample
            # an Ornstein-Uhlenbeck process of standard deviation ``slow_noise``
            keep = float(np.exp(-(self.time - self._slow_at) / SLOW_S))
            for sensor in self._slow:
                fresh = self.slow_noise * np.sqrt(1 - keep**2) * self._noise_rng.standard_normal()
                self._slow[sensor] = keep * self._slow[sensor] + fresh
            self._slow_at = self.time
        value = (
            true
            + self.offsets.get(name, 0.0)
            + self._slow[name]
            + self.noise * self._noise_rng.standard_normal()
        )
        return round(value / self.quantum) * self.quantum if self.quantum > 0 else value

    def _write_history(self, u: Array) -> None:
        touching = self._contact is not None and np.isinf(self._contact.opened)
        row = {"time_s": self.time, "contact": float(touching)}
        row |= {name: float(v) for name, v in zip(self.plant.inputs, u)}
        self.history.append(row | self.truth())


def _input_range(plant: Plant, name: str) -> tuple[float, float]:
    unit = plant.units.get(name, "1")
    logged = plant.valid.get(name) if unit == "1" else None
    return known_range(name, unit, logged, hint=f"give it: limits={{{name!r}: (lo, hi)}}")
