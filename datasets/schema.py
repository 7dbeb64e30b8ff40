"""The two records that every stage exchanges: ``Log`` and ``Grasps``.

Both are :class:`xarray.Dataset` objects that passed the check in this module.  Temperatures are degC, time is
s; the unit of a variable is in its ``units`` attribute (``"1"`` for a dimensionless one).

A **Log** has the dimension ``time``.  Each variable has a ``role``: ``input`` (what a controller moves, held
from its row until the next), ``disturbance`` (measured, not moved), ``output`` (measured, to be predicted),
or ``other``.  An output may be NaN where the sample was lost; an input and a disturbance may not.

A **Grasps** record has the dimensions ``grasp`` and ``time`` (0 s is the "closed" message of the gripper)
and the variable ``t_surface``; per grasp it may have a material, temperatures, a split, a session.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.repair import gap_rows

if TYPE_CHECKING:
    import xarray as xr

    from thermogrip.datasets.grasp_record import Grasps as Grasps

    Log: TypeAlias = xr.Dataset

ROLES = ("input", "disturbance", "output", "other")

# Per-grasp variables with their units; labels are strings, "" where absent.
# ``rest`` is the time since the block's touch before; ``touch`` counts the touches of a ``touch_group``.
GRASP_NUMBERS = dict.fromkeys(("t_object", "t_object_sd", "t_gripper", "t_ambient"), "degC")
GRASP_NUMBERS |= {"repeat": "1", "touch": "1", "rest": "s"}
_SLOWEST = 5.0  # s between the samples of a grasp: beyond it they are milliseconds
HOTTEST = 200.0  # degC, either side of 0: beyond it a number is kelvin, or of no sensor
GRASP_LABELS = ("material", "experiment", "split", "touch_group", "session", "block")


def __getattr__(name: str) -> Any:  # PEP 562: a file that is no log is refused before xarray is loaded
    if name not in ("Log", "Grasps"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "Grasps":
        from thermogrip.datasets.grasp_record import Grasps

        return Grasps
    from xarray import Dataset

    return Dataset


def make_log(
    time: ArrayLike,
    variables: Mapping[str, tuple[ArrayLike, str, str]],
    *,
    name: str = "log",
    repairs: Sequence[str] = (),
) -> Log:
    """Return a checked Log.

    Parameters
    ----------
    time : (n,) array_like
        Seconds, strictly increasing.
    variables : dict of name -> (values, unit, role)
        Values have shape (n,); role is one of :data:`ROLES`.
    name : str, optional
        Name of the log in tables and messages.
    repairs : sequence of str, optional
        What the reader repaired, a line each.

    Raises
    ------
    UserError
        If the record breaks a rule of :func:`check_log`.

    Examples
    --------
    >>> drive, t_tank = ([0.0, 1.0], "1", "input"), ([25.0, 25.1], "degC", "output")
    >>> log = make_log([0.0, 0.5], {"drive": drive, "t_tank": t_tank})
    >>> names(log, "output"), log["t_tank"].attrs["units"]
    (('t_tank',), 'degC')
    """
    import xarray as xr

    log = xr.Dataset(coords={"time": ("time", np.asarray(time, dtype=float), {"units": "s"})})
    for key, (values, unit, role) in variables.items():
        log[key] = ("time", np.asarray(values, dtype=float), {"units": unit, "role": role})
    log.attrs.update(schema="thermogrip.log", version=1, name=name, repairs="\n".join(repairs))
    check_log(log)
    return log


def check_log(log: Log) -> None:
    """Raise :class:`UserError` naming the variable of a log and the rule it breaks."""
    fault = partial(UserError, file=log_name(log))
    if "time" not in log.coords or log["time"].dims != ("time",):
        raise fault("no time axis", hint="give the record a dimension 'time' in seconds")
    time = log["time"].values
    if time.size < 2:
        raise fault(f"{time.size} row(s) are not a log", hint="give at least two rows")
    if not np.all(np.isfinite(time)):
        raise fault("time is not finite everywhere", hint="remove the rows without a time")
    if np.any(np.diff(time) <= 0):
        row = int(np.argmax(np.diff(time) <= 0))
        raise fault(f"time does not increase after {time[row]:g} s", hint="sort the rows by time")
    for name, variable in ((str(key), variable) for key, variable in log.data_vars.items()):
        if variable.dims != ("time",):
            raise fault(f"dims are {variable.dims}, not ('time',)", column=name)
        if "units" not in variable.attrs:
            raise fault("no unit", column=name, hint="set attrs['units'], '1' if dimensionless")
        role = variable.attrs.get("role")
        if role not in ROLES:
            raise fault(f"role {role!r} is unknown", column=name, hint=f"use one of {ROLES}")
        finite = np.isfinite(variable.values)
        if not finite.any():
            raise fault("has no finite value", column=name, hint="leave the column out")
        if role in ("input", "disturbance") and not finite.all():
            problem = f"{role} is unknown in {int((~finite).sum())} row(s)"
            raise fault(problem, column=name, hint="fill or cut them")


def names(log: Log, role: str) -> tuple[str, ...]:
    """Return the names of the log's variables with this role, in file order."""
    return tuple(str(key) for key, variable in log.data_vars.items() if variable.attrs.get("role") == role)


def column(log: Log, name: str) -> Array:
    """Return one variable of the log as a float array of shape (n_time,)."""
    if name not in log:
        hint = known_names(name, map(str, log.data_vars), "it has {}")
        raise UserError("no such column", file=log_name(log), column=name, hint=hint)
    return np.asarray(log[name].values, dtype=float)


def columns(log: Log, wanted: Sequence[str]) -> Array:
    """Return several variables of the log as a float array of shape (n_time, n_wanted)."""
    if not wanted:
        return np.empty((log.sizes["time"], 0))
    return np.stack([column(log, name) for name in wanted], axis=1)


def cut(log: Log, start: float = -np.inf, stop: float = np.inf) -> Log:
    """Return the rows with start <= time < stop; times stay as they are.

    Parameters
    ----------
    log : Log
    start, stop : float, optional
        Ends of the cut [s].

    Raises
    ------
    UserError
        If fewer than two rows are left.

    Examples
    --------
    >>> log = make_log([0.0, 1.0, 2.0, 3.0], {"pump": ([0, 1, 1, 0], "1", "input")})
    >>> cut(log, 1.0, 3.0)["time"].values
    array([1., 2.])
    """
    time = log["time"].values
    inside = (time >= start) & (time < stop)
    if inside.sum() < 2:
        problem = f"the cut {start:g}:{stop:g} s leaves {int(inside.sum())} row(s)"
        hint = f"the log goes from {time[0]:g} to {time[-1]:g} s"
        raise UserError(problem, file=log_name(log), hint=hint)
    return log.isel(time=np.flatnonzero(inside))


def gaps(log: Log) -> list[tuple[int, float, float]]:
    """Return (row before, time before [s], time after [s]) of each gap; see :func:`gap_rows`."""
    time = log["time"].values
    return [(int(row), float(time[row]), float(time[row + 1])) for row in gap_rows(time)]


def log_name(log: xr.Dataset) -> str:
    """Return the record's name in tables and messages."""
    return str(log.attrs.get("name", "log"))


def hash_columns(data: Mapping[str, Array]) -> str:
    """Return the SHA-256 of columns, in whatever order they stand."""
    # + 0.0: -0 and 0 are one number, of two byte patterns
    values = [np.asarray(v, dtype="<f8") + 0.0 for v in data.values()]
    digests = sorted(hashlib.sha256(one.tobytes()).digest() for one in values)
    return hashlib.sha256(b"".join(digests)).hexdigest()


def make_grasps(
    time: ArrayLike,
    t_surface: ArrayLike,
    grasp_id: Sequence[str],
    *,
    name: str = "grasps",
    t_surface_2: ArrayLike | None = None,
    **per_grasp: Any,
) -> Grasps:
    """Return a checked Grasps record.

    Parameters
    ----------
    time : (n_time,) array_like
        Seconds since the "closed" message, strictly increasing, from before contact.
    t_surface : (n_grasp, n_time) array_like
        Skin temperature [degC]; NaN where a grasp has no sample.
    grasp_id : sequence of str
        One unique name a grasp.
    name : str, optional
        The condition.
    t_surface_2 : (n_grasp, n_time) array_like, optional
        A second sensor [degC].
    **per_grasp : (n_grasp,) array_like
        Any of :data:`GRASP_NUMBERS` (NaN where unknown) and :data:`GRASP_LABELS` ("" where unknown).

    Raises
    ------
    UserError
        If a name is no such variable, or the record breaks a rule of :func:`check_grasps`.

    Examples
    --------
    >>> g = make_grasps([-0.1, 0.0, 0.1], [[23.0, 23.0, 24.1]], ["g0"], material=["copper"], t_object=[43.0])
    >>> g.sizes["grasp"], str(g["material"].values[0]), float(g["t_object"][0])
    (1, 'copper', 43.0)
    """
    from thermogrip.datasets.grasp_record import Grasps

    coords: dict[str, Any] = {
        "grasp": ("grasp", np.asarray([str(g) for g in grasp_id])),
        "time": ("time", np.asarray(time, dtype=float), {"units": "s"}),
    }
    variables: dict[str, Any] = {}
    for key, values in (("t_surface", t_surface), ("t_surface_2", t_surface_2)):
        if values is not None:
            variables[key] = (("grasp", "time"), np.asarray(values, dtype=float), {"units": "degC"})
    for key, values in per_grasp.items():
        if key in GRASP_NUMBERS:
            variables[key] = ("grasp", np.asarray(values, dtype=float), {"units": GRASP_NUMBERS[key]})
        elif key in GRASP_LABELS:
            variables[key] = ("grasp", np.asarray([str(v) for v in values]))
        else:
            problem = f"a grasp has no {key!r}"
            raise UserError(problem, hint=known_names(key, [*GRASP_NUMBERS, *GRASP_LABELS]))
    attrs = {"schema": "thermogrip.grasps", "version": 1, "name": name}
    grasps = Grasps(variables, coords=coords, attrs=attrs)
    check_grasps(grasps)
    return grasps


def with_lead_in(grasps: Grasps) -> Grasps:
    """Return a record that begins at contact with its stated level ``t_gripper`` before it, which
    ``attrs["repairs"]`` notes; any other record is returned as it is."""
    time = grasps["time"].values
    if time[0] < 0 or "t_gripper" not in grasps or bool(np.isnan(grasps["t_gripper"].values).any()):
        return grasps
    step = float(np.median(np.diff(time)))  # on the grid of the others
    # from 3 to 2 s before the message, so that contact may have been before it
    lead = time[0] - step * np.unique(np.round(np.linspace(3.0, 2.0, 5) / step))[::-1]
    out = grasps.pad(time=(lead.size, 0))  # NaN before it
    out = out.assign_coords(time=("time", np.concatenate([lead, time]), {"units": "s"}))
    out["t_surface"] = out["t_surface"].where(out["time"] >= time[0], out["t_gripper"])
    note = "begins at contact: the level before it is t_gripper"
    out.attrs["repairs"] = "\n".join(filter(None, [grasps.attrs.get("repairs", ""), note]))
    check_grasps(out)
    return out


def check_grasps(grasps: xr.Dataset) -> None:
    """Raise :class:`UserError` naming the grasp of a record and the rule it breaks: of axes and labels, of
    temperatures that no gripper and no object has [degC], and of touches."""
    fault = partial(UserError, file=log_name(grasps))
    for need in ("grasp", "time"):
        if need not in grasps.coords:
            raise fault(f"no {need} axis", hint="give the record dims 'grasp' and 'time'")
    variables = grasps.variables  # a DataArray made of one costs more than to check it
    if "t_surface" not in grasps or variables["t_surface"].dims != ("grasp", "time"):
        raise fault("no t_surface of dims (grasp, time)")
    time, ids = variables["time"].values, variables["grasp"].values
    if ids.size == 0:
        raise fault("holds no grasp", hint="give at least one")
    if time.size < 2 or not np.all(np.isfinite(time)) or np.any(np.diff(time) <= 0):
        raise fault("time does not increase", hint="sort the samples of each grasp by time")
    if time[-1] - time[0] > _SLOWEST * (time.size - 1):
        hint = "give times in seconds since the closed message"
        raise fault(f"samples are {np.mean(np.diff(time)):g} s apart", hint=hint)
    unique, counts = np.unique(ids, return_counts=True)
    if np.any(counts > 1):
        raise fault(f"grasp_id {str(unique[counts > 1][0])!r} occurs twice", hint="give each its own")
    lost = ~np.isfinite(variables["t_surface"].values).any(axis=1)
    if lost.any():
        raise fault(f"grasp {str(ids[lost][0])!r} has no temperature", hint="remove it")
    for label in np.unique(variables["split"].values.astype(str)) if "split" in grasps else ():
        plain = label.strip().lower()
        if plain != label and plain in ("train", "test"):  # it would be left out of both without a word
            raise fault(f"split {label!r} is neither train nor test", hint=f"write {plain!r}")
    for name in ("t_surface", "t_surface_2", "t_object", "t_gripper", "t_ambient"):
        if name in grasps:
            values = grasps.variables[name].values
            for place in np.argwhere(np.abs(values) > HOTTEST)[:1]:  # NaN compares false
                problem = f"grasp {str(ids[place[0]])!r} has a {name} of {values[tuple(place)]:g} degC"
                hint = "give degrees Celsius, or end the column's name in _K if it is kelvin"
                raise fault(problem, hint=hint)
    rests = grasps.variables["rest"].values if "rest" in grasps else np.zeros(len(ids))
    for k in np.flatnonzero(rests < 0):  # NaN compares false
        hint = "give the seconds since the touch before, or leave it empty"
        raise fault(f"grasp {str(ids[k])!r} has a rest of {float(rests[k]):g} s", hint=hint)
    if "touch" not in grasps or "touch_group" not in grasps:
        return
    groups, touch = label_values(grasps, "touch_group"), grasps.variables["touch"].values
    is_numbered = np.isfinite(touch) & (groups != "")
    for k in np.flatnonzero(~np.isfinite(touch) & np.isin(groups, groups[is_numbered]))[:1]:
        of_group = f"grasp {str(ids[k])!r} of touch_group {str(groups[k])!r}"
        hint = "number all touches of a block, or none"
        raise fault(f"{of_group} has no touch, others of it have", hint=hint)
    touches = zip(touch[is_numbered].tolist(), groups[is_numbered].tolist())
    for (number, group), count in Counter(touches).items():
        if count > 1:
            hint = "number its touches 1, 2, ..., and give a block that is touched anew another touch_group"
            raise fault(f"touch {number:g} of touch_group {group!r} occurs twice", hint=hint)


def label_values(grasps: xr.Dataset, name: str) -> NDArray[np.str_]:
    """Return a label of :data:`GRASP_LABELS` for each grasp, shape (n_grasp,), "" where it is absent."""
    if name not in grasps:
        return np.full(grasps.sizes["grasp"], "", dtype="<U1")
    return np.asarray(grasps.variables[name].values, dtype=str)


def has_touch_groups(grasps: Grasps) -> bool:
    """Return whether a record has touches of one block (``touch_group``)."""
    return bool((label_values(grasps, "touch_group") != "").any())
