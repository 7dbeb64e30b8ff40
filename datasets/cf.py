"""Records by the CF conventions, so that xarray, Panoply, ncview and their like show them as they are meant.

What CF 1.11 [1]_ asks of a file, and how a record gives it:

- ``Conventions`` and ``title`` stand in its attributes.
- Units are UDUNITS [2]_.  It knows ``degC``, ``percent``, ``s``; what is counted from 0 to 255 has the unit
  1/255, as a number.  A temperature says in ``units_metadata`` whether it is one or a difference of two.
- A coordinate variable is numeric, increases, and misses nothing.  The names of grasps are text: they are an
  auxiliary coordinate, ``grasp_id(grasp)``, which the data name in ``coordinates``.
- What is an index into words (the phase of a session) has ``flag_values`` of its own type beside
  ``flag_meanings``.
- Every number has a ``long_name``.  None has a ``standard_name``: there is none for a skin that touches
  something, and that of ``time`` needs a date to count from, which a log does not have.

References
----------
.. [1] https://cfconventions.org/Data/cf-conventions/cf-conventions-1.11/cf-conventions.html, sections 2.2 to
       2.6, 3.1, 3.5 and 6.1.
.. [2] https://docs.unidata.ucar.edu/udunits/current/
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["CONVENTIONS", "UNIT_OF_BYTE", "as_cf", "from_cf"]

CONVENTIONS = "CF-1.11"
UNIT_OF_BYTE = repr(1 / 255)

_ADDED = ("Conventions", "title", "source")
_LONG_NAMES = {
    "t_surface": "temperature of the skin",
    "t_surface_2": "temperature of the skin, second sensor",
    "t_object": "temperature of the object before contact",
    "t_object_sd": "standard deviation of the temperature of the object",
    "t_gripper": "temperature of the skin before contact",
    "t_ambient": "temperature of the room",
    "repeat": "count of repeats",
    "touch": "count of touches of one block",
    "rest": "time since the touch before",
}


def as_cf(data: xr.Dataset) -> xr.Dataset:
    """Return a record as a file of it is to be.

    Examples
    --------
    >>> from thermogrip.datasets.schema import make_grasps
    >>> file = as_cf(make_grasps([-0.1, 0.1], [[23.0, 24.0]], ["g0"], name="warm"))
    >>> file.attrs["Conventions"], file.attrs["title"], list(file.coords)
    ('CF-1.11', 'warm', ['time', 'grasp_id'])
    >>> file["t_surface"].attrs["units_metadata"]
    'temperature: on_scale'
    """
    out = data.copy()
    of_grasps = "grasp" in out.dims
    if "grasp" in out.coords:
        out = out.drop_vars("grasp").assign_coords(grasp_id=("grasp", data["grasp"].values))
    out.attrs = {
        "Conventions": CONVENTIONS,
        "title": str(data.attrs.get("name", "record")),
        "source": "thermogrip",
    }
    out.attrs |= data.attrs
    for key in [*out.data_vars, "time"]:
        if key in out.variables:
            out[key] = _variable(str(key), out[key].variable, of_grasps)
    return out


def from_cf(data: xr.Dataset) -> xr.Dataset:
    """Return the record that a file holds; what :func:`as_cf` said for others is taken off again."""
    if "grasp_id" in data.variables and data["grasp_id"].dims == ("grasp",) and "grasp" not in data.variables:
        names = data["grasp_id"].values.astype(str)
        data = data.drop_vars("grasp_id").assign_coords(grasp=("grasp", names))
    if str(data.attrs.get("schema", "")).startswith("thermogrip."):
        data.attrs = {key: value for key, value in data.attrs.items() if key not in _ADDED}
    return data


def _variable(name: str, variable: xr.Variable, of_grasps: bool) -> xr.Variable:
    attrs: dict[Any, Any] = dict(variable.attrs)
    values = variable.values
    if values.dtype.kind not in "fiu":
        return variable
    if name == "time":
        attrs["long_name"] = "time since the gripper closed" if of_grasps else "time of the log"
    elif of_grasps:
        attrs.setdefault("long_name", _LONG_NAMES.get(name, name))
    else:
        attrs.setdefault("long_name", f"{name} ({attrs.get('role', 'other')})")
    if attrs.get("units") == "degC":
        attrs["units_metadata"] = f"temperature: {'difference' if name.endswith('_sd') else 'on_scale'}"
    if attrs.get("units") == "0_255":
        attrs["units"] = UNIT_OF_BYTE
    if "flag_meanings" in attrs:
        if np.array_equal(values, values.astype(np.int8)):
            values = values.astype(np.int8)
        attrs["flag_values"] = np.arange(len(str(attrs["flag_meanings"]).split()), dtype=values.dtype)
    return type(variable)(variable.dims, values, attrs)
