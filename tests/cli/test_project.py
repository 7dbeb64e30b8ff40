"""demo, paper, init: what reaches the studies, and what is printed and answered."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.cli.conftest import Bench, StandIn, shares
from tests.mpc.makers import network_plant
from thermogrip.cli.project import copy_examples
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import example_grasps, example_path
from thermogrip.mpc.design.spec import Spec, read_spec
from thermogrip.report.html import Section
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.network_spec import builtin_networks


def test_the_demo_prints_its_verdicts_and_where_its_report_is(bench: Bench, stand_in: StandIn) -> None:
    def demo(*_: Any, progress: Any, **__: Any) -> Any:
        progress(0.5, "identify")
        return SimpleNamespace(
            sections=(Section("Fits?", (), "It fits."), Section("More", ())), report="r.html"
        )

    ran = stand_in("thermogrip.studies.demo.run_demo", demo)
    models = stand_in("thermogrip.studies.demo.compared_models", ({}, ("left out: lstm",)))
    done = bench.run("demo", "--out", "d", "--seed", "4", "--workers", "3")
    assert (done.code, done.out) == (0, "Fits?\n    It fits.\nreport: r.html\n")
    assert "warning: left out: lstm" in done.err
    assert shares(done.err, "demo") == [50]
    assert (ran[0].args, ran[0].seed, ran[0].workers, models[0].args) == ((Path("d"),), 4, 3, (4,))
    assert (bench.path / "d").is_dir()
    done = bench.run("demo", "--json")
    assert json.loads(done.out) == {"report": "r.html", "verdicts": {"Fits?": "It fits."}}
    assert (ran[1].args, ran[1].seed, ran[1].workers) == ((Path("thermogrip-demo"),), 0, 2)


@pytest.mark.parametrize(
    ("what", "key"),
    [("spec", "settle_within_s"), ("network", "[nodes]"), ("topics", "topic"), ("guard", "stale_s")],
)
def test_a_template_is_printed_or_written_once(what: str, key: str, bench: Bench) -> None:
    path = bench.path / "new" / f"{what}.toml"
    shown = bench.run("init", what)
    assert (shown.code, key in shown.out) == (0, True)
    done = bench.run("init", what, "--out", path)
    assert (done.code, done.out) == (0, f"wrote {path}\n")
    assert path.read_text() == shown.out
    assert json.loads(bench.run("init", what, "--json").out) == {
        "template": what, "text": path.read_text(), "out": None,
    }  # fmt: skip
    again = bench.run("init", what, "--out", path)
    assert (again.code, again.said) == (
        2, [f"thermogrip: {path}: exists already; remove it or choose another name"],
    )  # fmt: skip
    assert bench.run("init", what, "--out", bench.path / "x.txt").code == 2


@pytest.mark.parametrize("name", builtin_networks())
def test_a_network_starts_from_a_shipped_one(name: str, bench: Bench) -> None:
    done = bench.run("init", "network", "--like", name, "--out", "mine.toml")
    assert (done.code, done.out) == (0, "wrote mine.toml\n")
    assert load_network("mine.toml").name == name
    assert (bench.path / "mine.toml").read_text().startswith("# ")  # it says what it is
    assert name in " ".join(bench.run("init", "--help").out.split())


def test_a_spec_like_a_plant_is_what_tune_takes_for_it(bench: Bench) -> None:
    plant = network_plant("tclab", t1=(24.0, 64.0), t2=(26.0, 70.0))
    plant.save("plant.json")
    done = bench.run("init", "spec", "--like", "plant.json", "--out", "spec.toml")
    then = "next: thermogrip tune plant.json --spec spec.toml --out controller.json\n"
    assert (done.code, done.err) == (0, then)
    assert read_spec("spec.toml") == Spec.of(plant) != Spec()


def test_what_is_like_no_network_is_refused(bench: Bench) -> None:
    bench.run("init", "network", "--out", "mine.toml")
    for words, says in (
        ("network --like oven", "--like 'oven' is unknown; use furnace"),
        ("guard --like tank", "not of guard"),
        ("spec --like plnt.json", "no such file"),
        ("spec --like mine.toml", "is a thermal network, not a plant; give plant.json of identify"),
    ):
        done = bench.run("init", *words.split())
        assert (done.code, len(done.said)) == (2, 1)
        assert says in done.said[0]


def test_the_examples_come_out_ready_to_use(bench: Bench) -> None:
    done = bench.run("init", "examples", "--out", "here", "--json")
    answer = json.loads(done.out)
    assert (answer["template"], answer["out"]) == ("examples", "here")
    files = [Path(name) for name in answer["files"]]
    assert all(path.is_file() for path in files)
    assert {path.parent for path in files} == {Path("here"), Path("here/grasps")}
    sets = [path for path in files if path.parent.name == "grasps" and "_meta." not in path.name]
    assert bench.run("init", "examples", "--out", "here").out.splitlines() == [
        f"4 logs in here, {len(sets)} sets of grasps in here/grasps",
        "simulated, not measured; described in here/EXAMPLES.md",
    ]
    assert Path("here/EXAMPLES.md").is_file()
    assert bench.run("init", "examples").code == 0
    assert Path("EXAMPLES.md").is_file()


@pytest.mark.slow
def test_warm_up_says_where_the_compiled_code_is_kept(bench: Bench) -> None:
    from thermogrip.sysid.contact.time_stepping import step_contacts

    done = bench.run("warm-up", "--json")
    answer = json.loads(done.out)
    assert done.code == 0
    assert answer["kept_in"] == step_contacts.stats.cache_path
    assert list(Path(answer["kept_in"]).glob("time_stepping.step_contacts-*.nbc"))
    assert "kept in" in bench.run("warm-up").out


def test_the_copied_examples_are_the_bundled_ones_byte_for_byte(tmp_path):
    paths = copy_examples(tmp_path / "new" / "folder")
    for path in paths[:-1]:
        assert path.read_bytes() == (example_path("multisine").parent / path.name).read_bytes()
    folders = {path.parent.relative_to(tmp_path / "new").as_posix() for path in paths}
    assert folders == {"folder", "folder/grasps"}
    assert len(paths) == 4 + 2 * len(example_grasps()) + 1
    assert paths[-1].read_text(encoding="utf-8").count("`prbs_heating_cooling`") == 1


def test_copied_examples_never_replace_a_file_of_the_user(tmp_path):
    mine = tmp_path / "pump_on_off.csv.xz"
    mine.write_text("mine", encoding="utf-8")
    with pytest.raises(UserError, match="another file of this name"):
        copy_examples(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [mine.name]
    assert mine.read_text(encoding="utf-8") == "mine"
    mine.unlink()
    assert copy_examples(tmp_path) == copy_examples(tmp_path)
