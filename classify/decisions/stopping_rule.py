"""A stopping rule for contacts with a stated error, learnt from training grasps.

At a time t of the contact the classifier has probabilities p from the readings so far.  The contact ends
early when the answer is **confident**, max p >= c.  The threshold comes from training grasps, each followed
through growing windows: it is the least one at which the grasps that stop for it are wrong no more often than
stated.

**Sample by sample.**  A :class:`Stream` holds what a robot loop needs during one contact.  Each sample costs
milliseconds, since every candidate's mode starts from the one of the sample before; :meth:`Stream.result`
gives the same answer as the batch call on the finished grasp.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.classify.decisions.next_touch import with_model
from thermogrip.classify.estimators.base import (
    Floats,
    GraspClassifier,
    Records,
    grasp_labels,
    normalised,
    pick,
    record_list,
)
from thermogrip.classify.estimators.registry import load_classifier
from thermogrip.datasets.errors import UserError, reading
from thermogrip.datasets.files import read_json, write_json
from thermogrip.datasets.limits import LARGEST, array_within, number_within
from thermogrip.datasets.schema import HOTTEST, log_name, make_grasps
from thermogrip.sysid.effusivity.posterior import material_fit
from thermogrip.sysid.effusivity.quality import GraspQuality, check_grasps

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps

# a rule is for the times at which it was learnt, close together at first: evaluating it more often stops
# earlier and errs more
TIMES = (0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)
RULE_FILE = "stop_rule.json"  # beside classifier.json
_CONTACT_END_S = 0.25  # s: readings until then may be of before contact

_RULE_SCHEMA, _RULE_VERSION = "thermogrip.stop_rule", 1
_RANGES = {"sure": (0.0, 1.0), "end": (0.0, 3600.0), "error": (0.0, 1.0)}  # of a file
_SURE = np.concatenate([np.arange(0.5, 0.95, 0.05), 1 - np.geomspace(0.05, 1e-4, 28)])


@dataclass(frozen=True, kw_only=True)
class StopRule:
    """When to end a contact."""

    sure: float  # stop where the likeliest candidate has this probability
    times: tuple[float, ...] = TIMES  # when it is evaluated [s after the closed message]
    end: float = 10.0  # when contact ends anyway [s]
    error: float = 0.05  # stated share of wrong answers among contacts that it ended as confident
    n_grasp: int = 0  # training grasps that it was learnt from

    def __post_init__(self) -> None:
        ahead = all(t > 0 for t in self.times) and self.end > 0
        if not (0 < self.sure <= 1 and 0 < self.error < 1 and ahead):
            raise ValueError(f"need 0 < sure <= 1, 0 < error < 1, times and end > 0, got {self}")

    def save(self, path: str | Path) -> Path:
        """Write the rule as JSON and return the path."""
        return write_json(
            path, asdict(self) | {"times": list(self.times)}, schema=_RULE_SCHEMA, version=_RULE_VERSION
        )

    @classmethod
    def load(cls, path: str | Path) -> StopRule:
        """Return the rule of a file; a wrong entry is a :class:`UserError`."""
        content = read_json(path, _RULE_SCHEMA, _RULE_VERSION)
        with reading("is not a whole stop rule", file=path, hint="train again"):
            numbers = {name: number_within(content, name, *ends) for name, ends in _RANGES.items()}
            times = array_within(content, "times", _RANGES["end"][1]).ravel().tolist()
            n_grasp = int(number_within(content, "n_grasp", 0, LARGEST))
            return cls(times=tuple(times), n_grasp=n_grasp, **numbers)


def load_stop_rule(folder: str | Path) -> StopRule:
    """Return the rule beside a classifier.

    Parameters
    ----------
    folder : str or Path
        Of the classifier.

    Raises
    ------
    UserError
        If the classifier was trained without one.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = StopRule(sure=0.97, end=8.0).save(Path(folder) / RULE_FILE)
    ...     print(load_stop_rule(folder).end)
    8.0
    """
    file = Path(folder) / RULE_FILE
    if not file.exists():
        raise UserError("has no stop rule", file=folder, hint="train it with --stop-error, e.g. 0.05")
    return StopRule.load(file)


class Windows(NamedTuple):
    """``n`` grasps at n_t times and at the end."""

    times: Floats  # (n_t + 1,) [s]
    log_p: Floats  # (n, n_t + 1, m)


class Stops(NamedTuple):
    """Where a rule ends n contacts."""

    time: Floats  # (n,) [s]
    answer: NDArray[np.int64]  # (n,) place of the likeliest candidate then
    early: NDArray[np.bool_]  # (n,) whether it is before the end
    p_wrong: Floats  # (n,) probability that the answer is wrong


def growing_windows(
    classifier: GraspClassifier,
    grasps: Grasps,
    *,
    candidates: Sequence[str] | None = None,
    times: Sequence[float] = TIMES,
    end: float = 10.0,
) -> Windows:
    """Return the probabilities at those ``times`` before ``end`` [s] and at the end, from the readings until
    then."""
    model = with_model(classifier)
    names = model.asked(candidates)
    window_ends = np.array([*(t for t in sorted(times) if t < end), end])
    odds, log_p = model.log_prior(names), []
    time = np.asarray(grasps["time"].values, dtype=float)
    start: Floats | None = None
    for t in window_ends:
        in_contact = (time > _CONTACT_END_S) & (time <= t + 1e-9)
        read = np.isfinite(grasps["t_surface"].values[:, in_contact]).any(axis=1)
        read |= t >= end  # where none comes the fit refuses the grasp
        # before a first reading those of the prior
        log_p.append(normalised(np.tile(odds, (read.size, 1))))
        if read.any():
            begun = grasps if read.all() else pick(grasps, read)
            fit = material_fit(model.device_, begun, names, until=float(t), start=start)
            log_p[-1][read] = normalised(fit.log_evidence + odds)
            start = fit.u if read.all() else None
    return Windows(window_ends, np.stack(log_p, axis=1))


def silent_windows(grasps: Grasps, times: ArrayLike) -> NDArray[np.bool_]:
    """Return at which times each contact is too short for a decision, shape (n, n_time)."""
    windows = [grasps.sel(time=slice(None, float(t) + 1e-9)) for t in np.asarray(times, dtype=float)]
    return np.stack([check_grasps(window).undecided for window in windows], axis=1)


def stops(rule: StopRule, windows: Windows, silent: NDArray[np.bool_] | None = None) -> Stops:
    """Return where the rule ends each contact; not where it is ``silent`` (n, n_t + 1), unless at the end."""
    now = (np.exp(windows.log_p.max(axis=2)) >= rule.sure) & (True if silent is None else ~silent)
    now[:, -1] = True
    first = now.argmax(axis=1)
    grasp = np.arange(first.size)
    return Stops(
        windows.times[first],
        windows.log_p[grasp, first].argmax(axis=1),
        first < windows.times.size - 1,
        -np.expm1(np.minimum(windows.log_p[grasp, first].max(axis=1), 0.0)),
    )


def learn_stop_rule(
    classifier: GraspClassifier,
    X: Records,
    *,
    error: float = 0.05,
    times: Sequence[float] = TIMES,
    end: float = 10.0,
    progress: Callable[[float, str], None] | None = None,
) -> StopRule:
    """Return the rule under which training grasps stop earliest at the stated error.

    ``error`` is the share of wrong answers among the contacts that stop early; UserError where so few grasps
    cannot show so small an error.
    """
    if not 0 < error < 1:
        raise UserError(f"error {error:g} is no share", hint="give a number between 0 and 1")
    windows_of = []
    records = record_list(X)
    for k, record in enumerate(records):
        if progress is not None:
            progress(k / len(records), f"windows of {log_name(record)}")
        labels = grasp_labels(record)
        names = sorted(set(labels.tolist()))
        if len(names) < 2:
            continue
        windows = growing_windows(
            classifier, record, candidates=names, times=times, end=contact_end(record, end)
        )
        windows_of.append((windows, np.array([names.index(label) for label in labels])))
    return learn_from_windows(windows_of, error=error, times=times, end=end)


def learn_from_windows(
    parts: Sequence[tuple[Windows, NDArray[np.int64]]],
    *,
    error: float = 0.05,
    times: Sequence[float] = TIMES,
    end: float = 10.0,
) -> StopRule:
    """Return what :func:`learn_stop_rule` does, from windows and true candidates (n,) of each record."""
    n = sum(true.size for _, true in parts)
    if n < 1 or 1 / (n + 2) > error:
        raise UserError(
            f"{n} training grasps cannot show an error of {error:g}",
            hint=f"give more, or state at least {1 / (n + 2):.2g}",
        )
    best = StopRule(sure=1.0, times=tuple(times), end=end, error=error, n_grasp=n)
    for sure in _SURE[::-1]:
        rule = replace(best, sure=float(sure))
        ended = [(stops(rule, windows), true) for windows, true in parts]
        wrong = np.concatenate([(stopped.answer != true)[stopped.early] for stopped, true in ended])
        p_wrong = np.concatenate([stopped.p_wrong[stopped.early] for stopped, _ in ended])
        # with k of n wrong (k + 1) / (n + 2), the posterior mean of a rate (Laplace's rule of succession)
        if 1 / (wrong.size + 2) > error:
            continue  # so few are that confident: even with none of them wrong they show nothing
        # the classifier itself must expect no more errors: training grasps, which calibrated the gripper, are
        # wrong less often than fresh ones (``docs/records/classification.md``)
        if (wrong.sum() + 1) / (wrong.size + 2) > error or p_wrong.mean() > error:
            break
        best = rule
    return best


def contact_end(grasps: Grasps, end: float) -> float:
    """Return when contact ends: as given, or where the record does."""
    return min(end, float(np.asarray(grasps["time"].values)[-1]))


_SAME_TIME_S = 1e-6  # s


class Stream:
    """Probabilities of the candidates during one contact.

    Parameters
    ----------
    classifier : PosteriorClassifier
        A fitted one, e.g. from :func:`~thermogrip.classify.estimators.registry.load_classifier`; load it
        once.
    candidates : sequence of str, optional
        The materials in question; by default all that the classifier knows.
    t_object, t_object_sd, t_ambient : float, optional
        What is known of the block and the room [degC]; NaN where unknown.
    rule : StopRule, optional
        When to end the contact.

    Attributes
    ----------
    decided_at : float or None
        When the rule ended the contact [s]; None until then.

    Examples
    --------
    >>> from thermogrip.classify.estimators.posterior import PosteriorClassifier
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> from thermogrip.sysid.effusivity.gripper_model import load_default_gripper
    >>> known = PosteriorClassifier().with_device(load_default_gripper())
    >>> grasp = load_example_grasps()["exp2_dT20"].isel(grasp=[21])
    >>> touch = Stream(known, candidates=["copper", "iron", "wood"], t_object=28.0, t_ambient=27.0)
    >>> for time, temperature in zip(grasp["time"].values[:40], grasp["t_surface"].values[0]):
    ...     p = touch.update(float(time), float(temperature))
    >>> {name: round(float(v), 3) for name, v in p.items()}
    {'copper': 0.0, 'iron': 0.0, 'wood': 1.0}
    """

    def __init__(
        self,
        classifier: GraspClassifier,
        *,
        candidates: Sequence[str] | None = None,
        t_object: float = np.nan,
        t_object_sd: float = np.nan,
        t_ambient: float = np.nan,
        rule: StopRule | None = None,
    ) -> None:
        self._model = with_model(classifier)
        self.candidates = tuple(self._model.asked(candidates))
        self._odds = self._model.log_prior(self.candidates)
        self._about = {"t_object": t_object, "t_object_sd": t_object_sd, "t_ambient": t_ambient}
        self._rule = rule
        self._time: list[float] = []
        self._reading: list[float] = []
        self._u: Floats | None = None
        self._evaluated = 0
        self.decided_at: float | None = None
        self.log_p: Floats = normalised(self._odds[None])[0]
        # a made-up contact, so that no sample waits for the compiler
        made_up = make_grasps([-1.0, -0.5, 0.5], [[23.0, 23.0, 23.0]], ["warm"])
        material_fit(self._model.device_, made_up, self.candidates[:1])

    def update(self, time_s: float, t_surface: float) -> dict[str, float]:
        """Take one sample and return the probability of each candidate.

        ``time_s`` [s] since the closed message grows from call to call, from -1 s or before; ``t_surface``
        [degC] is NaN where it was lost.  Probabilities are the prior ones until a quarter of a second after
        the message, NaN for a contact that is not usable (:attr:`nothing_because`), and stay as they are once
        it lasts longer than those of the training.

        Time that does not grow, a reading that is not in degC, or a contact without a reading before it is a
        :class:`UserError`.  That sample is not taken, the next one may follow.
        """
        if not np.isfinite(time_s) or (self._time and not time_s > self._time[-1]):
            after = f" after {self._time[-1]:g} s" if self._time else ""
            raise UserError(f"time {time_s:g} s{after}", hint="give samples in order, each once")
        if abs(t_surface) > HOTTEST:
            raise UserError(f"a reading of {t_surface:g} degC", hint="give degC, and NaN where one was lost")
        before = (y for t, y in zip(self._time, self._reading) if t < -_CONTACT_END_S)
        if time_s > _CONTACT_END_S and not any(map(np.isfinite, before)):
            raise UserError(f"no reading before contact, and now it is {time_s:g} s", hint="start at -1 s")
        self._time.append(float(time_s))
        self._reading.append(float(t_surface))
        if _CONTACT_END_S < time_s <= self._model.longest_ + _SAME_TIME_S and np.isfinite(t_surface):
            self._evaluate()
        return self._answer(self.log_p)

    @property
    def nothing_because(self) -> str:
        """Why the contact is not usable, empty where it is."""
        read = len(self._time) > 1 and np.isfinite(self._reading).any()
        return check_grasps(self.grasps()).reason[0] if read else ""

    @property
    def p_unknown(self) -> float:
        """Probability, by the samples so far, that it is none of the candidates; NaN where the contact is not
        usable.  It takes some tens of milliseconds: ask for it before the answer is acted on."""
        if self.nothing_because or self._u is None:
            return float("nan")
        return float(self._model.p_unknown(self.grasps(), self.candidates)[0])

    def grasps(self) -> Grasps:
        """Return the contact so far as a record of one grasp."""
        about = {name: [value] for name, value in self._about.items()}
        return make_grasps(self._time, [self._reading], ["stream"], name="stream", **about)

    def result(self) -> dict[str, float]:
        """Return the probabilities by the batch call on the contact so far, NaN where it is not usable."""
        if self.nothing_because:
            return dict.fromkeys(self.candidates, np.nan)
        return self._answer(self._model.candidate_log_proba(self.grasps(), self.candidates)[0])

    def _answer(self, log_p: Floats) -> dict[str, float]:
        return dict(zip(self.candidates, np.exp(log_p).tolist()))

    def _evaluate(self) -> None:
        """Take what was read so far for what it is."""
        # What a robot sends is not always a contact.  A reading that leaps by 10 K waits for the next three,
        # which show whether it was a spike; a skin that does not move, or has just saturated, ends no
        # contact; once it has not moved for three seconds, 10 K from its object, no material is there.
        grasp = self.grasps()
        quality = check_grasps(grasp)
        if quality.reason[0]:
            self.log_p = np.full(len(self.candidates), np.nan)
            return
        fit = material_fit(self._model.device_, grasp, self.candidates, start=self._u)
        self._u = fit.u
        self.log_p = normalised(fit.log_evidence + self._odds)[0]
        self._decide(quality)

    def _decide(self, quality: GraspQuality) -> None:
        """Ask the rule, at its own times only."""
        rule, now = self._rule, self._time[-1]
        if rule is None or self.decided_at is not None:
            return
        due = sum(t <= now + _SAME_TIME_S for t in rule.times)
        if due <= self._evaluated:
            return
        self._evaluated = due
        if not quality.undecided[0] and np.exp(self.log_p.max()) >= rule.sure:
            self.decided_at = now


def stop_callback(
    classifier: GraspClassifier,
    rule: StopRule,
    *,
    candidates: Sequence[str] | None = None,
    tell: Callable[[float, Mapping[str, float]], None] | None = None,
) -> Callable[[Grasps], bool]:
    """Return a function of the one grasp so far, its ``t_object`` and ``t_ambient`` and never its
    ``material``, that returns whether the rule ends the contact; a session calls it after each sample
    (``stop`` of :func:`thermogrip.rig.session.session.run_session`) and knows nothing else of classifiers.
    What has to be compiled is compiled before it is returned.
    A grasp that does not begin as the last one did is another one.  ``tell`` hears the probabilities at each
    time [s]."""
    Stream(classifier, candidates=candidates)  # no contact may wait for it
    stream: Stream | None = None

    def stop(grasp: Grasps) -> bool:
        nonlocal stream
        time, reading = grasp["time"].values, grasp["t_surface"].values[0]
        if stream is None or not np.array_equal(
            reading[: len(stream._time)], stream._reading, equal_nan=True
        ):
            temperatures = {
                name: float(grasp[name].values[0])
                for name in ("t_object", "t_object_sd", "t_ambient")
                if name in grasp
            }
            stream = Stream(classifier, candidates=candidates, rule=rule, **temperatures)
        for sample in range(len(stream._time), time.size):
            probabilities = stream.update(float(time[sample]), float(reading[sample]))
            if tell is not None:
                tell(float(time[sample]), probabilities)
        return stream.decided_at is not None

    return stop


def session_stop(
    folder: str | Path,
    *,
    candidates: Sequence[str] | None = None,
    tell: Callable[[float, Mapping[str, float]], None] | None = None,
) -> Callable[[Grasps], bool]:
    """Return :func:`stop_callback` of the classifier and the stop rule in a folder of ``train``."""
    return stop_callback(load_classifier(folder), load_stop_rule(folder), candidates=candidates, tell=tell)
