"""Results show themselves in a few lines, and as a table without anything that a name could run."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from tests.end_to_end.conftest import small_plant
from thermogrip.media.rendering import Shown
from thermogrip.mpc import Controller, PIController, simulate_closed_loop
from thermogrip.sysid import load_network
from thermogrip.sysid.experiment.information import plant_from_prior


class Odd(Shown):
    def _facts(self) -> Mapping[str, object]:
        return {"<b>": "a\x1b[2J", "long": "x" * 300} | {f"n{k}": k for k in range(40)}


def test_a_fact_is_one_line_and_no_markup() -> None:
    title, first, long, *more = repr(Odd()).splitlines()
    assert (title, first.split()) == ("Odd", ["<b>", "a\\x1b[2J"])
    assert (len(long), long[-3:], len(more)) == (110, "...", 9)
    page = Odd()._repr_html_()
    assert page.startswith("<table")
    assert "<tr><th>&lt;b&gt;</th><td>a\\x1b[2J</td></tr>" in page


@pytest.mark.parametrize(
    ("shown", "says"),
    [
        (
            lambda: plant_from_prior(load_network("gripper")),
            ["seebeck           0.083 V/K (90 %: 0.008298", "verdict           prior values, not fitted"],
        ),
        (
            small_plant,
            ["model             statespace, a step of 0.5 s", "outputs           t_tank [degC], t_"],
        ),
        (
            lambda: simulate_closed_loop(PIController(small_plant()), small_plant(), [(26.0, 200.0)]),
            ["t_surface to 26   from 25: settles in ", "verdict           settled"],
        ),
        (
            lambda: Controller(small_plant()),
            ["regulates         t_surface", "by                drive -1 to 1"],
        ),
    ],
)
def test_results_are_shown_in_twelve_lines_at_most(shown, says) -> None:
    made = shown()
    assert len(repr(made).splitlines()) <= 12
    for words in says:
        assert words in repr(made)
    assert made._repr_html_().count("<tr>") >= len(repr(made).splitlines()) - 1
