"""The table of materials."""

from __future__ import annotations

import csv
import io
import itertools
import math
from dataclasses import FrozenInstanceError
from importlib.resources import files

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.sysid.contact.materials import find_material, load_materials

HEAD = "name,kind,k,rho,c_p,effusivity,effusivity_sd_percent,aliases,source\n"


@pytest.mark.parametrize(
    ("name", "e"), [("copper", 3.64e4), ("brass", 1.91e4), ("zinc", 1.76e4), ("iron", 1.61e4), ("wood", 367)]
)
def test_the_papers_five_have_the_papers_effusivities(name, e):
    assert load_materials()[name].effusivity == pytest.approx(e, rel=0.004)


def test_every_effusivity_is_that_of_its_own_row():
    for m in load_materials().values():
        assert m.effusivity == pytest.approx(math.sqrt(m.k * m.rho * m.c_p), rel=1e-12)
        assert m.effusivity == pytest.approx(m.k / math.sqrt(m.diffusivity), rel=1e-12)


def test_no_two_rows_are_near_duplicates():
    for a, b in itertools.combinations(load_materials().values(), 2):
        worst = max(abs(math.log(x / y)) for x, y in ((a.k, b.k), (a.rho, b.rho), (a.c_p, b.c_p)))
        assert worst > 0.03, (a.name, b.name)


def test_heat_capacity_per_mole_of_the_metallic_elements_is_near_dulong_and_petit():
    mole = {"copper": 63.5, "zinc": 65.4, "iron": 55.8, "aluminium": 27.0, "gold": 197.0, "lead": 207.2,
            "magnesium": 24.3, "molybdenum": 95.9, "nickel": 58.7, "platinum": 195.1, "silver": 107.9,
            "tin": 118.7, "titanium": 47.9, "tungsten": 183.8, "iridium": 192.2, "uranium": 238}  # fmt: skip
    table = load_materials()
    for name, grams in mole.items():
        assert table[name].c_p * grams / 1000 == pytest.approx(3 * 8.314, rel=0.12), name


def test_conductivity_of_pure_metals_follows_wiedemann_and_franz():
    # electrical resistivity at 20 degC [nOhm m]; L = 2.44e-8 W Ohm K^-2
    resistivity = {"copper": 16.8, "silver": 15.9, "gold": 22.1, "aluminium": 26.5, "zinc": 59.0,
                   "iron": 97.0, "lead": 208.0, "tin": 115.0, "platinum": 106.0, "nickel": 69.9}  # fmt: skip
    table = load_materials()
    for name, rho in resistivity.items():
        assert table[name].k == pytest.approx(2.44e-8 * 293 / (rho * 1e-9), rel=0.25), name


def test_uncertainty_grows_from_pure_metals_to_wood():
    table = load_materials()
    assert table["copper"].effusivity_sd_ln < table["iron"].effusivity_sd_ln < table["wood"].effusivity_sd_ln
    assert all(0.01 <= m.effusivity_sd_ln <= 0.35 for m in table.values())
    # iron by two handbooks: 16142 and 16797
    assert math.log(16797 / table["iron"].effusivity) <= 1.5 * table["iron"].effusivity_sd_ln


def test_every_row_has_a_source():
    assert all(len(m.source) > 4 for m in load_materials().values())


def test_names_are_found_in_any_case_and_by_alias():
    assert find_material("  COPPER ").name == "copper"
    assert find_material("stainless").name == find_material("Stainless_Steel").name == "stainless steel"
    assert find_material("aluminum").name == "aluminium"


def test_a_material_that_is_not_there_gets_its_nearest_names():
    for name, near in (("aluminim", "aluminium, alumina"), ("poly", "polycarbonate, ptfe, pvc, pom")):
        with pytest.raises(UserError, match=rf"no material '{name}'; did you mean {near}\?$"):
            find_material(name)
    with pytest.raises(UserError, match=r"no material 'brras'; did you mean brass\?"):
        find_material("brras")
    with pytest.raises(UserError, match="lists them all"):
        find_material("unobtainium")
    with pytest.raises(UserError):
        find_material("")


def test_a_row_cannot_be_changed():
    with pytest.raises(FrozenInstanceError):
        find_material("copper").k = 1.0  # type: ignore[misc]


# kind: least and greatest k [W/mK], rho [kg/m3] and c_p [J/kgK] near room temperature
RANGES = {
    "metal": (7, 450, 1700, 23000, 110, 1100),
    "ceramic": (0.8, 500, 1800, 6100, 450, 1100),
    "mineral": (0.1, 4, 350, 3100, 750, 2150),
    "polymer": (0.1, 0.55, 850, 2250, 850, 2300),
    "wood": (0.04, 0.25, 150, 1100, 1300, 2900),
    "insulation": (0.015, 0.13, 5, 800, 600, 2400),
    "liquid": (0.1, 0.7, 600, 1400, 1500, 4250),
    "biological": (0.15, 0.65, 900, 1300, 2000, 4000),
}


def test_no_row_has_lost_a_decimal_point():
    """Published tables have: each number is in the range of its kind, and e is that of the other three."""
    text = (files("thermogrip.sysid.contact") / "data" / "materials.csv").read_text(encoding="utf-8")
    stated = {row["name"]: float(row["effusivity"]) for row in csv.DictReader(io.StringIO(text))}
    table = load_materials()
    assert {m.kind for m in table.values()} == set(RANGES)
    for m in table.values():
        ends = np.reshape(RANGES[m.kind], (3, 2))
        values = np.array([m.k, m.rho, m.c_p])
        assert np.all((ends[:, 0] <= values) & (values <= ends[:, 1])), m.name
        assert stated[m.name] == pytest.approx(m.effusivity, rel=0.02)


def test_no_name_means_two_materials():
    names = [name for m in load_materials().values() for name in (m.name, *m.aliases)]
    assert len(names) == len(set(names))
