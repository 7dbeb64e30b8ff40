"""Touches of one block: one object temperature, seen from two gripper temperatures.

Two touches must agree on the block: on its effusivity, heat capacity, what its contact conductance has in
common, and its temperature, which moves from one touch to the next.  Under a candidate, or a free effusivity
on a grid, each touch is a Gaussian factor of what it shares with the others, by both sensors where there are
two: Laplace's method gives the posterior of its nuisances, and dividing out its prior leaves the likelihood
of x = (T_obj, ln h, ln e, ln C) alone,

    L(x) = c exp(eta' d - d' Lambda d / 2),   d = x - x0,

with everything that no other touch knows (onset, level, build-up) integrated.

Between two touches the block relaxes towards the room with time constant C / U, so with a share a of the drop
rho of the face that the first touch leaves,

    T_2 = T_room + exp(-U rest / C) (T_1 - a rho (T_1 - T_grip) - T_room) + N(0, s^2 + (law way)^2).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from thermogrip.datasets.arrays import Array, Mask
from thermogrip.datasets.errors import UserError, reading
from thermogrip.datasets.files import read_json, write_json
from thermogrip.datasets.limits import number_within
from thermogrip.datasets.schema import label_values, log_name
from thermogrip.sysid.contact.materials import Material
from thermogrip.sysid.contact.simulation import step_response, time_nodes
from thermogrip.sysid.effusivity import posterior_grid
from thermogrip.sysid.effusivity.data import UNKNOWN_OBJECT_SD, Touches, touches, whiten
from thermogrip.sysid.effusivity.gripper_model import GripperModel
from thermogrip.sysid.effusivity.laplace_approximation import (
    CAPACITY,
    EFFUSIVITY,
    T_OBJECT,
    H,
    Hypotheses,
    Mode,
    Prior,
    find_modes,
    free_hypotheses,
    material_hypotheses,
    prior_of,
    with_second,
)
from thermogrip.sysid.effusivity.quality import number_values

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps

_COUPLING_SCHEMA, _COUPLING_VERSION = "thermogrip.coupling", 1
# of the numbers of a file
_FILE_RANGES = {"found": (0.0, 2.0), "loss": (0.0, 1e9), "sd": (1e-9, 1e6), "ln_h_sd": (1e-9, 100.0)}
_FILE_RANGES["longest_rest"] = (0.0, np.inf)
#: Time between two touches, where the record does not say [s].
REST = 60.0


@dataclass(frozen=True)
class BlockSettings:
    """What a block does between two touches, beyond what groups of known material teach."""

    law_sd: float = 0.15  # of the way to the room, uncertain in an even block
    uneven_sd: float = 0.25  # and more in an uneven one
    far_sd: float = 0.03  # of a temperature's distance from the skin, in quadrature beyond far_K
    far_K: float = 15.0  # as far as blocks lay from the skin where the coupling was learnt
    into_s: float = 2.0  # the next touch: where its reading knows most of the block
    longer_rest: float = 1.5  # times the longest rest that the coupling was learnt from
    contradiction_sd: float = 5.0  # beyond which touches contradict each other
    # ln k, what blocks lose in units of the training's: free convection alone goes from 2 to 25 W/m2K
    ln_loss: tuple[float, ...] = (0.0, -1.1, -0.55, 0.55, 1.1, 1.65)
    ln_loss_sd: float = 0.64
    other_loss: float = 0.2  # probability that k is not 1
    no_candidate: float = 0.1  # that a group is of none: it says little of k then

    def log_loss_prior(self) -> Array:
        """Return the log probabilities of the losses, (n_loss,)."""
        z = np.array(self.ln_loss[1:]) / self.ln_loss_sd
        others = np.log(self.other_loss) - 0.5 * z**2 - logsumexp(-0.5 * z**2)
        return np.concatenate([[np.log1p(-self.other_loss)], others])


BLOCK = BlockSettings()


@dataclass(frozen=True, kw_only=True)
class Coupling:
    """How a block moves between two touches."""

    # the example rig's; those of another are learnt from groups of known material by maximum likelihood
    found: float = 0.75  # share a of the first touch's drop that the next one finds
    loss: float = 100.0  # U, to the room, per contact face [W m^-2 K^-1]
    sd: float = 0.36  # s, what the two leave open [K]
    ln_h_sd: float = 0.12  # scatter of ln h from touch to touch of one block
    longest_rest: float = REST  # that it was learnt from [s]; what a block does in a longer one is a guess

    def __post_init__(self) -> None:
        if not (0 <= self.found <= 2 and self.loss >= 0 and self.sd > 0 and self.ln_h_sd > 0):
            raise ValueError(f"need 0 <= found <= 2, loss >= 0, sd > 0, ln_h_sd > 0, got {self}")

    def touch_sd(self, distance: Array) -> Array:
        """Return the error of a temperature that a touch finds at a distance from the skin, beyond its noise
        [K]."""
        # two touches show the sum of the block's own AR(1) drift, of variance s^2 / 2 here, and of their
        # errors, s^2 / 4 each, which are not identifiable apart
        far_sd = BLOCK.far_sd * np.sqrt(np.maximum(np.square(distance) - BLOCK.far_K**2, 0.0))
        return np.asarray(np.hypot(0.5 * self.sd, far_sd))

    def to_dict(self) -> dict[str, float]:
        """Return the numbers by name, without a longest rest that is not known."""
        return {name: value for name, value in asdict(self).items() if np.isfinite(value)}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], *, file: str | Path = "coupling") -> Coupling:
        """Return what :meth:`to_dict` described; a wrong entry is a :class:`UserError`."""
        with reading("is not a whole coupling of touches", file=file, hint="train again"):
            numbers = {"longest_rest": np.inf} | dict(content)  # which earlier files do not say
            return cls(**{name: number_within(numbers, name, *ends) for name, ends in _FILE_RANGES.items()})

    def save(self, path: str | Path) -> Path:
        """Write the coupling as JSON and return the path."""
        return write_json(path, self.to_dict(), schema=_COUPLING_SCHEMA, version=_COUPLING_VERSION)

    @classmethod
    def load(cls, path: str | Path) -> Coupling:
        """Return the coupling of a file."""
        return cls.from_dict(read_json(path, _COUPLING_SCHEMA, _COUPLING_VERSION), file=path)


@dataclass(frozen=True, kw_only=True)
class Traces:
    """What ``n`` touches leave in their blocks, under m hypotheses."""

    # (m, n_mode), each mode's drop of the face at the end of a touch, per degree of initial difference
    moved: Array
    decay: Array  # (m, n_mode), its rate [1/s]
    capacity: Array  # (m,), C [J m^-2 K^-1]
    skin: Array  # (n,), the gripper's temperature in the touch [degC]
    room: Array  # (n,), the room's, NaN where unknown [degC]
    rest: Array  # (n,), time since the touch before [s]

    def law(self, rest: float) -> Array:
        """Return which share of the way to the room is uncertain under each hypothesis, (m,)."""
        # One time constant is not the law of a slab, least of one that has not become even since: of the way
        # that the block went towards the room a sixth is uncertain in metals, two fifths in wood.
        slowest = np.where(self.decay > 0, self.decay, np.inf).min(axis=1)
        return np.asarray(BLOCK.law_sd + BLOCK.uneven_sd * np.exp(-slowest * rest))

    def drop(self, rest: float) -> Array:
        """Return rho of each hypothesis after a rest [s], (m,)."""
        # in a metal the heat that left over the heat capacity, since its temperature is even after seconds;
        # in wood more than that, since the heat is still near the face
        return np.asarray((self.moved * np.exp(-self.decay * (rest + BLOCK.into_s))).sum(axis=1))


def traces_of(gripper: GripperModel, data: Touches, rest: Array, hypotheses: Hypotheses) -> Traces:
    """Return what the touches leave in their blocks; ``rest`` (n,) [s] is NaN where unknown."""
    from thermogrip.sysid.contact.time_stepping import slabs

    capacity = np.exp(hypotheses.ln_rho_c) * gripper.block_length * gripper.depth_share
    effusivity = np.exp(hypotheses.ln_e)
    nodes = time_nodes(data.end)
    flux = step_response(
        gripper.stack, nodes, effusivity=effusivity, capacity=capacity, h_c=np.exp(hypotheses.ln_h)
    ).flux
    inside = nodes.t <= data.end
    t, q = nodes.t[inside], flux[:, inside]
    lam, weight, _ = slabs(effusivity, capacity, 0.0)
    # the face that is touched again finds, per degree of initial difference and by the flux q of this touch,
    # rho = sum_j w_j int_0^t1 q(tau) exp(-lam_j (t1 + rest - tau)) d tau of the block's modes (lam_j, w_j)
    history = np.exp(-lam[:, :, None] * (data.end - t)) * q[:, None, :]
    return Traces(
        moved=weight * np.trapezoid(history, t, axis=2),
        decay=lam,
        capacity=capacity,
        skin=data.level,
        room=data.t_ambient,
        rest=np.where(np.isfinite(rest), rest, REST),
    )


def joint_prior(
    coupling: Coupling,
    traces: Traces,
    rows: NDArray[np.int64],
    one: tuple[Array, Array],
    shared: tuple[Array, Array, Array],
    about: Array | None = None,
) -> tuple[Array, Array]:
    """Return mean (m, 4 n) and covariance (m, 4 n, 4 n) of the x of n touches of one block that is found at
    ``about`` (m, n) [degC]; None: nothing of its way to the room is uncertain."""
    mean, variance = one
    n, m = rows.size, variance.size
    mu, p = np.repeat(mean[:, None, :], n, axis=1), np.zeros((m, n, 4, n, 4))
    p[:, :, 1, :, 1] = shared[0][:, None, None]
    p[:, :, 2, :, 2] = shared[1][:, None, None]
    p[:, :, 3, :, 3] = shared[2][:, None, None]
    touch = np.arange(n)
    p[:, touch, 1, touch, 1] += coupling.ln_h_sd**2
    p[:, 0, 0, 0, 0] = variance
    for k in range(1, n):
        before, rest_s = int(rows[k - 1]), float(traces.rest[rows[k]])
        # a share of the drop is left to find: a block stores heat beside the part that a touch sees, and may
        # be touched at another face
        drop = coupling.found * traces.drop(rest_s)
        skin, room = traces.skin[before], traces.room[before]
        stay = np.exp(-coupling.loss * rest_s / traces.capacity) if np.isfinite(room) else 1.0
        gain = stay * (1 - drop)
        offset = stay * drop * skin + (1 - stay) * np.nan_to_num(room)
        way_sd = np.zeros(m)
        if about is not None:
            t_object = about[:, k - 1]
            to_room = gain * t_object + offset - (t_object - drop * (t_object - skin))
            way_sd = traces.law(rest_s) * to_room
        mu[:, k, 0] = gain * mu[:, k - 1, 0] + offset
        for j in range(k):
            p[:, j, 0, k, 0] = p[:, k, 0, j, 0] = gain * p[:, j, 0, k - 1, 0]
        p[:, k, 0, k, 0] = gain**2 * p[:, k - 1, 0, k - 1, 0] + coupling.sd**2 + way_sd**2
    return mu.reshape(m, 4 * n), p.reshape(m, 4 * n, 4 * n)


SHARED = (T_OBJECT, H, EFFUSIVITY, CAPACITY)
N_SHARED = len(SHARED)


class Factor(NamedTuple):
    """Likelihoods of x = (T_obj, ln h, ln e, ln C), a row a (touch, hypothesis) pair."""

    log_size: Array  # (n,), ln c
    centre: Array  # (n, 4), x0
    eta: Array  # (n, 4)
    precision: Array  # (n, 4, 4), Lambda, zero in what is known under the hypothesis

    def take(self, index: NDArray[np.int64]) -> Factor:
        """Return the rows of an index of any shape, which becomes the leading shape of each field."""
        return Factor(*(field[index] for field in self))


class Joint(NamedTuple):
    """Evidence and posterior of all x."""

    log_evidence: Array  # (...,)
    mean: Array  # (..., k)
    covariance: Array  # (..., k, k)


def factor_of(mode: Mode, prior: Prior) -> Factor:
    """Return what the data alone say of x: the posterior at the mode with its prior divided out."""
    shared = list(SHARED)
    sd = np.where(prior.sd[:, shared] > 0, prior.sd[:, shared], 1.0)
    vary = prior.sd[:, shared] > 0
    scaled = mode.covariance[:, shared][:, :, shared] / (sd[:, :, None] * sd[:, None, :])
    scaled += np.eye(N_SHARED) * ~vary[:, :, None]
    whole = np.linalg.inv(scaled)
    w = np.where(vary, (mode.u[:, shared] - prior.mean[:, shared]) / sd, 0.0)
    eta = np.einsum("nij,nj->ni", whole, w)
    size = mode.log_evidence + 0.5 * np.linalg.slogdet(whole)[1] - 0.5 * (eta * w).sum(axis=1)
    precision = (whole - np.eye(N_SHARED)) / (sd[:, :, None] * sd[:, None, :])
    return Factor(size, prior.mean[:, shared], eta / sd, precision)


def combine(factor: Factor, mean: Array, covariance: Array) -> Joint:
    """Return evidence and posterior of touches whose x have a joint prior (..., 4 n), (..., 4 n, 4 n)."""
    lead, n = factor.log_size.shape[:-1], factor.log_size.shape[-1]
    k = n * N_SHARED
    lam = np.zeros((*lead, k, k))
    for i in range(n):
        columns = slice(i * N_SHARED, (i + 1) * N_SHARED)
        lam[..., columns, columns] = factor.precision[..., i, :, :]
    # a Gaussian prior N(mu, P) of all x, stacked, has its evidence in closed form, P singular or not:
    eta = factor.eta.reshape(*lead, k)
    away = mean - factor.centre.reshape(*lead, k)
    pulled = np.einsum("...ij,...j->...i", lam, away)
    matrix = np.eye(k) + covariance @ lam
    posterior = np.linalg.solve(matrix, np.broadcast_to(covariance, matrix.shape))
    # g = eta - Lambda (mu - x0)
    g = eta - pulled
    move = np.einsum("...ij,...j->...i", posterior, g)
    # ln Z = sum ln c + (eta - Lambda (mu - x0) / 2)' (mu - x0)
    #        + g' (I + P Lambda)^-1 P g / 2 - ln det(I + P Lambda) / 2
    evidence = factor.log_size.sum(axis=-1) + ((eta - 0.5 * pulled) * away).sum(axis=-1)
    evidence = evidence + 0.5 * (g * move).sum(axis=-1) - 0.5 * np.linalg.slogdet(matrix)[1]
    return Joint(np.asarray(evidence), mean + move, np.asarray(posterior, dtype=float))


Rows = NDArray[np.int64]

# sd of the logarithms of found, loss, sd, ln_h_sd: the last two come out too small on the touches that
# the blocks were learnt from too, so these lean more on where they start
_LEAN = np.array([0.5, 1.0, 0.2, 0.2])


@dataclass(frozen=True)
class TouchGroups:
    """``n`` blocks that were touched once or more, and m candidates."""

    groups: tuple[str, ...]  # (n,), names
    rows: tuple[Rows, ...]  # (n,), the touches of each in their order
    log_evidence: Array  # (n, m)
    t_object: Array  # (n, m), the block's temperature at the first touch under each candidate [degC]
    t_object_sd: Array  # (n, m) [K]


def touch_groups(grasps: Grasps) -> dict[str, Rows]:
    """Return the rows of each ``touch_group``, in the order of ``touch`` where the record has it."""
    label = label_values(grasps, "touch_group")
    names = list(dict.fromkeys(label[label != ""].tolist()))
    if not names:
        raise UserError(
            "no touch_group", file=log_name(grasps), hint="give touches of one block the same touch_group"
        )
    order = number_values(grasps, "touch")
    rows = {name: np.flatnonzero(label == name) for name in names}
    return {
        name: group_rows[np.argsort(order[group_rows], kind="stable")] for name, group_rows in rows.items()
    }


def rested_long(grasps: Grasps, coupling: Coupling | None = None) -> Mask:
    """Return which grasps, (n,), are of blocks that rested much longer than the coupling was learnt from,
    which says nothing of the law: wood's face is at the room's temperature long before its middle."""
    label = label_values(grasps, "touch_group")
    if (label == "").all():
        return np.zeros(grasps.sizes["grasp"], dtype=bool)
    most = BLOCK.longer_rest * (coupling or Coupling()).longest_rest
    return np.isin(label, [name for name, rest_s in _longest_rests(grasps).items() if rest_s > most])


def _longest_rests(grasps: Grasps) -> dict[str, float]:
    """Return the longest rest between touches of each group [s], 0 for a single touch."""
    rest_s = number_values(grasps, "rest")
    rest_s = np.where(np.isfinite(rest_s), rest_s, REST)
    return {
        name: float(rest_s[group_rows[1:]].max(initial=0.0))
        for name, group_rows in touch_groups(grasps).items()
    }


def two_touch_fit(
    gripper: GripperModel,
    grasps: Grasps,
    candidates: Sequence[str | Material],
    *,
    coupling: Coupling | None = None,
    until: float | None = None,
) -> TouchGroups:
    """Return the evidence of each candidate from all touches, any number, of each ``touch_group``; the
    nominal temperature of the first alone counts, for the later ones it is what the touches before left."""
    rows = touch_groups(grasps)
    groups = list(rows.values())
    hypotheses = material_hypotheses(gripper, candidates)
    view = _view(gripper, grasps, hypotheses, coupling or Coupling(), until)
    by_loss = _fits(view, groups)
    log_prior = _loss_priors([logsumexp(fit.log_evidence, axis=1) for fit in by_loss])
    fits = [_over_losses(fit, prior) for fit, prior in zip(by_loss, log_prior)]
    t_object = np.array([fit.mean[:, 0] for fit in fits])
    skin = np.array([view.data.level[group_rows[0]] for group_rows in groups])
    variance = np.array([fit.covariance[:, 0, 0] for fit in fits])
    sd = np.sqrt(variance + view.coupling.touch_sd(t_object - skin[:, None]) ** 2)
    evidence = np.array([fit.log_evidence for fit in fits])
    return TouchGroups(tuple(rows), tuple(groups), evidence, t_object, sd)


def free_touch_fit(
    gripper: GripperModel, grasps: Grasps, *, coupling: Coupling | None = None, until: float | None = None
) -> dict[str, list[posterior_grid.GridPosterior]]:
    """Return the posterior of a free effusivity from all touches of each group, one entry a touch, which
    share ln e and differ in temperature and contact conductance; prior and grid are those of
    :func:`~thermogrip.sysid.effusivity.posterior_grid.grid_posteriors`."""
    rows = touch_groups(grasps)
    used = coupling or Coupling()
    data = touches(grasps, until=until)
    whitener, rest_s = whiten(data, gripper.reading_noise), number_values(grasps, "rest")

    def by_loss(group_rows: Rows, x: Array) -> Joint:
        hypotheses = free_hypotheses(gripper, x)
        traces = traces_of(gripper, data, rest_s, hypotheses)
        return _fits(_View(gripper, data, whitener, hypotheses, traces, used), [group_rows])[0]

    grids = [_on_a_grid(partial(by_loss, group_rows)) for group_rows in rows.values()]
    log_prior = _loss_priors([logsumexp(fit.log_evidence, axis=1, b=np.gradient(x)) for x, fit in grids])
    return {
        name: _touch_posteriors(x, _over_losses(fit, prior), used, data.level[group_rows])
        for (name, group_rows), (x, fit), prior in zip(rows.items(), grids, log_prior)
    }


def _on_a_grid(by_loss: Callable[[Array], Joint]) -> tuple[Array, Joint]:
    """Return effusivities ln e, denser where they are likely, and the fits (n_loss, n_x) there."""
    x = np.linspace(*posterior_grid.LN_E_RANGE, posterior_grid.GRID.coarse_points)
    fit = by_loss(x)
    for widen, n_point in posterior_grid.REFINEMENTS:
        log_density = _over_losses(fit, BLOCK.log_loss_prior()).log_evidence
        more = posterior_grid.refined(x, log_density, widen, n_point)
        order = np.argsort(np.concatenate([x, more]))
        x = np.concatenate([x, more])[order]
        fit = Joint(*(np.concatenate(pair, axis=1)[:, order] for pair in zip(fit, by_loss(more))))
    return x, fit


def _touch_posteriors(
    x: Array, fit: Joint, coupling: Coupling, skin: Array
) -> list[posterior_grid.GridPosterior]:
    """Return the posterior of each touch of a block from its fits at effusivities x."""
    variance = np.diagonal(fit.covariance, axis1=1, axis2=2)[:, ::N_SHARED]
    t_object, ln_h = fit.mean[:, ::N_SHARED], fit.mean[:, 1::N_SHARED]
    sd = np.hypot(np.sqrt(variance), coupling.touch_sd(t_object - skin))
    return [
        posterior_grid.posterior_of(x, fit.log_evidence, t_object[:, k], sd[:, k], ln_h[:, k])
        for k in range(skin.size)
    ]


def learn_coupling(gripper: GripperModel, grasps: Grasps, *, start: Coupling | None = None) -> Coupling:
    """Return the coupling that makes labelled groups likeliest."""
    from scipy.optimize import minimize

    centre = start or Coupling()
    groups = [
        (factor, view, group_rows)
        for view, rows in _own_views(gripper, grasps, centre)
        for factor, group_rows in zip(_group_factors(view, rows), rows)
    ]
    longest = max(_longest_rests(grasps).values())
    if start is not None:
        longest = max(longest, start.longest_rest)
    first = np.log([max(centre.found, 0.05), max(centre.loss, 1.0), centre.sd, centre.ln_h_sd])

    def coupling(q: Array) -> Coupling:
        found_share, loss, sd, ln_h_sd = np.exp(np.clip(q, first - 3, first + 3))
        return Coupling(
            found=min(float(found_share), 2.0),
            loss=float(loss),
            sd=float(sd),
            ln_h_sd=float(ln_h_sd),
            longest_rest=longest,
        )

    def cost(q: Array) -> float:
        now = coupling(q)
        fits = (
            combine(f, *_prior(view, group_rows, now, f)).log_evidence[0] for f, view, group_rows in groups
        )
        return float(0.5 * (((q - first) / _LEAN) ** 2).sum() - sum(fits))

    return coupling(np.asarray(minimize(cost, first, method="Nelder-Mead", options={"xatol": 0.01}).x))


def next_touch_prior(
    gripper: GripperModel,
    grasps: Grasps,
    candidates: Sequence[str | Material],
    *,
    coupling: Coupling | None = None,
    rest: float = 60.0,
) -> Joint:
    """Return the log evidence (m,) from the touches of one block, and the prior mean (m, 4) and covariance
    (m, 4, 4) of another touch's x = (T_obj, ln h, ln e, ln C) after a ``rest`` [s]."""
    block_rows = np.array([0])
    if grasps.sizes["grasp"] > 1:
        block_rows, *others = touch_groups(grasps).values()
        if others or block_rows.size != grasps.sizes["grasp"]:
            hint = "give those of one block"
            raise UserError("touches of several blocks", file=log_name(grasps), hint=hint)
    view = _view(gripper, grasps, material_hypotheses(gripper, candidates), coupling or Coupling())
    factor = _group_factors(view, [block_rows])[0]
    if block_rows.size > 1:
        factor = _group_factors(view, [block_rows], _cavities(view, [block_rows], [factor]))[0]
    # the touch to come: a flat factor, in a row of its own
    m, new = view.hypotheses.ln_h.size, int(view.traces.rest.size)
    silent = Factor(*(np.concatenate([f, np.zeros((m, 1, *f.shape[2:]))], axis=1) for f in factor))
    silent.centre[:, -1] = factor.centre[:, -1]
    before = view.traces
    skin, room = np.append(before.skin, np.nan), np.append(before.room, np.nan)
    traces = replace(before, skin=skin, room=room, rest=np.append(before.rest, rest))
    by_loss = _by_loss(view._replace(traces=traces), np.append(block_rows, new), silent)
    joint = _over_losses(by_loss, BLOCK.log_loss_prior())
    last = slice(-N_SHARED, None)
    return Joint(joint.log_evidence, joint.mean[:, last], joint.covariance[:, last, last])


class _View(NamedTuple):
    """Touches of a record, hypotheses about their blocks, and what they leave in them."""

    gripper: GripperModel
    data: Touches
    whitener: tuple[Array, Array]
    hypotheses: Hypotheses
    traces: Traces
    coupling: Coupling


def _view(
    gripper: GripperModel, grasps: Grasps, one: Hypotheses, coupling: Coupling, until: float | None = None
) -> _View:
    data = touches(grasps, until=until)
    traces = traces_of(gripper, data, number_values(grasps, "rest"), one)
    return _View(gripper, data, whiten(data, gripper.reading_noise), one, traces, coupling)


def _own_views(gripper: GripperModel, grasps: Grasps, coupling: Coupling) -> list[tuple[_View, list[Rows]]]:
    """Return the groups of each material, with that material as the one hypothesis."""
    if "material" not in grasps:
        raise UserError("no material", file=log_name(grasps), hint="label the groups")
    label = grasps["material"].values.astype(str)
    groups = list(touch_groups(grasps).values())
    return [
        (_view(gripper, grasps, material_hypotheses(gripper, [name]), coupling), of_material)
        for name in dict.fromkeys(label[group_rows[0]] for group_rows in groups)
        if (of_material := [group_rows for group_rows in groups if label[group_rows[0]] == name])
    ]


def _group_factors(
    view: _View, groups: list[Rows], found: list[tuple[Array, Array]] | None = None
) -> list[Factor]:
    """Return a factor of leading shape (m, n) a group; ``found``, (m, n) each, replaces T's prior."""
    m = view.hypotheses.ln_h.size
    # group after group, hypothesis after hypothesis, touch after touch
    row = np.concatenate([np.tile(group_rows, m) for group_rows in groups])
    which = np.concatenate([np.repeat(np.arange(m), group_rows.size) for group_rows in groups])
    hypotheses = Hypotheses(*(h[which] for h in view.hypotheses))
    prior = prior_of(view.gripper, view.data.take(row), hypotheses)
    if found is not None:
        prior.mean[:, T_OBJECT] = np.concatenate([mean.ravel() for mean, _ in found])
        prior.sd[:, T_OBJECT] = np.concatenate([sd.ravel() for _, sd in found])
    beyond = view.gripper.beyond(view.data.t[row], prior.mean[:, EFFUSIVITY])
    mode = find_modes(
        view.gripper.stack, view.data, row, view.whitener, Prior(prior.mean, prior.sd), beyond=beyond
    )
    whole = factor_of(with_second(view.gripper, view.data, row, hypotheses, mode), prior)
    # away from a mode there is nothing to expand: such a hypothesis keeps its (hopeless) value everywhere
    lost = ~mode.converged
    whole.log_size[lost], whole.eta[lost], whole.precision[lost] = mode.log_evidence[lost], 0.0, 0.0
    ends = np.cumsum([0, *(m * group_rows.size for group_rows in groups)])
    return [whole.take(np.arange(a, b).reshape(m, -1)) for a, b in pairwise(ends.tolist())]


def _prior(view: _View, at: Rows, coupling: Coupling, factor: Factor) -> tuple[Array, Array]:
    """Return the joint prior of the x of a group's touches, how far the block went between them as in a first
    answer, in which none of the way is uncertain."""
    one = view.hypotheses
    m = one.ln_h.size
    touched = prior_of(view.gripper, view.data.take(np.repeat(at[:1], m)), one)
    block = np.maximum(one.ln_h_sd**2 - view.gripper.spreads.ln_h**2, 0.0)
    first = touched.mean[:, list(SHARED)], touched.sd[:, T_OBJECT] ** 2
    shared = (block, one.ln_e_sd**2, one.ln_rho_c_sd**2)
    sure = combine(factor, *joint_prior(coupling, view.traces, at, first, shared))
    return joint_prior(coupling, view.traces, at, first, shared, sure.mean[:, ::N_SHARED])


def _cavities(view: _View, groups: list[Rows], factors: list[Factor]) -> list[tuple[Array, Array]]:
    """Return mean and sd (m, n) of each touch's block temperature by the other touches alone, or the prior's
    where that contradicts the touch itself."""
    cavities = []
    for group_rows, factor in zip(groups, factors):
        prior = _prior(view, group_rows, view.coupling, factor)
        mean, sd = np.empty(factor.log_size.shape), np.empty(factor.log_size.shape)
        for k in range(group_rows.size):
            mean[:, k], sd[:, k] = _t_object(combine(_without(factor, [k]), *prior), k)
            others = [j for j in range(group_rows.size) if j != k]
            own_mean, own_sd = _t_object(combine(_without(factor, others), *prior), k)
            apart = np.abs(mean[:, k] - own_mean) > BLOCK.contradiction_sd * np.hypot(sd[:, k], own_sd)
            # such a hypothesis is hopeless, and an expansion there would reach too far
            mean[apart, k], sd[apart, k] = factor.centre[apart, k, 0], UNKNOWN_OBJECT_SD
        cavities.append((mean, sd))
    return cavities


def _without(factor: Factor, touches_left_out: Sequence[int]) -> Factor:
    """Return the factors with some touches silent."""
    silent = Factor(*(np.array(field) for field in factor))
    silent.eta[:, touches_left_out], silent.precision[:, touches_left_out] = 0.0, 0.0
    return silent


def _t_object(joint: Joint, k: int) -> tuple[Array, Array]:
    """Return mean and sd (m,) of the block's temperature at touch k."""
    column = N_SHARED * k
    return joint.mean[:, column], np.sqrt(joint.covariance[:, column, column])


def _fits(view: _View, groups: list[Rows]) -> list[Joint]:
    """Return what :func:`_by_loss` does of each group, factors expanded around what the other touches say."""
    # expanded twice: a wide prior leaves wood's temperature open by many degrees, too far for one expansion
    factors = _group_factors(view, groups, _cavities(view, groups, _group_factors(view, groups)))
    return [_by_loss(view, group_rows, factor) for group_rows, factor in zip(groups, factors)]


def _by_loss(view: _View, at: Rows, factor: Factor) -> Joint:
    """Return evidence and posterior of one group at each loss, of leading shape (n_loss, m)."""
    # blocks of another shape or in another place lose k times as much: k is a nuisance of the record
    fits = []
    for ln_loss in BLOCK.ln_loss:
        losing = replace(view.coupling, loss=view.coupling.loss * float(np.exp(ln_loss)))
        # what it loses during a touch is little beside what it loses between two: one factor serves all
        fits.append(combine(factor, *_prior(view, at, losing, factor)))
    return Joint(*map(np.stack, zip(*fits)))


def _loss_priors(evidence: Sequence[Array]) -> Array:
    """Return the log probability of each loss for each group, (n, n_loss), by the evidence of the record's
    other groups."""
    # p(k | others) ~ p_k prod_{j != i} [0.9 Z_jk + 0.1 max_l Z_jl]: each group decides no more than a factor
    # of ten, as it may be of no candidate
    by_loss = np.array(evidence)
    some = np.log1p(-BLOCK.no_candidate) + by_loss
    says = np.logaddexp(some, np.log(BLOCK.no_candidate) + by_loss.max(axis=1, keepdims=True))
    by_others = BLOCK.log_loss_prior() + says.sum(axis=0) - says
    return np.asarray(by_others - logsumexp(by_others, axis=1, keepdims=True))


def _over_losses(fit: Joint, log_prior: Array) -> Joint:
    """Return evidence and the first two moments of the posterior with the loss (n_loss,) integrated out."""
    log_z = log_prior[:, None] + fit.log_evidence
    log_evidence = logsumexp(log_z, axis=0)
    share = np.exp(log_z - log_evidence)[:, :, None]
    mean = (share * fit.mean).sum(axis=0)
    off = fit.mean - mean
    within = fit.covariance + off[..., :, None] * off[..., None, :]
    return Joint(np.asarray(log_evidence), mean, (share[..., None] * within).sum(axis=0))
