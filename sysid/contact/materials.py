"""Thermal properties of some hundred materials, each with an uncertainty and a source.

What a touch feels is the effusivity (the paper's sqrt(lambda rho c)),

    e = sqrt(k rho c_p)   [W s^0.5 m^-2 K^-1].

Handbooks disagree about it by 2 to 5 % for pure metals, by 10 % for alloys and plastics, and by a quarter
for wood, rubber and foams; zinc and brass are 8 % apart. So every row has the relative standard deviation of
e, from the spread of the sources where there are several, and from the kind of material where there is one.
"""

from __future__ import annotations

import csv
import difflib
import io
import math
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from thermogrip.datasets.errors import UserError


@dataclass(frozen=True)
class Material:
    """One row of the table."""

    name: str
    k: float  # conductivity [W m^-1 K^-1]
    rho: float  # density [kg m^-3]
    c_p: float  # heat capacity [J kg^-1 K^-1]
    effusivity: float  # sqrt(k rho c_p) [W s^0.5 m^-2 K^-1]
    effusivity_sd_ln: float  # its relative standard deviation [1]
    source: str  # where the numbers are from
    kind: str  # metal, ceramic, mineral, polymer, wood, insulation, liquid or biological
    aliases: tuple[str, ...] = ()  # other names

    @property
    def diffusivity(self) -> float:
        """Thermal diffusivity k / (rho c_p) [m^2/s]."""
        return self.k / (self.rho * self.c_p)


@cache
def _bundled() -> dict[str, Material]:
    materials = {}
    text = (files("thermogrip.sysid.contact") / "data" / "materials.csv").read_text(encoding="utf-8")
    for row in csv.DictReader(io.StringIO(text)):
        k, rho, c_p = (float(row[key]) for key in ("k", "rho", "c_p"))
        materials[row["name"]] = Material(
            row["name"],
            k,
            rho,
            c_p,
            effusivity=math.sqrt(k * rho * c_p),
            effusivity_sd_ln=float(row["effusivity_sd_percent"]) / 100,
            source=row["source"],
            kind=row["kind"],
            aliases=tuple(filter(None, row["aliases"].split(";"))),
        )
    return materials


def load_materials() -> dict[str, Material]:
    """Return the table by name, in file order: the paper's five first."""
    return dict(_bundled())


def find_material(name: str) -> Material:
    """Return the material of that name or alias.

    Parameters
    ----------
    name : str
        In upper or lower case.

    Raises
    ------
    UserError
        If there is none; the message gives the nearest names.

    Examples
    --------
    >>> find_material("Stainless").name, find_material("PMMA").name
    ('stainless steel', 'acrylic')
    >>> find_material("aluminim")
    Traceback (most recent call last):
    ...
    thermogrip.datasets.errors.UserError: no material 'aluminim'; did you mean aluminium, alumina?
    """
    by_name = {n: m for m in _bundled().values() for n in (m.name, *m.aliases)}
    wanted = " ".join(name.lower().replace("_", " ").split())
    if wanted in by_name:
        return by_name[wanted]
    close = difflib.get_close_matches(wanted, by_name, n=4, cutoff=0.7)
    close += [n for n in by_name if wanted and wanted in n][:4]
    nearest = list(dict.fromkeys(by_name[n].name for n in close))
    hint = f"did you mean {', '.join(nearest)}?" if nearest else "'thermogrip materials' lists them all"
    raise UserError(f"no material {name!r}", hint=hint)
