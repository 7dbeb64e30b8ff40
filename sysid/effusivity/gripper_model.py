"""A calibrated gripper: what describes the gripper, and what it learnt about blocks.

Three parts are kept apart:

- the **gripper** (stack, noise, mean onset, heat loss of a block in transit, effective depth of a block):
  learnt from all training grasps together;
- the **spreads** from grasp to grasp (contact conductance, build-up time, onset, object temperature,
  effusivity of insulators): also from all;
- the **blocks**: contact conductance and effusivity of each material, from the grasps of that material.

A calibration ends with a posterior of theta, the parameters that all grasps share; a later one on a few known
grasps leans on it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import softmax

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import reading
from thermogrip.datasets.files import read_json, write_json
from thermogrip.datasets.limits import number_within
from thermogrip.sysid.contact.materials import load_materials
from thermogrip.sysid.contact.simulation import Grip, Stack
from thermogrip.sysid.effusivity.data import GRADES, KNOTS, Grade, Noise, at_knots

# the stack, mean build-up time and onset, heat loss in transit, bias of the nominal temperature, depth:
# theta but for the blocks, in the order of the calibration
SHARED_NAMES = (
    "ln_e_outer", "ln_z_outer", "ln_e_inner", "ln_z_inner", "ln_g_back", "ln_lag", "ln_first", "creep",
    "ln_settle", "leak", "ln_g_side", "ln_c_side", "ln_g_far", "ln_build_up", "onset", "transit_loss", "bias",
    "ln_depth",
)  # fmt: skip

# what the files of earlier versions call them
_FILE_KEYS = {"build_up": "build", "ln_build_up": "ln_build", "transit_loss": "carry"}
_FILE_KEYS |= {"ln_h_of_blocks": "finish", "ln_h_level": "finish_level", "ln_h_slope": "finish_slope"}
_FILE_KEYS["correlation_time"] = "memory"
WIDER = 1.5  # GripperSpread's numbers are guesses themselves: so wide, answers are right as often as stated
NOTHING = 1e-3  # in place of a conductance of nothing, which has no logarithm
STACK_NAMES = SHARED_NAMES[: SHARED_NAMES.index("onset")]  # these make a Stack
_ROUNDING = 1e-6  # a correlation matrix may have an eigenvalue so far below zero by rounding alone


def stack_numbers(stack: Stack) -> Array:
    """Return the numbers of a stack as they stand in theta, (14,)."""
    values = {f.name: float(getattr(stack, f.name)) for f in fields(Stack)}
    return np.array(
        [np.log(max(values[n[3:]], NOTHING)) if n.startswith("ln_") else values[n] for n in STACK_NAMES]
    )


def stack_of(theta: Array) -> Stack:
    """Return the stack that the first numbers of theta describe; ValueError where there can be none."""
    named = zip(STACK_NAMES, theta.tolist())
    return Stack(**{n.removeprefix("ln_"): float(np.exp(v)) if "ln_" in n else v for n, v in named})


@dataclass(frozen=True)
class ParameterCovariance:
    """Covariance of the estimates of a calibration."""

    names: tuple[str, ...]  # of SHARED_NAMES, then "ln_h LABEL" and "ln_e LABEL" of each block
    covariance: Array = field(compare=False)  # (n, n)

    def __post_init__(self) -> None:
        shape = (len(self.names),) * 2
        if self.covariance.shape != shape or not np.all(np.isfinite(self.covariance)):
            raise ValueError(f"covariance must be finite, of shape {shape}, got {self.covariance.shape}")
        if not np.allclose(self.covariance, self.covariance.T, rtol=1e-6, atol=1e-12):
            raise ValueError("covariance must be symmetric")
        sd = np.sqrt(np.maximum(np.diagonal(self.covariance), 1e-300))
        least = float(np.linalg.eigvalsh(self.covariance / np.outer(sd, sd)).min(initial=0.0))
        if least < -_ROUNDING:
            raise ValueError(f"covariance has a negative variance: {least:.2g} of correlations")
        if missing := [name for name in SHARED_NAMES if name not in self.names]:
            raise ValueError(f"covariance lacks {missing[0]}")

    def sd(self, name: str) -> float:
        """Return the standard deviation of one estimate."""
        i = self.names.index(name)
        return float(np.sqrt(self.covariance[i, i]))

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-able description."""
        names = [_FILE_KEYS.get(name, name) for name in self.names]
        return {"names": names, "covariance": self.covariance.tolist()}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> ParameterCovariance:
        """Return what :meth:`to_dict` described."""
        name_of_key = {key: name for name, key in _FILE_KEYS.items()}
        names = tuple(name_of_key.get(name, name) for name in map(str, content["names"]))
        return cls(names, np.asarray(content["covariance"], dtype=float))


@dataclass(frozen=True, kw_only=True)
class GripperSpread:
    """Standard deviations between grippers of one kind; of logarithms but for the last five."""

    sheet_thickness: float = 0.20  # of the outer layer, graphite that is cut from stock and pressed on
    sheet_conductivity: float = 0.30  # through its thickness, by what binder and pressure leave
    sheet_capacity: float = 0.10  # that of carbon
    layer_thickness: float = 0.25  # of the inner one, filled silicone that is cast by hand
    layer_conductivity: float = 0.25  # by filler and settling
    layer_capacity: float = 0.10  # by mixing
    glue: float = 0.50  # conductances to the pipe's wall and to what is beside it
    store: float = 0.30  # heat capacity beside, the water in the pipe
    lag: float = 0.50  # of the sensor, through its own bond
    contact: float = 0.25  # conductance of all blocks alike: skin meets them with another pressure
    block_contact: float = 0.10  # of each by itself
    build_up: float = 0.40
    first: float = 0.50  # share at first touch
    settle: float = 0.30
    creep: float = 0.10
    leak: float = 3e-4  # [1/s] drift to the room once the pump is off
    onset: float = 0.05  # [s]
    transit_loss: float = 0.005
    bias: float = 0.20  # [K] two thermistors of 1 %

    def covariance(self, names: Sequence[str]) -> Array:
        """Return the covariance that another gripper adds to the estimates called ``names``, (n, n)."""
        stems = [name.split(" ")[0] for name in names]  # ln_h of all blocks alike
        by_cause = np.array([[source.get(stem, 0.0) for stem in stems] for source in self._sources()])
        per_block = np.diag([self.block_contact**2 * name.startswith("ln_h ") for name in names])
        return np.asarray(by_cause.T @ by_cause + per_block)

    def _sources(self) -> list[dict[str, float]]:
        """Return what each independent cause moves, and how far."""
        out: list[dict[str, float]] = []
        for where, layer in (("outer", "sheet"), ("inner", "layer")):
            e, z = f"ln_e_{where}", f"ln_z_{where}"
            out.append({z: getattr(self, f"{layer}_thickness")})
            # of conductivity k, heat capacity c and thickness d: ln e = (ln k + ln c) / 2 and
            # ln z = ln d + (ln c - ln k) / 2, so the stack's own numbers are correlated
            k, c = 0.5 * getattr(self, f"{layer}_conductivity"), 0.5 * getattr(self, f"{layer}_capacity")
            out += [{e: k, z: -k}, {e: c, z: c}]
        out += [{"ln_g_back": self.glue}, {"ln_g_side": self.glue}, {"ln_c_side": self.store}]
        out += [{f"ln_{name}": getattr(self, name)} for name in ("lag", "build_up", "first", "settle")]
        out += [{name: getattr(self, name)} for name in ("creep", "leak", "onset", "transit_loss", "bias")]
        return [*out, {"ln_h": self.contact}]


def another_gripper(gripper: GripperModel) -> GripperModel:
    """Return what one gripper's calibration leaves open about another one of its kind: the same numbers, less
    well known, from which a calibration on a few known grasps of the other one starts."""
    # where its file keeps no covariance its own numbers count as exact; the blocks stay the same
    covariance = gripper.uncertainty
    if covariance is None:
        names = (*SHARED_NAMES, *block_names(gripper.materials))
        covariance = ParameterCovariance(names, np.zeros((len(names), len(names))))
    extra = WIDER**2 * GripperSpread().covariance(covariance.names)
    return replace(
        gripper,
        uncertainty=ParameterCovariance(covariance.names, covariance.covariance + extra),
        second=None if gripper.second is None else another_gripper(gripper.second),
    )


def block_names(labels: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the blocks' estimates, ln h of each and then ln e of each."""
    return (*(f"ln_h {label}" for label in labels), *(f"ln_e {label}" for label in labels))


INSULATOR = 3000.0  # W s^0.5 m^-2 K^-1: below it a block's effusivity scatters from grasp to grasp
LEVEL_SD = 3.0  # K: the level before contact is as good as free
# by which the noise counts more beside a learnt discrepancy: what differs from grasp to grasp of it is no
# noise, and readings say half as much; what is known before them stays
NOISE_TIMES = 2**0.5

_DEVICE_SCHEMA, _DEVICE_VERSION = "thermogrip.device", 2
# what the numbers of a file may be
_SD = (0.0, 100.0)
_LOGARITHM = (-50.0, 50.0)
_RATIO = (-10.0, 10.0)
_SECONDS = (1e-9, 1e4)
_CONDUCTANCE = (0.0, 1e7)
_STORE = (1e-9, 1e9)
_EFFUSIVITY = (1.0, 1e6)
_DEPTH = (1e-3, 1e3)
_OF_STACK = {"leak": _RATIO, "c_side": _STORE, "first": (0.0, 1.0), "creep": (-0.2, 10.0)}
_OF_STACK |= dict.fromkeys(("e_outer", "e_inner"), _EFFUSIVITY)
_OF_STACK |= dict.fromkeys(("z_outer", "z_inner"), _DEPTH)
_OF_STACK |= dict.fromkeys(("g_back", "g_side", "g_far"), _CONDUCTANCE)
_OF_STACK |= dict.fromkeys(("lag", "build_up", "settle"), _SECONDS)
_OF_NOISE = {"white": _SD, "slow": _SD, "correlation_time": _SECONDS, "misfit": _SD, "growth": _RATIO}
_OF_SPREADS = dict.fromkeys(("ln_h", "ln_effusivity", "ln_h_of_blocks"), _SD)
_OF_SPREADS |= dict.fromkeys(("dof", "insulator_dof"), _STORE)
# whose precision is needed
_OF_SPREADS |= dict.fromkeys(("ln_build_up", "onset", "t_object"), (1e-12, 100.0))
_OF_BLOCK = {"library_effusivity": _EFFUSIVITY, "heat_capacity": _STORE, "n_grasp": (0.0, 1e9)}
_OF_BLOCK |= dict.fromkeys(("ln_h", "ln_effusivity"), _LOGARITHM)
_OF_BLOCK |= dict.fromkeys(("ln_h_sd", "ln_effusivity_sd", "library_sd_ln"), _SD)
_OF_GRIPPER = {"onset": (-100.0, 100.0), "transit_loss": _RATIO, "bias": (-1e3, 1e3)}
# a block thinner than these is a film: it stores nothing, and no posterior of its material has a width
_OF_GRIPPER |= {"depth_share": (1e-2, 10.0), "block_length": (1e-4, 10.0)}
_OF_GRIPPER |= dict.fromkeys(("ln_h_level", "ln_h_slope"), _LOGARITHM)


@dataclass(frozen=True, kw_only=True)
class Spreads:
    """Standard deviations from grasp to grasp."""

    ln_h: float  # of the contact conductance
    ln_build_up: float  # of its build-up time
    onset: float  # [s]
    t_object: float  # [K], of the block about its nominal temperature
    ln_effusivity: float  # of insulators
    ln_h_of_blocks: float  # of ln h from block to block
    dof: float = 1e6  # degrees of freedom that these were learnt with
    insulator_dof: float = 1e6  # those of ``ln_effusivity``

    def __post_init__(self) -> None:
        *sds, dof, insulator_dof = (getattr(self, spread.name) for spread in fields(self))
        if not (min(sds) >= 0 and min(dof, insulator_dof) > 0):
            raise ValueError(f"need spreads of 0 or more and degrees of freedom above 0, got {self}")


@dataclass(frozen=True, kw_only=True)
class Block:
    """The calibrated block of one material."""

    ln_h: float  # on the gripper's scale, as ``ln_effusivity``
    ln_h_sd: float  # of this estimate
    ln_effusivity: float
    ln_effusivity_sd: float  # of this estimate
    library_effusivity: float  # [W s^0.5 m^-2 K^-1]
    library_sd_ln: float  # its relative sd
    heat_capacity: float  # rho c_p [J m^-3 K^-1]
    n_grasp: int


@dataclass(frozen=True)
class Discrepancy:
    """What a gripper was found to read beyond the model at ``KNOTS``, linear between them."""

    # (n_knot,) [K], common to all grasps: a heater that is cut at contact, a skin on its way
    always: Array = field(compare=False)
    # (n_block, n_knot), per degree between object and skin, by block in the gripper's order, and by the
    # effusivity of others: an approach before contact, a smoothed record
    share: Array = field(compare=False)
    onset: Array = field(compare=False)  # (n_block,) [s], of contact with each block about the mean

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], n_block: int) -> Discrepancy:
        """Return what a file holds; ValueError where a shape or a number is wrong."""
        curves = [np.asarray(content[f.name], dtype=float) for f in fields(cls)]
        shapes = [(KNOTS.size,), (n_block, KNOTS.size), (n_block,)]
        if [p.shape for p in curves] != shapes or not all(np.isfinite(p).all() for p in curves):
            raise ValueError("discrepancy is of another shape, or not finite")
        return cls(*curves)


@dataclass(frozen=True, kw_only=True)
class GripperModel:
    """The calibrated gripper (frozen; a JSON file of schema ``thermogrip.device``).

    Parameters
    ----------
    stack : Stack
    noise : Noise
    spreads : Spreads
    onset : float
        Mean time of contact after the closed message [s].
    transit_loss : float
        Share of the way to room temperature that a block relaxes before contact.
    bias : float
        Object temperatures on the sensor's scale minus the nominal ones [K].
    depth_share, block_length : float
        A block of this length [m] stores rho c_p block_length depth_share per contact face and degree.
    ln_h_level, ln_h_slope : float
        ln h [ln(W m^-2 K^-1)] of a block that was not calibrated is ln_h_level + ln_h_slope (ln e - 9).
    blocks : mapping of str to Block
    trained_on : tuple of str
        Names of the records it was calibrated on.
    uncertainty : ParameterCovariance, optional
        Of all these parameters.
    second : GripperModel, optional
        What surrounds a second sensor of the finger (``t_surface_2``), calibrated on the same grasps.
    discrepancy : Discrepancy, optional
        What the gripper reads beyond the model, where its calibration found something.
    """

    stack: Stack
    noise: Noise
    spreads: Spreads
    onset: float
    transit_loss: float
    bias: float
    depth_share: float
    block_length: float
    ln_h_level: float
    ln_h_slope: float
    blocks: Mapping[str, Block]
    trained_on: tuple[str, ...] = ()
    uncertainty: ParameterCovariance | None = None
    second: GripperModel | None = None
    discrepancy: Discrepancy | None = None

    @property
    def grades(self) -> tuple[Grade, ...]:
        """How unlike the training a grasp may be; a discrepancy that was learnt replaces those of a trace."""
        return GRADES[:2] if self.discrepancy is not None else GRADES

    @property
    def reading_noise(self) -> Noise:
        """The noise with which the readings of a grasp count."""
        one, times = self.noise, 1.0 if self.discrepancy is None else NOISE_TIMES
        return replace(one, white=times * one.white, slow=times * one.slow, misfit=times * one.misfit)

    @property
    def unlisted(self) -> list[str]:
        """The materials that the table lacks, which were learnt from their grasps alone."""
        return [name for name, block in self.blocks.items() if block.library_sd_ln > 1]

    @property
    def materials(self) -> tuple[str, ...]:
        """Return the labels that it was calibrated with."""
        return tuple(self.blocks)

    def discrepancy_of(self, ln_effusivity: Array) -> Discrepancy | None:
        """Return the discrepancy by other blocks, of found effusivities (n,)."""
        if (learnt := self.discrepancy) is None:
            return None
        blocks = np.array([block.ln_effusivity for block in self.blocks.values()])
        order = np.argsort(blocks)
        columns = np.column_stack([learnt.share, learnt.onset])[order].T
        interpolated = np.stack([np.interp(ln_effusivity, blocks[order], c) for c in columns], axis=1)
        return replace(learnt, share=interpolated[:, :-1], onset=interpolated[:, -1])

    def beyond(self, t: Array, ln_effusivity: Array) -> Array:
        """Return the discrepancy of touches at times ``t`` (n or 1, n_bin) under found effusivities (n,),
        (n, 2, n_bin): always [K], and per degree between object and skin."""
        out = np.zeros((ln_effusivity.size, 2, t.shape[1]))
        if (learnt := self.discrepancy_of(ln_effusivity)) is not None:
            weight = at_knots(t)
            out[:, 0], out[:, 1] = weight @ learnt.always, (weight * learnt.share[:, None, :]).sum(axis=2)
        return out

    def expected_ln_h(self, ln_effusivity: Array) -> Array:
        """Return the expected ln h of a block of found effusivity ln e that was not calibrated."""
        return self.ln_h_level + self.ln_h_slope * (np.asarray(ln_effusivity) - 9.0)

    def nominal_sd(self, room_difference: Array) -> Array:
        """Return the sd of ``bias + transit_loss * room_difference`` [K], same shape.

        ``room_difference`` is room minus object temperature [K], NaN where either is unknown.  The two were
        learnt in the rooms of the calibration, where they compensate each other; in others they do not.  Zero
        where the calibration has no covariance.
        """
        away = np.nan_to_num(np.asarray(room_difference, dtype=float))
        if self.uncertainty is None:
            return np.zeros(away.shape)
        place = [self.uncertainty.names.index(name) for name in ("bias", "transit_loss")]
        covariance = self.uncertainty.covariance[np.ix_(place, place)]
        variance = covariance[0, 0] + 2 * covariance[0, 1] * away + covariance[1, 1] * away**2
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def grip(self) -> Grip:
        """Return the gripper and its populations as a simulation draws from them.

        A material without a block in the calibration has its library effusivity on the gripper's scale and
        the contact conductance that the calibration expects of it.
        """
        ln_h = {name: block.ln_h for name, block in self.blocks.items()}
        ln_e = {name: block.ln_effusivity for name, block in self.blocks.items()}
        for name, material in load_materials().items():
            if name not in self.blocks:
                ln_effusivity = np.log(np.array([material.effusivity]))
                ln_e[name] = float(ln_effusivity[0] + self.effusivity_scale(ln_effusivity)[0][0])
                ln_h[name] = float(self.expected_ln_h(np.array([ln_e[name]]))[0])
        spreads = self.spreads
        return Grip(
            stack=self.stack,
            h_c_of={name: float(np.exp(value)) for name, value in ln_h.items()},
            h_c_sd_ln=spreads.ln_h,
            build_up_sd_ln=spreads.ln_build_up,
            onset=self.onset,
            onset_sd=spreads.onset,
            bias=self.bias,
            t_object_sd=spreads.t_object,
            transit_loss=self.transit_loss,
            effusivity_of={name: float(np.exp(value)) for name, value in ln_e.items()},
            effusivity_sd_ln={
                name: spreads.ln_effusivity for name, value in ln_e.items() if value < np.log(INSULATOR)
            },
            length=self.block_length * self.depth_share,
        )

    def readings(self) -> dict[str, float]:
        """Return noise and drift of its readings, as options of the simulation."""
        noise = self.noise
        slow = {"slow_noise": noise.slow, "correlation_time": noise.correlation_time}
        return {"noise": noise.white, "leak": self.stack.leak, "quantum": 0.0} | slow

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-able description."""
        numbers = asdict(replace(self, uncertainty=None, second=None, discrepancy=None))
        del numbers["uncertainty"], numbers["second"], numbers["discrepancy"]
        if self.discrepancy is not None:
            numbers["discrepancy"] = {k: v.tolist() for k, v in vars(self.discrepancy).items()}
        numbers |= {} if self.second is None else {"second": self.second.to_dict()}
        for group in ("stack", "noise", "spreads"):
            numbers[group] = {_FILE_KEYS.get(k, k): v for k, v in numbers[group].items()}
        numbers |= {"blocks": dict(numbers["blocks"]), "trained_on": [*self.trained_on]}
        numbers |= {} if self.uncertainty is None else {"knowledge": self.uncertainty.to_dict()}
        return {_FILE_KEYS.get(k, k): v for k, v in numbers.items()}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], *, file: str | Path = "device") -> GripperModel:
        """Return the gripper that :meth:`to_dict` described; a wrong entry is a :class:`UserError`."""
        with reading("is not a whole device calibration", file=file, hint="calibrate again"):
            return cls(
                # files from before blocks had a far face have none
                stack=Stack(**_numbers_in_ranges({"g_far": 0.0, **content["stack"]}, _OF_STACK)),
                noise=Noise(
                    **_numbers_in_ranges(content["noise"], _OF_NOISE),
                    smooth=bool(content["noise"].get("smooth")),
                ),
                spreads=Spreads(**_numbers_in_ranges(content["spreads"], _OF_SPREADS)),
                blocks={str(k): _block(v) for k, v in content["blocks"].items()},
                trained_on=tuple(str(v) for v in content.get("trained_on", ())),
                # files from before there was a covariance have neither
                uncertainty=ParameterCovariance.from_dict(content["knowledge"])
                if "knowledge" in content
                else None,
                second=cls.from_dict(content["second"], file=file) if "second" in content else None,
                discrepancy=Discrepancy.from_dict(content["discrepancy"], len(content["blocks"]))
                if "discrepancy" in content
                else None,
                **_numbers_in_ranges(content, _OF_GRIPPER),
            )

    def save(self, path: str | Path) -> Path:
        """Write the gripper as JSON and return the path."""
        return write_json(path, self.to_dict(), schema=_DEVICE_SCHEMA, version=_DEVICE_VERSION)

    @classmethod
    def load(cls, path: str | Path) -> GripperModel:
        """Return the gripper in a JSON file; :class:`UserError` where it is missing or not whole."""
        return cls.from_dict(read_json(path, _DEVICE_SCHEMA, _DEVICE_VERSION), file=path)

    def found_effusivity(self, ln_effusivity: Array) -> Array:
        """Return what ln e of the library's scale is on the gripper's own, of the same shape."""
        true = np.asarray(ln_effusivity, dtype=float)
        on_own_scale = true
        for _ in range(5):  # found = true x scale(found), and the scale is smooth
            on_own_scale = true + self.effusivity_scale(on_own_scale)[0]
        return on_own_scale

    def effusivity_scale(self, ln_effusivity: Array) -> tuple[Array, Array]:
        """Return mean and sd of ln(found / true) at found values ln e, of the same shape.

        The anchors are the blocks, ln(found / library) with the library's uncertainty and 10 % for the block
        itself, times a factor that the blocks share and that their scatter tells.  Between them a Gaussian
        process interpolates (prior sd 0.3, with a discrepancy 0.6, correlation length 1.5 in ln e), so a
        found value far from every known block is reported with that prior's uncertainty.
        """
        # the engine finds effusivities on the gripper's own scale: the data fix ratios such as e / e_inner
        # better than e itself; those that are reported are divided by this one
        x = np.asarray(ln_effusivity, dtype=float)
        blocks = [block for name, block in self.blocks.items() if name not in self.unlisted]
        anchors = np.array([b.ln_effusivity for b in blocks])
        ln_ratio = anchors - np.log([b.library_effusivity for b in blocks])
        prior = 0.3**2 if self.discrepancy is None else 0.6**2

        def kernel(a: Array, b: Array) -> Array:
            return np.asarray(prior * np.exp(-0.5 * ((a[:, None] - b[None, :]) / 1.5) ** 2))

        stated = np.diag([b.library_sd_ln**2 + 0.1**2 for b in blocks])
        estimated = np.diag([b.ln_effusivity_sd**2 for b in blocks])
        # The handbook states by how much blocks deviate from it; those of one lab do so together, less or
        # more.  The factor is half normal of mean square 1, so that over all labs its variance is the stated
        # one; the even integrand is summed by Gauss's rule over the whole line.
        factor, weight_before = np.polynomial.hermite_e.hermegauss(20)
        inverse = np.linalg.inv(kernel(anchors, anchors) + estimated + factor[:, None, None] ** 2 * stated)
        by_factor = inverse @ ln_ratio
        likelihood = 0.5 * (np.linalg.slogdet(inverse)[1] - by_factor @ ln_ratio)
        weight = softmax(np.log(weight_before) + likelihood)
        mean_gain = weight @ by_factor
        known = np.einsum("k,kij->ij", weight, inverse - by_factor[:, :, None] * by_factor[:, None, :])
        known += mean_gain[:, None] * mean_gain
        cross = kernel(x.ravel(), anchors)
        mean, variance_here = cross @ mean_gain, prior - ((cross @ known) * cross).sum(axis=1)
        return mean.reshape(x.shape), np.sqrt(np.maximum(variance_here, 0.0)).reshape(x.shape)


def load_default_gripper() -> GripperModel:
    """Return the bundled calibration of the example rig's gripper; its numbers count as exact."""
    # made from the shipped training grasps of exp1 to exp4 alone, without a covariance, by
    # python -c "from dataclasses import replace;
    # from thermogrip.sysid.effusivity.calibration import calibrate_example_gripper as calibrate;
    # replace(calibrate(), uncertainty=None).save('sysid/data/gripper_device.json')"
    path = resources.files("thermogrip.sysid.effusivity") / "data" / "gripper_device.json"
    with resources.as_file(path) as file:
        return GripperModel.load(file)


def _numbers_in_ranges(
    content: Mapping[str, Any], ranges: Mapping[str, tuple[float, float]]
) -> dict[str, float]:
    keys = {name: _FILE_KEYS.get(name, name) for name in ranges}
    return {name: number_within(content, keys[name], *ranges[name]) for name in ranges}


def _block(content: Mapping[str, Any]) -> Block:
    numbers = _numbers_in_ranges(content, _OF_BLOCK)
    return Block(n_grasp=int(numbers.pop("n_grasp")), **numbers)
