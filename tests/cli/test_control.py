"""tune, review, export: what reaches the room, what is printed and answered, and the exit code."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.cli.conftest import Bench, StandIn, shares, words_of
from tests.end_to_end.conftest import small_plant
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.controllers.export import Agreement, Export
from thermogrip.mpc.controllers.mpc import Controller
from thermogrip.mpc.tuning.design_review import Check
from thermogrip.mpc.tuning.tune import Row

ROW = Row("tuned", 28.0, 38.0, 90.0, 95.0, 0.1, 0.2, 0.01, 7.0, 2.0, 0.5, 80.0)
ROWS = (("tuned", "28 to 38", 90.0, 95.0, 0.1, 0.2, 0.01, 7.0, 80.0),)


def test_an_interrupted_tuning_is_written_and_ends_with_130(bench: Bench, stand_in: StandIn) -> None:
    found = SimpleNamespace(
        save=lambda out: out.write_text("{}"), verdict="tuned", finding="faster", meets_spec=True, checks=(),
        scores={"tuned": 1.5}, rows=(ROW,), interrupted=True, controller=None,
    )  # fmt: skip
    stand_in("thermogrip.mpc.tuning.tune.tune", found)
    stand_in("thermogrip.report.control.tuning_table", (tuple("abcdefghi"), ROWS))
    stand_in("thermogrip.report.control.tuning_caption", "Closed loops on 5 draws of the plant")
    done = bench.run("tune", "plant.json", "--out", "c.json")
    assert (done.code, Path("c.json").exists()) == (130, True)
    assert "wrote c.json" in words_of(done.out)


@pytest.mark.parametrize(
    ("spec", "error", "says"),
    [
        ("spec.toml", UserError("steps: too hot", hint="cooler"), "spec.toml: steps: too hot; cooler"),
        (
            "spec.toml",
            UserError("energy_price without zones", hint="add"),
            "spec.toml: energy_price without zones; add",
        ),
        ("spec.toml", UserError("steps: too hot", file="p.json"), "p.json: steps: too hot"),
        ("spec.toml", UserError("no drive: none"), "no drive: none"),
        (None, UserError("steps: too hot"), "steps: too hot"),
    ],
)
def test_an_error_about_a_key_of_the_spec_names_its_file(
    spec: str | None, error: UserError, says: str, bench: Bench, stand_in: StandIn
) -> None:
    bench.write("spec.toml", "steps = [[25, 29]]\n")
    stand_in("thermogrip.mpc.tuning.tune.tune", error)
    done = bench.run("tune", "plant.json", *(("--spec", spec) if spec else ()), "--out", "c.json")
    assert (done.code, done.said) == (2, [f"thermogrip: {says}"])


@pytest.fixture
def controller(bench: Bench) -> Bench:
    """Return a bench with the file of a controller."""
    Controller(small_plant()).save(bench.path / "c.json")
    return bench


@pytest.mark.parametrize(
    ("options", "difference", "code"), [([], None, 0), (["--check"], 1e-12, 0), (["--check"], 0.1, 3)]
)
def test_an_export_is_compared_with_python_only_where_that_is_asked_for(
    options: list[str], difference: float | None, code: int, controller: Bench, stand_in: StandIn
) -> None:
    def check(written: Export, loaded: Controller, *, states: int, progress: Any, **_: Any) -> Agreement:
        progress(0.25, "gcc")
        return replace(made, states=states)

    made = Agreement(1, difference, 5, 7, 100, 640, 128, 50)
    written = Export(Path("c"), ("a.c", "b.h"))
    exported = stand_in("thermogrip.mpc.controllers.export.export_controller", written)
    asked = stand_in("thermogrip.mpc.controllers.export.check_export", check)
    words = ["export", "c.json", "--out", "c", "--states", "7", "--seed", "9", *options]
    done = controller.run(*words)
    assert done.code == code
    assert (type(exported[0].args[0]), exported[0].args[1]) == (Controller, Path("c"))
    assert [(call.args[0], call.states, call.seed) for call in asked] == [(written, 7, 9)] * bool(options)
    first, *rest = done.out.splitlines()
    assert first == "Wrote 2 files to c."
    answer = json.loads(controller.run(*words, "--json").out)
    checked = {**asdict(replace(made, states=7)), "passed": code == 0} if options else {}
    assert answer == {"out": "c", **checked}
    if options:
        assert words_of(" ".join(rest)) == (
            f"7 samples of random loops under the sanitizers: drives differ by at most {difference:.1e} of "
            f"their range (5 of them at no limit), same status in 7. "
            "RAM of a controller 640 bytes, constants 128, flash 100, largest stack frame 50. "
            f"C and Python {'do the same' if code == 0 else 'differ'}."
        )
        assert shares(done.err, "check") == [25]
        controller.run("export", "c.json", "--out", "c", "--check")
        assert (asked[-1].states, asked[-1].seed) == (3000, 0)
    library = controller.run("export", "c.json", "--out", "c", "--arduino", *options)
    assert (library.code, exported[-1].arduino) == ((2, False) if options else (0, True))


@pytest.mark.parametrize(("verdicts", "code"), [("pass warn", 0), ("pass fail warn", 3)])
def test_a_review_is_an_answer_of_no_where_a_check_fails(
    verdicts: str, code: int, controller: Bench, stand_in: StandIn
) -> None:
    found = [Check(f"c{k}", verdict, f"found {k}", f"fix {k}") for k, verdict in enumerate(verdicts.split())]
    reviewed = stand_in("thermogrip.mpc.tuning.design_review.review", found)
    pages = stand_in("thermogrip.report.html.write_report")
    sections = stand_in("thermogrip.report.classification.review_section", "a section")
    done = controller.run("review", "c.json", "--report", "r.html")
    assert done.code == code
    assert isinstance(reviewed[0].args[0], Controller)
    lead = "The design of c.json, checked without the rig."
    assert pages[0].args == (Path("r.html"), "Design review", lead, ["a section"])
    assert sections[0].args == (found,)
    said = words_of(done.out)
    assert said.startswith("Review of c.json check verdict finding fix")
    assert "c0 pass found 0 fix 0" in said
    assert said.endswith("wrote r.html")
    assert json.loads(controller.run("review", "c.json", "--json").out) == {
        "passed": code == 0, "checks": [asdict(check) for check in found], "report": None,
    }  # fmt: skip
    assert len(pages) == 1
