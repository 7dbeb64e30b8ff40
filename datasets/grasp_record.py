"""The record of grasps as a class: an :class:`xarray.Dataset` that counts and picks grasps as arrays do rows.

``len(grasps)`` is the number of grasps, and ``grasps[rows]`` are those at some positions, so that whatever
splits rows (``train_test_split``, ``cross_val_score``, ``GridSearchCV``) splits grasps; by name it is a
dataset as any other.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr


class Grasps(xr.Dataset):  # type: ignore[no-untyped-call]
    """Dims (grasp, time); made by :func:`~thermogrip.datasets.schema.make_grasps` or a reader.

    Parameters
    ----------
    data_vars, coords, attrs : mapping, optional
        As of :class:`xarray.Dataset`.

    Examples
    --------
    >>> from thermogrip.datasets.schema import make_grasps
    >>> grasps = make_grasps([-0.1, 0.1], [[23.0, 24.5], [23.0, 23.1]], ["a", "b"], material=["iron", "wood"])
    >>> grasps
    Grasps 'grasps': 2 grasps (1 iron, 1 wood), 2 samples from -0.1 to 0.1 s; t_surface
    >>> len(grasps), grasps[[1]]["material"].values.tolist()
    (2, ['wood'])
    """

    __slots__ = ()

    def __len__(self) -> int:
        return int(self.sizes["grasp"])

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of grasps and times."""
        return int(self.sizes["grasp"]), int(self.sizes["time"])

    if not TYPE_CHECKING:  # by name its types are those of any dataset

        def __getitem__(self, key: Any) -> Any:
            """Return a variable by name, or the grasps at these positions, or of this mask."""
            rows = key[0] if isinstance(key, tuple) and key[1:] == (Ellipsis,) else key
            if isinstance(rows, slice):
                return self.isel(grasp=rows)
            if not isinstance(rows, str) and np.size(rows) and np.asarray(rows).dtype.kind in "biu":
                return self.isel(grasp=np.atleast_1d(rows))
            return super().__getitem__(key)

    def __repr__(self) -> str:
        n, samples = self.shape
        labels = self.variables["material"].values if "material" in self else np.empty(0, str)
        names, counts = np.unique(labels, return_counts=True)
        of = ", ".join(f"{count} {name or 'of no material'}" for name, count in zip(names, counts))
        time, others = self.variables["time"].values, [str(k) for k in self.data_vars if k != "material"]
        return (
            f"Grasps {str(self.attrs.get('name', ''))!r}: {n} grasps{f' ({of})' if of else ''}, "
            f"{samples} samples from {time[0]:g} to {time[-1]:g} s; {', '.join(others)}"
        )
