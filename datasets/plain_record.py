"""Grasps as arrays alone, for a program that answers a few of them and ends.

A record is an :class:`xarray.Dataset`, and xarray with pandas takes longer to be imported than a grasp to be
answered.  :class:`PlainGrasps` has the part of a record that an answer needs, under the same names: its
variables, its sizes, the grasps at some positions, the samples of some time, and other values in place of
these.  What else is asked of it the data set of the same values answers, which is made then.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from thermogrip.datasets.grasp_record import Grasps


class PlainVariable(NamedTuple):
    """Values with the names of their dimensions."""

    dims: tuple[str, ...]
    values: NDArray[Any]
    attrs: dict[str, Any]

    def where(self, kept: NDArray[np.bool_]) -> PlainVariable:
        """Return the values, NaN where they are not kept."""
        return self._replace(values=np.where(kept, self.values, np.nan))

    @property
    def dtype(self) -> np.dtype[Any]:
        """Return the type of the values."""
        return self.values.dtype

    @property
    def shape(self) -> tuple[int, ...]:
        """Return the lengths of the dimensions."""
        return self.values.shape

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self.values, dtype=dtype) if copy else np.asarray(self.values, dtype=dtype)


class PlainGrasps:
    """A record of grasps without xarray; see :class:`~thermogrip.datasets.grasp_record.Grasps`.

    Parameters
    ----------
    variables : mapping of name -> (dims, values, attrs)
        ``grasp`` and ``time``, the coordinates, among them.
    attrs : mapping
        Of the record.
    """

    def __init__(self, variables: Mapping[str, tuple[Any, ...]], attrs: Mapping[str, Any]) -> None:
        self.variables = {name: _variable(*parts) for name, parts in variables.items()}
        self.attrs = dict(attrs)

    @property
    def sizes(self) -> dict[str, int]:
        """Return the number of grasps and of times."""
        return {name: int(self.variables[name].values.size) for name in ("grasp", "time")}

    @property
    def coords(self) -> dict[str, PlainVariable]:
        """Return the names of grasps, and times."""
        return {name: self.variables[name] for name in ("grasp", "time") if name in self.variables}

    @property
    def data_vars(self) -> dict[str, PlainVariable]:
        """Return all else."""
        return {name: found for name, found in self.variables.items() if name not in ("grasp", "time")}

    def __contains__(self, name: object) -> bool:
        return name in self.variables

    def __iter__(self) -> Iterator[str]:
        return iter(self.data_vars)

    def __len__(self) -> int:
        return self.sizes["grasp"]

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, str):
            return self.variables[key]
        if isinstance(key, list) and all(isinstance(name, str) for name in key):
            return PlainGrasps(self.coords | {name: self.variables[name] for name in key}, self.attrs)
        return self.whole()[key]

    def __setitem__(self, name: str, variable: Any) -> None:
        self.variables[name] = _variable(*variable)

    def isel(self, *, grasp: Any) -> PlainGrasps:
        """Return the grasps at some positions, of a slice or of a mask."""
        return self._cut("grasp", grasp if isinstance(grasp, slice) else np.atleast_1d(grasp))

    def sel(self, **at: Any) -> Any:
        """Return the samples in a slice of time, its end included."""
        span = at.get("time")
        if len(at) > 1 or not isinstance(span, slice) or span.step is not None:
            return self.whole().sel(**at)
        time = self.variables["time"].values
        first = 0 if span.start is None else int(np.searchsorted(time, span.start, "left"))
        last = time.size if span.stop is None else int(np.searchsorted(time, span.stop, "right"))
        return self._cut("time", slice(first, last))

    def _cut(self, dim: str, index: Any) -> PlainGrasps:
        """Return the part of each variable at an index of one of its dimensions."""
        cut = {
            name: found._replace(values=found.values[(slice(None),) * found.dims.index(dim) + (index,)])
            if dim in found.dims
            else found
            for name, found in self.variables.items()
        }
        return PlainGrasps(cut, self.attrs)

    def assign(self, **variables: Any) -> PlainGrasps:
        """Return the record with other values."""
        return PlainGrasps(self.variables | {k: _variable(*v) for k, v in variables.items()}, self.attrs)

    assign_coords = assign

    def drop_vars(self, names: str, *, errors: str = "raise") -> PlainGrasps:
        """Return the record without a variable."""
        if errors == "raise" and names not in self.variables:
            raise ValueError(f"no variable {names!r}")
        return PlainGrasps({k: v for k, v in self.variables.items() if k != names}, self.attrs)

    def whole(self) -> Grasps:
        """Return the data set of the same values."""
        from thermogrip.datasets.grasp_record import Grasps

        return Grasps(self.data_vars, coords=self.coords, attrs=self.attrs)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # of copies and pickles, of what is not there yet
            raise AttributeError(name)
        return getattr(self.whole(), name)


def _variable(dims: Any, values: Any, attrs: Mapping[str, Any] | None = None) -> PlainVariable:
    """Return a variable of what xarray takes for one."""
    named = (dims,) if isinstance(dims, str) else tuple(dims)
    return PlainVariable(named, np.asarray(values), dict(attrs or {}))


def is_record(data: Any) -> bool:
    """Return whether something is grasps, or any data set, plain or xarray's."""
    if isinstance(data, PlainGrasps):
        return True
    xarray = sys.modules.get("xarray")  # of which nothing can be where it was not imported
    return xarray is not None and isinstance(data, xarray.Dataset)
