"""Thermal properties of some hundred materials, each with an uncertainty and a source.

What a touch feels is the effusivity (the paper's sqrt(lambda rho c)),

    e = sqrt(k rho c_p)   [W s^0.5 m^-2 K^-1].

Handbooks disagree about it by 2 to 5 % for pure metals, by 10 % for alloys and plastics, and by a quarter
for wood, rubber and foams, whose grade and moisture the name does not state.  The spread matters as much
as the value: zinc and brass are 8 % apart, iron in two handbooks 4 %. So every row has the relative
standard deviation of e, one sigma, estimated from the spread of the sources where there are several, and
from the kind of material where there is one.

Every row is checked on loading: e against its own k, rho and c_p (2 %), and each number against the range
that its kind can have.  The checks are there because published tables have lost decimal points.
"""

from __future__ import annotations

import csv
import difflib
import io
import math
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from thermogrip.datasets.errors import UserError, as_user_error, known_names

# kind -> (k [W/mK], rho [kg/m3], c_p [J/kgK]), each (least, greatest) near room temperature
KINDS: dict[str, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    "metal": ((7, 450), (1700, 23000), (110, 1100)),
    "ceramic": ((0.8, 500), (1800, 6100), (450, 1100)),
    "mineral": ((0.1, 4), (350, 3100), (750, 2150)),
    "polymer": ((0.1, 0.55), (850, 2250), (850, 2300)),
    "wood": ((0.04, 0.25), (150, 1100), (1300, 2900)),
    "insulation": ((0.015, 0.13), (5, 800), (600, 2400)),
    "liquid": ((0.1, 0.7), (600, 1400), (1500, 4250)),
    "biological": ((0.15, 0.65), (900, 1300), (2000, 4000)),
}


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
    kind: str  # one of :data:`KINDS`
    aliases: tuple[str, ...] = ()  # other names

    @property
    def diffusivity(self) -> float:
        """Thermal diffusivity k / (rho c_p) [m^2/s]."""
        return self.k / (self.rho * self.c_p)


@cache
def _bundled() -> tuple[Material, ...]:
    text = (files("thermogrip.datasets") / "data" / "materials.csv").read_text(encoding="utf-8")
    return tuple(read_materials(text, file="materials.csv"))


def load_materials() -> dict[str, Material]:
    """Return the table by name, in file order: the paper's five first."""
    return {material.name: material for material in _bundled()}


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
    by_name = {n: m for m in _bundled() for n in (m.name, *m.aliases)}
    wanted = " ".join(name.lower().replace("_", " ").split())
    if wanted in by_name:
        return by_name[wanted]
    close = difflib.get_close_matches(wanted, by_name, n=4, cutoff=0.7)
    close += [n for n in by_name if wanted and wanted in n][:4]
    near = list(dict.fromkeys(by_name[n].name for n in close))
    hint = f"did you mean {', '.join(near)}?" if near else "'thermogrip materials' lists them all"
    raise UserError(f"no material {name!r}", hint=hint)


def read_materials(text: str, *, file: str = "materials.csv") -> list[Material]:
    """Return the materials in a CSV text, each checked: name, kind, k, rho, c_p, effusivity,
    effusivity_sd_percent, aliases (separated by ``;``), source."""
    materials: list[Material] = []
    taken: set[str] = set()
    for line, row in enumerate(csv.DictReader(io.StringIO(text)), start=2):
        material = _material(row, {"file": file, "row": line})
        for name in (material.name, *material.aliases):
            if name in taken:
                raise UserError(f"{name!r} occurs twice", file=file, row=line, hint="keep one")
            taken.add(name)
        materials.append(material)
    return materials


def _material(row: dict[str, str], at: dict[str, Any]) -> Material:
    """Return the material of a row, checked; the column of e is a check on k, rho and c_p."""
    numbers = {}
    for key in ("k", "rho", "c_p", "effusivity", "effusivity_sd_percent"):
        wrong = (KeyError, TypeError, ValueError)
        with as_user_error(wrong, "is not a number", **at, column=key, hint="write one"):
            numbers[key] = float(row[key])
    if not row.get("source") or not row.get("name"):
        raise UserError("has no name or no source", **at, hint="say where it comes from")
    k, rho, c_p, stated, percent = numbers.values()
    if not (k * rho * c_p > 0 and abs(stated / math.sqrt(k * rho * c_p) - 1) <= 0.02):
        problem = f"{stated:g} is not sqrt(k rho c_p) within 2 %"
        raise UserError(problem, **at, column="effusivity", hint="check the four numbers of the row")
    kind = row.get("kind") or ""
    if kind not in KINDS:
        raise UserError(f"kind {kind!r} is unknown", **at, column="kind", hint=known_names(kind, KINDS))
    for name, (least, greatest) in zip(("k", "rho", "c_p"), KINDS[kind], strict=True):
        if not least <= numbers[name] <= greatest:
            problem = f"{numbers[name]:g} is outside {least:g} to {greatest:g}, where a {kind} can be"
            raise UserError(problem, **at, column=name, hint="look for a lost decimal point")
    if not 1 <= percent <= 50:
        problem = f"{percent:g} % is not between 1 and 50 %"
        raise UserError(problem, **at, column="effusivity_sd_percent", hint="estimate it anew")
    e, aliases = math.sqrt(k * rho * c_p), (row.get("aliases") or "").split(";")
    names = tuple(alias for alias in aliases if alias)
    return Material(row["name"], k, rho, c_p, e, percent / 100, row["source"], kind, names)
