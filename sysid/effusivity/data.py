"""Grasps as the arrays that the posterior engine works on.

Samples are averaged in bins that widen with time, fixed in time, not in samples, so any sampling rate works;
a missing sample is missing from its average only, and so is a spike, or a sample at the end of its sensor's
range (:mod:`~thermogrip.sysid.effusivity.quality`).

The noise of the averages is a sum of three parts,

    C = sigma_w^2 / n  +  sigma_s^2 exp(-|dt| / l)  +  (m A)^2 g g' exp(-|du|),   u = ln(1 + t / 0.3 s),

white noise, slow noise, and what the model itself gets wrong, proportional to the excursion A of the grasp.

A grasp may differ from all that the gripper was taught by: a slip, a film, paint, a sheet in place of a
block, a slower sensor, a heater nearby.  The model is right but for a discrepancy of its trace and for
nuisances farther from where the training has them, as much as each of the :data:`GRADES` says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import check_grasps, label_values, log_name
from thermogrip.sysid.contact.simulation import PUMP_OFF
from thermogrip.sysid.effusivity.quality import CHECKED, number_values
from thermogrip.sysid.effusivity.quality import check_grasps as check_quality

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps

UNKNOWN_OBJECT_RANGE = 20.0  # K about the room
# degC of a room that is not stated: people sit in 20 to 26, and objects lie there.  Looked for about the
# skin, six objects by a core at 49 are right in .38 at a log loss of 1.55, about this in .68 at .83
USUAL_ROOM = 22.5
UNKNOWN_OBJECT_SD = UNKNOWN_OBJECT_RANGE / 3**0.5  # K, that of values spread evenly over the range
# A response to contact is sharp at first and smooth later: every sample (0.1 s) around contact, half a second
# by 10 s, seconds by 40 s.  Averages of white noise lose nothing, and 121 samples become 47 numbers.
_BIN_EDGES = np.concatenate(
    [
        np.arange(-60.65, -0.7, 0.5),
        np.arange(-0.65, 1.5, 0.1),
        np.arange(1.55, 4.0, 0.25),
        np.arange(4.05, 10.0, 0.5),
        np.arange(10.05, 40.0, 1.5),
        np.arange(40.05, 600.0, 5.0),
    ]
)


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Noise: ``white``, ``slow`` [K], ``correlation_time`` l [s], relative ``misfit`` m, its ``growth`` p."""

    white: float = 0.045  # sensor and rounding
    slow: float = 0.018  # drift, a drifting reference junction
    correlation_time: float = 4.0
    misfit: float = 0.0015
    growth: float = 1.0
    smooth: bool = False  # whether slow noise and misfit have a slope (Matern 3/2), as in smoothed records

    def correlation(self, distance: Array) -> Array:
        """Return the correlation of slow noise and misfit at a distance in units of their scale."""
        z = np.sqrt(3.0) * distance if self.smooth else distance
        return np.asarray(np.exp(-z) * (1 + z) if self.smooth else np.exp(-z))


class Grade(NamedTuple):
    """How unlike those of the training a grasp may be."""

    share: float
    unlike: float
    prior: float
    since: float = -np.inf  # s of contact from which the trace has a discrepancy
    misstated_K: float = 0.0  # sd of the object's temperature about what was stated
    thin: float = 0.0  # sd of the logarithm of the object's heat capacity about that of a block


# There is no end of such differences, and what has no model is explained by a wrong material, which is then
# sure. Nobody knows which it is of a grasp, so the evidence of whatever is asked (a material, an effusivity,
# a material of none of the blocks) is its sum over the grades, each times its prior probability.
# A slip, or a finger that closes again, leaves what came before it sound: then the discrepancy is anything
# from a time of 1, 2 or 4 s on.  A larger share pays for itself by the determinant of its covariance: grasps
# like those of the training are answered by the first grade as if there were no others, and what gross misfit
# leaves is flat.
# Three grasps in ten are unlike the training: one cannot know from a training, however clean, that none will
# be.  Evidence differs by some ten nats between grades, so that their odds barely count.  Log loss of
# disturbed grasps (two finite-volume fingers; the rig): .66, .47; without the last three .74, .51.
# Of an object one thing is likelier to be otherwise than all: a sheet in place of a block stores less and is
# else a block, and two sds are one of 0.4 mm.  Sheets of 1.5 mm have intervals of 2.4 in ln e (without 3.1),
# on the rig a log loss of .33 (.68); without all at once that of a second time constant is 1.36 (.67).
# An outsider may be a known material at another temperature than was stated.  With one misstatement in a
# hundred, of 3 K, grasps of the examples that are stated 5 K off have a log loss of .05 (without .35), and
# cork's p_unknown stays .98; one in twenty, of anything within 20 K, takes it to .21.
# Nothing says which of these two single things is the likelier, so both have the same odds: iron touched with
# a sensor 1.5 K off is thin copper as well.  Where sensor or objects are 1.5 K off (n = 240) log loss is .47
# (.49 without thin objects; .55 where they are three times as likely as misstatements).
GRADES = (
    Grade(0.0, 0.0, 0.69),
    Grade(0.0, 0.0, 0.02, misstated_K=3.0),
    Grade(0.001, 0.3, 0.05),
    Grade(0.003, 1.0, 0.02),
    Grade(0.0, 0.0, 0.02, thin=2.0),
    Grade(0.1, 1.0, 0.05),
    Grade(0.3, 0.0, 0.05, since=1.0),
    Grade(0.3, 0.0, 0.05, since=2.0),
    Grade(0.3, 0.0, 0.05, since=4.0),
)
_DISCREPANCY_TIMES_S = (0.5, 2.5, 10.0)  # of a trace: from a slip to a contact's length
KNOTS = np.array([-1.0, -0.6, -0.3, 0.0, 0.3, 0.6, 1.0, 1.5, 2.2, 3.2, 4.6, 6.6, 10.0, 16.0, 25.0, 40.0])


def at_knots(t: Array) -> Array:
    """Return the weights of the knots at times ``t`` [s], of shape t.shape + (n_knot,); 0 until -1.5 s."""
    base = np.eye(KNOTS.size + 1)[1:]
    x = np.concatenate([[-1.5], KNOTS])
    return np.stack([np.interp(t, x, row) for row in base], axis=-1)


@dataclass(frozen=True)
class Touches:
    """``n`` grasps, padded to the longest."""

    grasp_id: NDArray[np.str_]
    material: NDArray[np.str_]
    sample_t: Array  # (n, n_sample) [s]
    sample_bin: NDArray[np.int64]  # (n, n_sample), -1 where the sample is lost
    y: Array  # (n, n_bin), mean temperature [degC]
    t: Array  # (n, n_bin), mean time [s]
    count: Array  # (n, n_bin), samples
    ramp: Array  # (n, n_bin), mean time since the pump stopped [s]
    level: Array  # (n,), before contact [degC]
    t_object: Array  # (n,), nominal [degC]; as the next two NaN where unknown
    t_object_sd: Array  # (n,) [K]
    t_ambient: Array  # (n,), of the room [degC]
    excursion: Array  # (n,) [K]
    share: Array  # (n,), s: sd of what the model leaves out of the trace, in units of the excursion
    # (n,), w: sd by which nuisances are farther from those of the training, in logarithms of contact
    # conductance, build-up time and heat capacity, by proportional amounts in onset and object temperature
    unlike: Array
    since: Array  # (n,), when the discrepancy of the trace begins [s]
    thin: Array  # (n,), sd by which the logarithm of its heat capacity alone is farther
    question: NDArray[np.int64]  # (n,), the same of rows of which only the likeliest count
    trace: NDArray[np.int64]  # (n,), the same of rows of the same readings
    second: Touches | None = None  # what a second sensor of the finger read of the same grasps

    def take(self, index: NDArray[np.int64]) -> Touches:
        """Return the touches at these rows."""
        rows = {f.name: getattr(self, f.name)[index] for f in fields(self) if f.name != "second"}
        return Touches(**rows, second=None if self.second is None else self.second.take(index))

    def known(self, index: NDArray[np.int64]) -> Touches:
        """Return what was known of the touches at these rows, with no readings."""
        of_readings = ("grasp_id", "material", "sample_t", "sample_bin", "y", "t", "count", "ramp")
        numbers = {
            f.name: getattr(self, f.name)[slice(0) if f.name in of_readings else index]
            for f in fields(self)
            if f.name != "second"
        }
        return Touches(**numbers)

    @property
    def end(self) -> float:
        """Return the last sample's time [s]."""
        return float(self.sample_t[self.sample_bin >= 0].max())


def touches(
    grasps: Grasps, *, until: float | None = None, at: NDArray[np.int64] | slice = slice(None)
) -> Touches:
    """Return the binned arrays of a Grasps record, or of those ``at`` some rows, samples after ``until`` [s]
    left out."""
    second = None
    if "t_surface_2" in grasps:
        beside = grasps.drop_vars("t_surface_2").assign(t_surface=grasps["t_surface_2"])
        beside.attrs.pop(CHECKED, None)  # of the first sensor's samples
        second = touches(beside, until=until, at=at)
    masked = np.zeros(grasps["t_surface"].shape, dtype=bool)
    if CHECKED not in grasps.attrs:
        check_grasps(grasps)
        masked = check_quality(grasps).masked
    where = log_name(grasps)
    variables = grasps.variables  # a DataArray made of one costs more than to bin it
    ids = np.asarray(variables["grasp"].values).astype(str)[at]
    sd, t_object, t_ambient = (
        number_values(grasps, name)[at] for name in ("t_object_sd", "t_object", "t_ambient")
    )
    for i in np.flatnonzero(sd < 0):
        raise UserError(f"grasp {str(ids[i])!r} has a negative t_object_sd", file=where)
    time = np.asarray(variables["time"].values, dtype=float)
    keep = (time > _BIN_EDGES[0]) & (time < min(_BIN_EDGES[-1], np.inf if until is None else until + 1e-9))
    time, data = time[keep], np.asarray(variables["t_surface"].values, dtype=float)[at][:, keep]
    good = np.isfinite(data) & ~masked[at][:, keep]
    for i in np.flatnonzero((good & (time > 0.15)).sum(axis=1) < 1):
        raise UserError(f"grasp {str(ids[i])!r} has no sample after contact", file=where, hint="remove it")
    for i in np.flatnonzero((good & (time < -0.25)).sum(axis=1) < 1):
        raise UserError(
            f"grasp {str(ids[i])!r} has no sample before contact", file=where, hint="record from -2 s"
        )
    raw = np.searchsorted(_BIN_EDGES, time)
    used, bins = np.unique(raw, return_inverse=True)
    pick = np.zeros((time.size, used.size))
    pick[np.arange(time.size), bins] = 1.0
    count = good @ pick
    safe = np.maximum(count, 1.0)

    def mean(values: Array) -> Array:
        return np.asarray((np.where(good, values, 0.0) @ pick) / safe)

    before = good & (time < -0.25)
    level = np.where(before, data, 0.0).sum(axis=1) / before.sum(axis=1)
    y = mean(data)
    away = np.where(
        (count > 0) & (np.arange(used.size) >= bins[np.searchsorted(time, 0.15)]), y - level[:, None], 0
    )
    return Touches(
        grasp_id=ids, material=label_values(grasps, "material")[at],
        sample_t=np.broadcast_to(time, data.shape).copy(),
        # one memory layout whatever the record's: the compiled search is compiled anew for another
        sample_bin=np.ascontiguousarray(np.where(good, bins, -1), dtype=np.int64),
        y=y, t=mean(np.broadcast_to(time, data.shape)),
        count=count, ramp=mean(np.broadcast_to(np.maximum(time - PUMP_OFF, 0.0), data.shape)), level=level,
        t_object=t_object, t_object_sd=sd, t_ambient=t_ambient, excursion=np.abs(away).max(axis=1),
        share=np.zeros(level.size), unlike=np.zeros(level.size), since=np.full(level.size, -np.inf),
        thin=np.zeros(level.size), question=np.arange(level.size), trace=np.arange(level.size), second=second,
    )  # fmt: skip


def graded(data: Touches, grades: Sequence[Grade]) -> Touches:
    """Return each touch under each of some grades, (n n_grade,) rows."""
    n = data.level.size
    share, unlike, _, since, misstated_K, thin = (np.tile(column, n) for column in np.array(grades).T)
    of = np.repeat(np.arange(n), len(grades))
    # what the first grade says of a grasp is reported, however much likelier others are
    every = replace(data.take(of), question=2 * of + (np.arange(of.size) % len(grades) > 0))

    def of_grade(one: Touches, second: Touches | None) -> Touches:
        t_object_sd = np.where(misstated_K > 0, np.fmax(one.t_object_sd, misstated_K), one.t_object_sd)
        changed = {"share": share, "unlike": unlike, "since": since, "thin": thin, "t_object_sd": t_object_sd}
        return replace(one, second=second, **changed)

    return of_grade(every, None if every.second is None else of_grade(every.second, None))


def object_range(grasps: Grasps, stated: tuple[float, float] | None = None) -> Array:
    """Return between what an object of unknown temperature may be, (n_grasp, 2) [degC]: as ``stated``,
    or 20 K about the room."""
    n = grasps.sizes["grasp"]
    if stated is not None:
        low, high = stated
        if not (np.isfinite([low, high]).all() and -60 <= low < high <= 200):
            problem = f"an object range of {low:g} to {high:g} degC"
            raise UserError(problem, hint="give the lower end first, within -60 to 200 degC")
        return np.tile([low, high], (n, 1)).astype(float)
    centre = room_temperature(number_values(grasps, "t_ambient"))
    return np.stack([centre - UNKNOWN_OBJECT_RANGE, centre + UNKNOWN_OBJECT_RANGE], axis=1)


def room_temperature(t_ambient: Array) -> Array:
    """Return temperatures of rooms, the usual one where none is stated."""
    return np.where(np.isfinite(t_ambient), t_ambient, USUAL_ROOM)


def with_object_range(grasps: Grasps, stated: tuple[float, float] | None) -> Grasps:
    """Return a record whose unknown object temperatures have the mean and the sd (width over the root of
    twelve) of a stated range in which all are equally likely."""
    if stated is None:
        return grasps
    ends = object_range(grasps, stated)
    t_object, sd = number_values(grasps, "t_object"), number_values(grasps, "t_object_sd")
    unknown = ~np.isfinite(t_object)
    t_object = np.where(unknown, ends.mean(axis=1), t_object)
    sd = np.where(unknown, (ends[:, 1] - ends[:, 0]) / np.sqrt(12.0), sd)
    return grasps.assign(t_object=("grasp", t_object), t_object_sd=("grasp", sd))


def stack_touches(parts: list[Touches]) -> Touches:
    """Return several records as one, padded with lost samples and empty bins."""
    n_sample = max(p.sample_t.shape[1] for p in parts)
    n_bin = max(p.y.shape[1] for p in parts)

    def joined(name: str) -> Any:
        if name in ("question", "trace"):
            return np.arange(sum(p.level.size for p in parts))
        columns = [getattr(p, name) for p in parts]
        if columns[0].ndim == 1:
            return np.concatenate(columns)
        width = n_sample if name.startswith("sample") else n_bin
        fill = -1 if name == "sample_bin" else 0
        padded = [np.pad(f, ((0, 0), (0, width - f.shape[1])), constant_values=fill) for f in columns]
        return np.concatenate(padded)

    seconds = [p.second for p in parts if p.second is not None]
    second = stack_touches(seconds) if len(seconds) == len(parts) else None
    return Touches(**{f.name: joined(f.name) for f in fields(Touches) if f.name != "second"}, second=second)


def noise_covariance(data: Touches, noise: Noise) -> Array:
    """Return the covariance of the bin means, (n, n_bin, n_bin) [K^2]; an empty bin has variance 1 alone."""
    return _noise_parts(data, noise).total()


def noise_fit(data: Touches, noise: Noise, extra: Array, left: Array) -> tuple[float, Array]:
    """Return 1/2 r' C^-1 r + 1/2 ln det C of deviations r (n, n_bin) under a noise, and its slopes, by
    the logarithms of white, slow, correlation time and misfit, and by growth; C holds ``extra`` too."""
    # with C^-1 - C^-1 r r' C^-1 = G the slopes are 1/2 tr(G dC)
    parts = _noise_parts(data, noise)
    chol = np.linalg.cholesky(parts.total() + extra)
    root = np.linalg.inv(chol)
    z = np.einsum("nij,nj->ni", root, left)
    cost = 0.5 * (z**2).sum() + np.log(np.diagonal(chol, axis1=1, axis2=2)).sum()
    a = np.einsum("nij,ni->nj", root, z)
    g = root.transpose(0, 2, 1) @ root
    g -= a[:, :, None] * a[:, None, :]
    diagonal = np.diagonal(g, axis1=1, axis2=2) * (data.count > 0)
    bins = np.arange(data.t.shape[1])
    g[:, bins, bins] = diagonal
    # of grasps that share their time axis the sum serves
    axes, which = _axes(data)
    shared = np.stack([g[which == k].sum(axis=0) for k in range(len(axes))])
    x = np.abs(axes[:, :, None] - axes[:, None, :]) / noise.correlation_time
    by_slow = shared * (noise.slow**2 * noise.correlation(x))
    # slope of -ln correlation by ln distance
    steep = 3 * x**2 / (1 + np.sqrt(3.0) * x) if noise.smooth else x
    g *= parts.misfit
    by_misfit = g.sum(axis=2)
    longer = np.log1p(np.maximum(data.t, 0.0) / 10)
    slopes = [
        (diagonal * parts.white).sum(),
        by_slow.sum(),
        0.5 * (by_slow * steep).sum(),
        by_misfit.sum(),
        (longer * by_misfit).sum(),
    ]
    return float(cost), np.array(slopes)


@dataclass(frozen=True, eq=False)
class _NoiseParts:
    """Of bin means."""

    white: Array  # (n, n_bin), variances, 1 where empty
    slow: Array  # (n, n_bin, n_bin)
    misfit: Array  # (n, n_bin, n_bin)

    def total(self) -> Array:
        cov = self.slow + self.misfit
        bins = np.arange(self.white.shape[1])
        cov[:, bins, bins] += self.white
        return np.asarray(cov)


def _noise_parts(data: Touches, noise: Noise) -> _NoiseParts:
    t = data.t
    has_samples = data.count > 0
    # grasps of one record share their time axis, and the exponentials cost most
    axes, which = _axes(data)
    apart = np.abs(axes[:, :, None] - axes[:, None, :])
    slow = noise.slow**2 * noise.correlation(apart / noise.correlation_time)
    u = np.log1p(np.maximum(axes, 0.0) / 0.3)
    alike = noise.correlation(np.abs(u[:, :, None] - u[:, None, :]))
    # g = (1 + t / 10 s)^p: with contact time, so that a longer record raises confidence no faster than truth
    size = noise.misfit * data.excursion[:, None] * (1 + np.maximum(t, 0.0) / 10) ** noise.growth * (t > 0)
    misfit = alike[which] * (size * has_samples)[:, :, None] * (size * has_samples)[:, None, :]
    if data.share.any():
        # a Gaussian process of sd s A whose correlation is the mean of exp(-|dt| / l)
        alike = np.mean([np.exp(-apart / scale) for scale in _DISCREPANCY_TIMES_S], axis=0)
        size = (data.share * data.excursion)[:, None] * has_samples * (t > data.since[:, None])
        misfit += alike[which] * size[:, :, None] * size[:, None, :]
    white = np.where(has_samples, noise.white**2 / np.maximum(data.count, 1.0), 1.0)
    both = has_samples[:, :, None] & has_samples[:, None, :]
    return _NoiseParts(white, slow[which] * both, misfit)


def _axes(data: Touches) -> tuple[Array, NDArray[np.int64]]:
    """Return the time axes (n_axis, n_bin), and which each grasp has."""
    if (data.t == data.t[0]).all():
        return data.t[:1], np.zeros(len(data.t), dtype=np.int64)
    axes, which = np.unique(data.t, axis=0, return_inverse=True)
    return axes, which.ravel()


#: What :func:`whiten` returns.
Whitened: TypeAlias = tuple[Array, Array]


def whiten(data: Touches, noise: Noise, extra: Array | float = 0.0) -> tuple[Array, Array]:
    """Return W with W' W = C^-1, (n, n_bin, n_bin), zero for empty bins, and ln det(2 pi C), (n,); ``extra``
    is what else C holds."""
    chol = np.linalg.cholesky(noise_covariance(data, noise) + extra)
    has_samples = data.count > 0
    w = np.ascontiguousarray(np.linalg.inv(chol) * has_samples[:, None, :] * has_samples[:, :, None])
    diagonal = np.diagonal(chol, axis1=1, axis2=2)
    return w, (2 * np.log(diagonal)).sum(axis=1) + has_samples.sum(axis=1) * np.log(2 * np.pi)
