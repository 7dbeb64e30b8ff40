"""Arrays and data frames as grasps, so that scikit-learn's tools take our classifiers as they are.

A row of ``X`` (n, n_time) is the trace of a sensor; (n, n_time, n_channel) and, as sktime and aeon have it,
(n, n_channel, n_time) are traces of one or two.  NaN is a lost sample, rows of different lengths are lists.
When samples were taken an array does not say: the classifier's ``times`` does, by default 0, 0.1, 0.2 ... s
after contact.  A data frame says so itself: columns that are numbers are times [s] of the first sensor, and
the others are any of what a record has of each grasp (``t_object``, ``t_gripper``, ``session``, ...).
Contacts that begin at 0 s need ``t_gripper`` where a classifier asks for the level before them.

Labels of an array may be of any type; ``classes_`` and predictions are of the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import GRASP_LABELS, GRASP_NUMBERS, make_grasps, with_lead_in

if TYPE_CHECKING:
    from thermogrip.datasets.schema import Grasps

_SAMPLE_S = 0.1  # s
_CHANNELS = 2


def grasps_of(estimator: Any, X: Any, *, reset: bool, **y: Any) -> Grasps:
    """Return the record of an array or a data frame; ``reset`` in training, where its width is remembered;
    ``y`` are labels that scikit-learn checks beside, in training."""
    from sklearn.utils.validation import check_array, check_consistent_length, validate_data

    times, per_grasp = estimator.times, {}
    if hasattr(X, "columns") and (stated := _stated_times(X.columns)):
        columns = sorted(stated, key=stated.__getitem__)
        times = [stated[name] for name in columns]
        per_grasp = {str(name): X[name].to_numpy() for name in X.columns if name not in stated}
        X = X[columns].to_numpy(dtype=float)
    elif isinstance(X, list | tuple) and len({np.size(row) for row in X}) > 1:
        longest = max(map(np.size, X))
        X = np.array([np.append(row, np.full(longest - np.size(row), np.nan)) for row in X], dtype=float)
    rule: dict[str, Any] = {"dtype": np.float64, "ensure_all_finite": "allow-nan"}
    if np.asarray(X).ndim == 3:
        cube = check_array(X, allow_nd=True, **rule)
        if cube.shape[1] <= _CHANNELS < cube.shape[2]:
            cube = cube.transpose(0, 2, 1)
        if reset:
            estimator.n_features_in_ = cube.shape[1]
            check_consistent_length(cube, *y.values())
        elif cube.shape[1] != estimator.n_features_in_:
            problem = f"traces of {cube.shape[1]} samples, the training's had {estimator.n_features_in_}"
            raise UserError(problem, hint="give arrays of one length, NaN where a contact had ended")
    else:
        rule |= {"reset": reset, "ensure_min_features": 1 + reset, "ensure_min_samples": 1 + reset}
        checked = validate_data(estimator, X, **y, **rule)
        cube = (checked[0] if y else checked)[:, :, None]
    n, n_time, n_channel = cube.shape
    if n_channel > _CHANNELS:
        raise UserError(f"{n_channel} channels", hint="give the traces of one sensor or of two")
    axis = _SAMPLE_S * np.arange(n_time) if times is None else np.asarray(times, dtype=float)
    if axis.shape != (n_time,):
        raise UserError(f"{axis.size} times for {n_time} samples", hint="give the time of every sample [s]")
    second = {"t_surface_2": cube[:, :, 1]} if n_channel == _CHANNELS else {}
    names, name = [f"{i:06d}" for i in range(n)], "array"
    record = make_grasps(np.round(axis, 9), cube[:, :, 0], names, name=name, **second, **per_grasp)
    return with_lead_in(record)


def coded(y: Any) -> tuple[NDArray[np.str_], NDArray[Any] | None]:
    """Return labels as words and, where they are none, what the words stand for, in the order of both."""
    from sklearn.utils import assert_all_finite, column_or_1d
    from sklearn.utils.multiclass import check_classification_targets

    y = column_or_1d(y, warn=True)
    if y.dtype.kind == "f":
        assert_all_finite(y, input_name="y")
    check_classification_targets(y)
    values, place = np.unique(y, return_inverse=True)
    if values.dtype.kind in "UO" and all(isinstance(value, str) for value in values):
        return np.asarray(y, dtype=str), None
    return np.array([f"{k:06d}" for k in range(values.size)])[place], values


def _stated_times(columns: Sequence[Any]) -> dict[Any, float]:
    """Return the columns of a data frame that are times [s], none where others are not of a grasp."""
    times, others = {}, []
    for name in columns:
        try:
            times[name] = float(name)
        except (TypeError, ValueError):
            others.append(name)
    of_grasp = {*GRASP_NUMBERS, *GRASP_LABELS}
    if times and (odd := [name for name in others if name not in of_grasp]):
        problem = f"column {odd[0]!r} is no time and nothing of a grasp"
        raise UserError(problem, hint=f"use {', '.join(sorted(of_grasp))}")
    return times
