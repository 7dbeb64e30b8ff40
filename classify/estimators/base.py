r"""What all grasp classifiers share: records in, classes and probabilities out.

A classifier is a scikit-learn estimator whose ``X`` is a Grasps record (or several, which are joined), or an
array or data frame (:mod:`~thermogrip.classify.estimators.arrays`), and whose ``y`` defaults to the record's
``material``.  A subclass writes two methods,

- ``_learn(records, labels)``, or ``_fit(grasps, labels)`` of a :class:`JoinedClassifier`: learn, set
  attributes that end in ``_``, ``classes_`` among them;
- ``_log_proba(grasps)``: log probabilities over ``classes_``, shape (n_grasp, n_class),

and this module adds the checks and the rest.  Candidates are a question put to a fitted classifier: with the
classes restricted to a set :math:`S`, :math:`p_S(m) = p(m) / \sum_{s \in S} p(s)`, taken from logarithms so
that a set of improbable candidates still has an answer.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self, TypeAlias

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.exceptions import NotFittedError

from thermogrip.classify.estimators.arrays import coded, grasps_of
from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.grasp_files import Records as Records
from thermogrip.datasets.grasp_files import as_grasps
from thermogrip.datasets.grasp_record import Grasps
from thermogrip.datasets.schema import (
    GRASP_LABELS,
    GRASP_NUMBERS,
    check_grasps,
    label_values,
    log_name,
    make_grasps,
)
from thermogrip.sysid.effusivity.quality import check_grasps as check_quality

Floats: TypeAlias = NDArray[np.float64]
Labels: TypeAlias = NDArray[np.str_]

_DIVISORS = ("scale_", "sd")  # arrays of files
HELD_AT_AN_END = 0.5  # s; a trace that is shorter than its grid by more is refused, not continued


@dataclass(frozen=True)
class Note:
    """One thing to know of an answer.

    Parameters
    ----------
    code : str
        For programs: ``readings`` (what of them was usable), ``other_touches`` (the answer is theirs),
        ``beyond_training`` (a longer rest, another number of sensors), ``not_explained``.
    words : str
        For people.
    """

    code: str
    words: str


class Answered(NamedTuple):
    """What a classifier says of the ``n`` grasps of a record; NaN and empty where it says nothing."""

    log_p: Floats  # (n, n_candidate)
    p_unknown: Floats  # (n,), that it is none of them
    misfit_sd: Floats  # (n,), of the trace under the likeliest candidate, standardised
    deviates: list[str]  # (n,), what that candidate requires that is unusual
    notes: list[list[Note]]  # (n,)

    @classmethod
    def nothing(cls, n: int, n_candidate: int) -> Answered:
        """Return answers that say nothing."""
        unknown = np.full(n, np.nan)
        return cls(np.zeros((n, n_candidate)), unknown, unknown.copy(), [""] * n, [[] for _ in range(n)])


@dataclass(eq=False, repr=False, kw_only=True)
class _Sampled:
    times: Sequence[float] | None = None  # of an array's samples [s], 0 at contact; None: 0, 0.1, 0.2 ...


class GraspClassifier(_Sampled, ClassifierMixin, BaseEstimator, ABC):  # type: ignore[misc]
    """Base of the classifiers: checks what comes in, derives what scikit-learn expects.

    Parameters
    ----------
    times : sequence of float, optional
        When the samples of an array were taken [s], 0 at contact; by default 0, 0.1, 0.2 ...

    Examples
    --------
    >>> from thermogrip.classify import make_classifier
    >>> from thermogrip.datasets.examples import load_example_grasps
    >>> grasps = load_example_grasps()["exp2_dT20"]
    >>> model = make_classifier("features-lda").fit(grasps)
    >>> model.classes_.tolist(), model.predict_proba(grasps).shape
    (['copper', 'iron', 'wood'], (24, 3))
    """

    learns_from_all_conditions: ClassVar[bool] = False
    """True where the training grasps of every condition describe one gripper together."""

    joins_touches: ClassVar[bool] = False
    """True where all touches of one block already have their common answer."""

    leaves_samples_out: ClassVar[bool] = False
    """True where samples at the end of the sensor's range are left out: whole traces are not needed."""

    reads_both_sensors: ClassVar[bool] = False
    """True where a second sensor, if the training grasps have one, is read too."""

    needs: ClassVar[tuple[str, str] | None] = None
    """Package that training needs beyond a plain install, and the extra of thermogrip that brings it."""

    classes_: Labels
    sensors_: int
    notes_: Sequence[str] = ()
    """In words, what could not be learnt from in the training."""
    longest_: float = np.inf
    """How much of a single touch is read [s], where that is not all."""

    def fit(self, X: Records, y: ArrayLike | None = None) -> Self:
        """Learn from labelled grasps: one record, several, or an array (n, n_time) or (n, n_time, n_channel);
        ``y`` (n_grasp,) are their materials, record after record, by default each record's own."""
        return self._taught(X, y, self._learn)

    def _taught(self, X: Any, y: Any, learn: Callable[[list[Grasps], list[Labels]], None]) -> Self:
        self.check_installed()
        if _are_records(X):
            records = despiked(record_list(X))
            learn(records, record_labels(records, y))
            if not self.reads_both_sensors and any("t_surface_2" in part for part in records):
                self.notes_ = [*self.notes_, "the second sensor is not read"]
            return self
        words, values = (None, None) if y is None else coded(y)
        record = grasps_of(self, X, reset=True, y=words)
        learn(despiked(record_list(record)), [grasp_labels(record, words)])
        if values is not None:
            self.classes_ = values[self.classes_.astype(int)]
        return self

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.allow_nan = tags.input_tags.three_d_array = True
        return tags

    @abstractmethod
    def _learn(self, records: list[Grasps], labels: list[Labels]) -> None:
        """Learn from records and the materials of each; set attributes that end in ``_``."""

    def _records(self, X: Any) -> list[Grasps]:
        """Return what is to be classified as records."""
        self._check_fitted()
        return despiked(record_list(X if _are_records(X) else grasps_of(self, X, reset=False)))

    def check_installed(self) -> None:
        """Raise :class:`UserError` where training needs a package that is not installed."""
        if self.needs is not None and find_spec(self.needs[0]) is None:
            package, extra = self.needs
            raise UserError(
                f"{extra} is trained with {package}, which is not installed",
                hint=f'pip install "thermogrip[{extra}]"',
            )

    def predict_log_proba(self, X: Records) -> Floats:
        """Return log class probabilities, shape (n_grasp, n_class), in the order of ``classes_``."""
        return np.vstack(
            [normalised(self._log_proba(self._as_trained(record))) for record in self._records(X)]
        )

    def predict_proba(self, X: Records) -> Floats:
        """Return class probabilities, shape (n_grasp, n_class); each row sums to 1."""
        return np.asarray(np.exp(self.predict_log_proba(X)))

    def predict(self, X: Records) -> Labels:
        """Return the likeliest class of each grasp, shape (n_grasp,)."""
        log_p = self.predict_log_proba(X)
        return np.asarray(self.classes_[log_p.argmax(axis=1)])

    def p_unknown(self, X: Records, candidates: Sequence[str] | None = None) -> Floats:
        """Return the probability that a grasp is of none of the candidates, shape (n_grasp,).

        NaN where the classifier has no model of other materials.
        """
        return self.open_set_log_proba(X, self.asked(candidates))[1]

    def candidate_log_proba(self, X: Records, candidates: Sequence[str]) -> Floats:
        """Return log probabilities over a subset of ``classes_``, shape (n_grasp, n_candidate)."""
        return self.open_set_log_proba(X, candidates)[0]

    def open_set_log_proba(self, X: Records, candidates: Sequence[str]) -> tuple[Floats, Floats]:
        """Return :meth:`candidate_log_proba` and :meth:`p_unknown`."""
        answers = [self.answered(record, candidates) for record in self._records(X)]
        return np.vstack([one.log_p for one in answers]), np.concatenate([one.p_unknown for one in answers])

    def answered(self, grasps: Grasps, candidates: Sequence[str] | None = None) -> Answered:
        """Return all that there is to say of the grasps of one checked record."""
        return self._answered(self._as_trained(grasps), self.asked(candidates))

    def _answered(self, grasps: Grasps, names: list[str]) -> Answered:
        """Return the answers to a record that has the sensors of the training."""
        classes, log_p = self.asked(), normalised(self._log_proba(grasps))
        columns = [classes.index(name) for name in names]
        return Answered.nothing(len(log_p), len(names))._replace(log_p=normalised(log_p[:, columns]))

    def asked(self, candidates: Sequence[str] | None = None) -> list[str]:
        """Return the candidates, each of which it :meth:`can_name`; by default all of ``classes_``."""
        self._check_fitted()
        classes = [str(c) for c in self.classes_]
        names = classes if candidates is None else [str(c) for c in candidates]
        for name in names:
            if not self.can_name(name):
                hint = known_names(name, classes, "it knows {}")
                raise UserError(f"{name!r} is no class of this classifier", hint=hint)
        if not names:
            raise UserError("no candidate is given", hint=f"name some of {', '.join(classes)}")
        return names

    def can_name(self, name: str) -> bool:
        """Return whether a material can be a candidate: one of ``classes_``."""
        return name in self.classes_

    def _check_fitted(self) -> None:
        if not hasattr(self, "classes_"):
            raise NotFittedError(f"this {type(self).__name__} is not fitted yet: call fit(grasps)")

    def _as_trained(self, grasps: Grasps) -> Grasps:
        """Return the record with the sensors that were trained with, or raise where one is missing."""
        sensors = getattr(self, "sensors_", None)
        if sensors == 2 and self.reads_both_sensors and "t_surface_2" not in grasps:
            raise UserError(
                "has no t_surface_2, and the classifier was trained with two sensors",
                file=log_name(grasps),
                hint="record both, or train on grasps of one sensor",
            )
        return grasps.drop_vars("t_surface_2", errors="ignore") if sensors == 1 else grasps

    @abstractmethod
    def _log_proba(self, grasps: Grasps) -> Floats:
        """Return log probabilities over ``classes_``, (n_grasp, n_class)."""

    def save_parts(self, folder: Path) -> None:
        """Write files of the classifier's own beside ``classifier.json``; most have none."""

    def load_parts(self, folder: Path) -> None:
        """Read what :meth:`save_parts` wrote."""

    def get_state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return what ``fit`` learnt: a JSON-able dict, and named arrays."""
        raise UserError(f"a {type(self).__name__} cannot be saved", hint="train it again from its grasps")

    def set_state(self, numbers: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
        """Take up what :meth:`get_state` returned."""
        raise UserError(f"a {type(self).__name__} cannot be loaded", hint="train it again from its grasps")


class JoinedClassifier(GraspClassifier):
    """Base of the classifiers that learn from all grasps as one record, on the samples that they share."""

    def _learn(self, records: list[Grasps], labels: list[Labels]) -> None:
        grasps, joined = join_grasps(records), np.concatenate(labels)
        self.classes_ = two_or_more(joined, log_name(grasps))
        self.sensors_ = 2 if "t_surface_2" in grasps else 1
        self._fit(grasps, joined)

    @abstractmethod
    def _fit(self, grasps: Grasps, labels: Labels) -> None:
        """Learn from labelled grasps; set attributes that end in ``_``."""


def _are_records(X: Any) -> bool:
    """Return whether something is records, or nothing at all, and no array."""
    if isinstance(X, str | Path | xr.Dataset) or "grasp_id" in getattr(X, "columns", ()):
        return True
    return isinstance(X, Sequence) and all(map(_are_records, X))


def record_list(X: Any) -> list[Grasps]:
    """Return one record as a list of one, several as a list, checked."""
    records = as_grasps(X)
    if not records:
        raise UserError("no grasps were given", hint="give at least one record")
    for i, grasps in enumerate(records):
        if not isinstance(grasps, xr.Dataset):
            raise UserError(
                f"expected Grasps, got {type(grasps).__name__}", hint="use make_grasps or read_grasps"
            )
        check_grasps(grasps)
        if not isinstance(grasps, Grasps):  # which counts grasps
            records[i] = Grasps(grasps.data_vars, coords=grasps.coords, attrs=grasps.attrs)
    return records


def despiked(records: Sequence[Grasps]) -> list[Grasps]:
    """Return records whose spikes are lost samples."""
    return [
        record.assign(t_surface=record["t_surface"].where(~spiked)) if spiked.any() else record
        for record, spiked in ((record, check_quality(record).spiked) for record in records)
    ]


def unit_names(grasps: Grasps) -> NDArray[np.str_]:
    """Return the unit that each grasp belongs to, shape (n_grasp,): its touch group, or itself."""
    groups = label_values(grasps, "touch_group")
    return np.where(groups == "", np.asarray(grasps["grasp"].values).astype(str), groups)


def grasp_labels(grasps: Grasps, y: ArrayLike | None = None) -> Labels:
    """Return the labels (n_grasp,), ``y`` or the record's materials, none of them empty."""
    where = log_name(grasps)
    if y is None and "material" not in grasps:
        raise UserError("the grasps have no material", file=where, hint="add the column 'material' or give y")
    labels = np.asarray(grasps["material"].values if y is None else y).astype(str).ravel()
    if labels.size != grasps.sizes["grasp"]:
        raise UserError(f"{labels.size} labels for {grasps.sizes['grasp']} grasps", file=where)
    if np.any(labels == ""):
        missing = str(grasps["grasp"].values[int(np.argmax(labels == ""))])
        raise UserError(f"grasp {missing!r} has no material", file=where, hint="label it or leave it out")
    return labels


def record_labels(records: Sequence[Grasps], y: ArrayLike | None) -> list[Labels]:
    """Return the materials of each record's grasps: ``y``, which runs through all of them, or their own."""
    if y is None:
        return [grasp_labels(record) for record in records]
    labels = np.asarray(y).astype(str).ravel()
    ends = np.cumsum([record.sizes["grasp"] for record in records])
    if labels.size != ends[-1]:
        raise UserError(f"{labels.size} labels for {ends[-1]} grasps")
    return [grasp_labels(record, chunk) for record, chunk in zip(records, np.split(labels, ends[:-1]))]


def pick(grasps: Grasps, index: ArrayLike) -> Grasps:
    """Return some grasps of a record, by position or mask, under the same name."""
    position = np.asarray(index)
    picked = grasps.isel(grasp=np.flatnonzero(position) if position.dtype == bool else position.astype(int))
    check_grasps(picked)
    return picked


def common_times(records: Sequence[Grasps]) -> Floats:
    """Return the sample times [s] that all records share, to 1 us, at least two of them."""
    shared = np.round(records[0]["time"].values, 6)
    for record in records[1:]:
        shared = np.intersect1d(shared, np.round(record["time"].values, 6))
    if shared.size < 2:
        raise UserError(
            "the grasps share no time axis",
            file=" and ".join(log_name(record) for record in records),
            hint="record them at the same rate",
        )
    return np.asarray(shared, dtype=float)


def join_grasps(records: Sequence[Grasps], *, name: str | None = None) -> Grasps:
    """Return several records as one, on the samples that all of them have.

    A variable that only some records hold is unknown in the others; ``t_surface_2`` stays only if all hold
    it.
    """
    if len(records) == 1:
        check_grasps(records[0])
        return records[0]
    times = common_times(records)
    cut = [record.sel(time=times, method="nearest") for record in records]
    fields: dict[str, Any] = {}
    for key in [k for k in (*GRASP_NUMBERS, *GRASP_LABELS) if any(k in record for record in cut)]:
        empty: Any = np.nan if key in GRASP_NUMBERS else ""
        blanks = [np.full(record.sizes["grasp"], empty) for record in cut]
        fields[key] = np.concatenate(
            [record[key].values if key in record else b for record, b in zip(cut, blanks)]
        )
    if all("t_surface_2" in record for record in cut):
        fields["t_surface_2"] = np.concatenate([record["t_surface_2"].values for record in cut])
    traces = np.concatenate([record["t_surface"].values for record in cut])
    ids = [str(i) for record in cut for i in record["grasp"].values]
    return make_grasps(times, traces, ids, name=name or "+".join(map(log_name, records)), **fields)


def as_array(
    grasps: Grasps, *, times: ArrayLike | None = None, start: float = -np.inf, subtract_level: bool = False
) -> Floats:
    """Return the traces as a plain matrix for any estimator.

    Lost samples are interpolated in time.  A second sensor is appended to the first.

    Parameters
    ----------
    grasps : Grasps
    times : (n_time,) array_like, optional
        Sample times [s] to read the traces at; by default the record's own from ``start`` on.
    start : float, optional
        First time [s] that is kept of the record's own.
    subtract_level : bool, optional
        Subtract each trace's median before -0.5 s (before the first sample that can be touched).

    Returns
    -------
    X : (n_grasp, n_time) ndarray, or (n_grasp, 2 n_time) with a second sensor
        Temperatures, or their rise [degC].

    Raises
    ------
    UserError
        If a trace ends more than 0.5 s before the last of ``times``.

    Examples
    --------
    >>> from thermogrip.datasets.schema import make_grasps
    >>> g = make_grasps([0.0, 0.1, 0.2], [[23.0, float("nan"), 25.0]], ["g0"])
    >>> as_array(g)
    array([[23., 24., 25.]])
    """
    sample_times = np.round(np.asarray(grasps["time"].values, dtype=float), 6)
    grid = times_from(grasps, start) if times is None else np.asarray(times, dtype=float)
    blocks = []
    for key in ("t_surface", "t_surface_2"):
        if key in grasps:
            rows = [_read_at(grid, sample_times, row, grasps, i) for i, row in enumerate(grasps[key].values)]
            block = np.vstack(rows)
            blocks.append(block - level(grasps, key)[:, None] if subtract_level else block)
    return np.hstack(blocks)


def times_from(grasps: Grasps, start: float) -> Floats:
    """Return the record's sample times from ``start`` on [s], to 1 us (-1e-16 s is 0 s), up to half a second
    after its shortest contact ends."""
    time = np.round(np.asarray(grasps["time"].values, dtype=float), 6) + 0.0  # no negative zero
    has_sample = np.isfinite(grasps["t_surface"].values)
    end = time[time.size - 1 - has_sample[:, ::-1].argmax(axis=1)].min()
    return np.asarray(time[(time >= start) & (time <= end + HELD_AT_AN_END)])


def level(grasps: Grasps, key: str = "t_surface") -> Floats:
    """Return each trace's median before -0.5 s [degC], or of its first three samples if it starts later."""
    time = grasps["time"].values
    before = time <= -0.5
    if before.sum() < 3:
        before = np.arange(time.size) < 3
    early = grasps[key].values[:, before]
    lost = ~np.isfinite(early).any(axis=1)
    if lost.any():
        raise UserError(
            f"grasp {str(grasps['grasp'].values[lost][0])!r} has no sample before contact",
            file=log_name(grasps),
            hint="record from 1 s before contact, or leave it out",
        )
    return np.asarray(np.nanmedian(early, axis=1))


def _read_at(grid: Floats, own: Floats, row: Floats, grasps: Grasps, i: int) -> Floats:
    has_sample = np.isfinite(row)
    first, last = own[has_sample][0], own[has_sample][-1]
    if grid[-1] > last + HELD_AT_AN_END or grid[0] < first - HELD_AT_AN_END:
        raise UserError(
            f"grasp {str(grasps['grasp'].values[i])!r} covers {first:g} to {last:g} s, "
            f"{grid[0]:g} to {grid[-1]:g} s are needed",
            file=log_name(grasps),
            hint="cut all grasps alike or leave it out",
        )
    return np.asarray(np.interp(grid, own[has_sample], row[has_sample]))


def check_shapes(arrays: dict[str, NDArray[Any]], **shapes: tuple[int | None, ...]) -> None:
    """Raise ValueError where an array that was read from a file has not the shape that it must have, or one
    that is divided by has what is not positive."""
    for name, shape in shapes.items():
        actual = arrays[name].shape
        if len(actual) != len(shape) or any(n not in (None, have) for n, have in zip(shape, actual)):
            raise ValueError(f"{name} has shape {actual}")
        if name in _DIVISORS and not (arrays[name] > 0).all():
            raise ValueError(f"{name} is not positive")


def set_arrays(
    classifier: GraspClassifier, arrays: dict[str, NDArray[Any]], **shapes: tuple[int | None, ...]
) -> None:
    """Set the attributes that ``shapes`` names from arrays of a file, of these shapes."""
    check_shapes(arrays, **shapes)
    for name in shapes:
        setattr(classifier, name, arrays[name])


def named_arrays(classifier: GraspClassifier, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return attributes of a classifier as arrays by name."""
    return {name: np.asarray(getattr(classifier, name)) for name in names}


def two_or_more(labels: Labels, where: str) -> Labels:
    """Return the sorted distinct labels, or raise :class:`UserError` where there is only one."""
    classes = np.unique(labels)
    if classes.size < 2:
        raise UserError(
            f"all grasps are of {str(classes[0])!r}", file=where, hint="give at least two classes"
        )
    return np.asarray(classes)


def normalised(log_p: Floats) -> Floats:
    """Return log probabilities whose rows sum to 1 from unnormalised ones."""
    return np.asarray(log_p - np.logaddexp.reduce(log_p, axis=1, keepdims=True))
