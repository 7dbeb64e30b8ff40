"""effusivity, train, classify, materials: what reaches the rooms, what is printed, written and answered."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.cli.conftest import Bench, StandIn, shares, words_of
from thermogrip.classify.decisions.predict import Answer, Note
from thermogrip.cli import classify as verb
from thermogrip.cli.classify import SHOWN, say_names, touched_part, training_part
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps, make_grasps
from thermogrip.report.console import Console, short
from thermogrip.sysid.contact.materials import load_materials
from thermogrip.sysid.effusivity.posterior import EffusivityRow

QUALITY = "thermogrip.sysid.effusivity.quality"


def record_of(ids: Sequence[str], name: str = "mine", **columns: Any) -> Grasps:
    traces = np.full((len(ids), 3), 23.0)
    return make_grasps([-1.0, 0.0, 1.0], traces, list(ids), name=name, **columns)


def effusivity_row(name: str, value: float) -> EffusivityRow:
    return EffusivityRow(name, value, value / 2, 2 * value, 28.0, 27.0, 29.0, 500.0, 0.1)


def of_files(stand_in: StandIn, records: Callable[[], list[Grasps]]) -> None:
    """Let the files of the bench hold these records, one each, whatever is given."""
    files = [Path("grasps.csv"), Path("more.csv")]

    def read(path: Path, *, name: str | None) -> Grasps:
        return records()[files.index(Path(path.name))]

    stand_in("thermogrip.cli.grasp_arguments.list_grasp_files", lambda paths: files[: len(records())])
    stand_in("thermogrip.datasets.grasp_files.read_grasps", read)


@pytest.fixture
def gripper(bench: Bench, stand_in: StandIn) -> SimpleNamespace:
    """Return a bench whose grasps, calibration and posteriors are stand-ins."""

    def quality(record: Grasps, *, longest: float) -> SimpleNamespace:
        n = record.sizes["grasp"]
        why = made.why[:n] or [""] * n
        usable = np.array([not reason for reason in why])
        kept = record if usable.all() else record.isel(grasp=usable) if usable.any() else None
        shortened = np.arange(n) < (made.shortened if longest == 9.0 else n)
        return SimpleNamespace(reason=why, shortened=shortened, read=lambda _: kept)

    made = SimpleNamespace(bench=bench, why=[], shortened=0, rested=False)
    made.records = [record_of(["a", "b"], "one"), record_of(["c"], "two")]
    of_files(stand_in, lambda: made.records)
    made.warned = stand_in("thermogrip.cli.options.warn_of_contacts")
    made.calibrated = stand_in("thermogrip.cli.classify.calibrated_device", ("device", "coupling", 9.0))
    stand_in(
        "thermogrip.sysid.effusivity.multi_touch.rested_long",
        lambda record, _: np.full(record.sizes["grasp"], made.rested),
    )
    made.ranged = stand_in("thermogrip.sysid.effusivity.data.with_object_range", lambda record, _: record)
    stand_in(f"{QUALITY}.check_grasps", quality)
    made.posteriors = stand_in(
        "thermogrip.sysid.effusivity.posterior.effusivity_posterior",
        lambda device, record, coupling: [effusivity_row(str(n), 1e3) for n in record["grasp"].values],
    )
    made.explained = stand_in(
        "thermogrip.classify.decisions.predict.unexplained_effusivities",
        lambda device, record, *_: (
            {"a": (4.5, "odd"), "b": (-0.25, "")} if "a" in record["grasp"].values else {}
        ),
    )
    return made


def test_effusivities_are_printed_written_and_answered(gripper: SimpleNamespace) -> None:
    words = ["effusivity", "grasps.csv", "--out", "e.csv", "--object-range", "0,12", "--seed", "4"]
    done = gripper.bench.run(*words, "--calibrate", "more.csv")
    assert done.code == 0, done
    assert gripper.calibrated[0].args[1:] == (["more.csv"], 4)
    assert [call.args[1] for call in gripper.ranged] == [(0.0, 12.0)] * 2
    assert (gripper.posteriors[0].args[0], gripper.posteriors[0].coupling) == ("device", "coupling")
    explained = gripper.explained[0].args
    assert (explained[0], explained[1] is gripper.records[0]) == ("device", True)
    assert [call.args[1] for call in gripper.warned] == [[record] for record in gripper.records]
    said = words_of(done.out)
    assert "a 1000 500 2000 28" in said
    assert said.endswith("odd: a wrote e.csv")
    assert "so no effusivity" not in said
    assert shares(done.err, "effusivity") == [0, 50, 100]
    with (gripper.bench.path / "e.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["grasp_id"] for row in rows] == ["a", "b", "c"]
    assert (rows[0]["effusivity"], rows[0]["effusivity_p95"], rows[0]["h_c"]) == ("1000", "2000", "500")
    assert [row["misfit_sd"] for row in rows] == ["4.5", "-0.25", "nan"]
    answer = json.loads(gripper.bench.run(*words, "--json").out)
    assert gripper.calibrated[1].args[1] == []
    assert answer["grasps"][2] == asdict(effusivity_row("c", 1e3)) | {"misfit_sd": None}
    assert (answer["without_contact"], answer["unexplained"], answer["out"]) == ([], {"a": "odd"}, "e.csv")


def test_grasps_may_be_a_pattern_and_are_not_written_over(gripper: SimpleNamespace) -> None:
    run, path = gripper.bench.run, gripper.bench.path
    assert run("effusivity", "gr?sps*.csv", "--out", "e.csv").code == 0
    assert run("effusivity", *sorted(path.glob("grasps*.csv")), "--out", "f.csv").code == 0  # by the shell
    assert (path / "f.csv").read_text() == (path / "e.csv").read_text()
    assert run("effusivity", "grasps_meta.csv", "--out", "e.csv").code == 2
    assert run("effusivity", "gr?ps*.csv", "--out", "e.csv").code == 2
    files = {each: each.read_bytes() for each in path.glob("*.csv")}
    for out in ("grasps.csv", "grasps_meta.csv", "grasps2.csv"):
        done = run("effusivity", "grasps*.csv", "--out", out)
        assert (done.code, len(done.said)) == (2, 1)
        assert f"{out}: is to be read and written; choose another name or folder" in done.said[0]
    assert run("effusivity", "more.csv", "--calibrate", "grasps.csv", "--out", "grasps.csv").code == 2
    assert {each: each.read_bytes() for each in path.glob("*.csv")} == files


def test_a_grasp_without_a_contact_has_no_effusivity(gripper: SimpleNamespace) -> None:
    gripper.why = ["no contact", ""]
    done = gripper.bench.run("effusivity", "grasps.csv", "--out", "e.csv")
    assert "no contact, so no effusivity: a, c\n" in done.out
    words = ["effusivity", "grasps.csv", "--out", "e.csv", "--report", "e.html", "--json"]
    answer = json.loads(gripper.bench.run(*words).out)
    assert "1 of 3 grasps have an effusivity." in (gripper.bench.path / "e.html").read_text()
    assert answer["without_contact"] == ["a", "c"]
    first = answer["grasps"][0]
    unknown = {key for key, value in first.items() if value is None}
    assert set(first) - {"grasp_id"} == unknown
    assert answer["grasps"][1]["effusivity"] == 1000.0
    assert len(gripper.posteriors) == 2  # of the first record alone, twice


def test_a_block_in_two_files_is_warned_of(gripper: SimpleNamespace) -> None:
    gripper.records = [
        record_of(["a", "b"], "one", touch_group=["x", "x"], touch=[1.0, 2.0]),
        record_of(["c"], "two", touch_group=["x"], touch=[1.0]),
    ]
    done = gripper.bench.run("effusivity", "grasps.csv", "--out", "e.csv")
    assert "touch_group 'x' is in one and in two" in done.err


@pytest.mark.parametrize(("out", "kept"), [("e.csv", []), ("e.parquet", []), ("e", ["grasps.csv"])])
def test_an_end_leaves_whole_tables_alone(
    out: str, kept: list[str], gripper: SimpleNamespace, stand_in: StandIn
) -> None:
    def ended(device: Any, record: Grasps, coupling: Any) -> list[EffusivityRow]:
        if "c" in record["grasp"].values:
            raise KeyboardInterrupt
        return [effusivity_row(str(n), 1e3) for n in record["grasp"].values]

    stand_in("thermogrip.sysid.effusivity.posterior.effusivity_posterior", ended)
    before = {*gripper.bench.path.iterdir()}
    assert gripper.bench.run("effusivity", "grasps.csv", "--out", out).code == 130
    folder = gripper.bench.path / out
    assert {*gripper.bench.path.iterdir()} - before == ({folder} if kept else set())
    assert [path.name for path in folder.glob("*")] == kept
    for name in kept:
        assert [line.split(",")[0] for line in (folder / name).read_text().splitlines()][1:] == ["a", "b"]


def test_answers_as_parquet_and_in_a_folder_are_those_of_the_table(gripper: SimpleNamespace) -> None:
    for out in ("e.csv", "e.parquet", "e"):
        assert gripper.bench.run("effusivity", "grasps.csv", "--out", out).code == 0
    table = pd.read_csv(gripper.bench.path / "e.csv")
    pd.testing.assert_frame_equal(pd.read_parquet(gripper.bench.path / "e.parquet"), table, check_dtype=False)
    each = [pd.read_csv(gripper.bench.path / "e" / name) for name in ("grasps.csv", "more.csv")]
    pd.testing.assert_frame_equal(pd.concat(each, ignore_index=True), table)


@pytest.mark.parametrize(("n", "more"), [(SHOWN, ""), (SHOWN + 2, "... and 2 more in the file\n")])
def test_a_long_table_is_cut_with_a_note(n: int, more: str, gripper: SimpleNamespace) -> None:
    gripper.records = [record_of([f"g{k:03d}" for k in range(n)])]
    out = gripper.bench.run("effusivity", "grasps.csv", "--out", "e.csv").out
    assert out.count("g0") == SHOWN
    assert out.count(more) == 1 or not more
    assert ("more in the file" in out) == bool(more)
    gripper.why = ["no contact"] * n
    out = gripper.bench.run("effusivity", "grasps.csv", "--out", "e.csv").out
    names = ", ".join(f"g{k:03d}" for k in range(SHOWN))
    assert f"no contact, so no effusivity: {names}{' and 2 more' if more else ''} wrote" in words_of(out)


@pytest.mark.parametrize(
    ("text", "words"),
    [("warm", "is no range; write 0,12"), ("1,2,3", "is no range"),
     ("5,5", "is empty; give the lower end first"), ("9,1", "is empty"), ("nan,1", "is empty")],
)  # fmt: skip
def test_a_range_that_is_none_is_refused(text: str, words: str, bench: Bench) -> None:
    done = bench.run("effusivity", "grasps.csv", "--object-range", text, "--out", "e.csv")
    assert (done.code, len(done.said), words in done.said[0]) == (2, 1, True)


def test_a_record_says_which_contacts_lasted_longer_than_those_that_taught(gripper: SimpleNamespace) -> None:
    words = ["effusivity", "grasps.csv", "--out", "e.csv"]
    assert "warning" not in gripper.bench.run(*words).err
    gripper.shortened, gripper.rested = 1, True
    said = gripper.bench.run(*words).err
    assert "one: 1 of 2 contacts are read until 9 s" in said
    assert "two: blocks that rested longer" in said


def test_a_gripper_is_the_bundled_one_or_calibrated_on_what_touched(
    stand_in: StandIn, capsys: pytest.CaptureFixture[str]
) -> None:
    stand_in("thermogrip.sysid.effusivity.gripper_model.load_default_gripper", "bundled")
    assert verb.calibrated_device(Console(), [], 4) == ("bundled", None, 40.0)
    assert "warning: the bundled gripper's calibration is used; give --calibrate" in capsys.readouterr().err

    mine = SimpleNamespace(unlisted=["soap"])

    def calibrate(*_: Any, progress: Any, **__: Any) -> SimpleNamespace:
        progress(0.5, "fit")
        return mine

    records = [record_of(["a"]), record_of(["b"], touch_group=["p"]), record_of(["c"], touch_group=["q"])]
    read = stand_in("thermogrip.cli.grasp_arguments.read_grasp_files", records)
    warned = stand_in("thermogrip.cli.options.warn_of_contacts")
    touched = stand_in("thermogrip.cli.classify.touched_part", lambda console, given: given)
    asked = stand_in("thermogrip.sysid.effusivity.calibration.calibrate_gripper", calibrate)
    learnt = stand_in(
        "thermogrip.sysid.effusivity.multi_touch.learn_coupling", lambda *_, start: (start or 0) + 1
    )
    longest = stand_in(f"{QUALITY}.longest_contact", 12.0)
    assert verb.calibrated_device(Console(), ["x.csv"], 4) == (mine, 2, 12.0)
    assert (read[0].args, warned[0].args[1], touched[0].args[1]) == ((["x.csv"],), records, records)
    assert (asked[0].args, asked[0].seed, longest[0].args) == ((records,), 4, (records,))
    assert [(call.args, call.start) for call in learnt] == [
        ((mine, records[1]), None),
        ((mine, records[2]), 1),
    ]
    said = capsys.readouterr().err
    assert shares(said, "calibrate") == [50]
    assert "warning: soap: not in the materials table, learnt from its grasps" in said


@pytest.mark.parametrize(
    ("split", "given", "kept"),
    [
        (["train", "test", "train"], None, ["g0", "g2"]),
        (["train", "test", "train"], "train", ["g0", "g2"]),
        (["train", "test", "train"], "all", ["g0", "g1", "g2"]),
        (["train", ""], None, ["g0"]),
        (["", ""], None, ["g0", "g1"]),
        (["", ""], "all", ["g0", "g1"]),
        (None, None, ["g0", "g1"]),
    ],
)
def test_what_is_marked_train_teaches_or_all_where_nothing_is(
    split: list[str] | None, given: str | None, kept: list[str]
) -> None:
    columns = {} if split is None else {"split": split}
    record = record_of([f"g{k}" for k in range(len(split or "ab"))], **columns)
    [part] = training_part(Console(), [record], given)
    assert part["grasp"].values.tolist() == kept


def test_a_file_without_training_grasps_is_left_out_and_reported(capsys: pytest.CaptureFixture[str]) -> None:
    test, train = record_of(["a"], split=["test"]), record_of(["a"], split=["train"])
    assert len(training_part(Console(), [test, train], None)) == 1
    assert "mine: no grasp is marked train, it is left out" in capsys.readouterr().err
    with pytest.raises(UserError, match="no grasp is marked train; use --split all"):
        training_part(Console(), [test], None)
    with pytest.raises(UserError, match="mine: has no split; fill the column split, or use --split all"):
        training_part(Console(), [record_of(["a"])], "train")


def test_grasps_without_contact_do_not_teach(capsys: pytest.CaptureFixture[str]) -> None:
    time = np.arange(-8, 41) / 4.0
    rise = 23.0 + 8.0 * -np.expm1(-np.maximum(time, 0.0))
    still = np.full(time.size, 23.0)
    record = make_grasps(time, [rise, still, still], ["a", "b", "c"], t_object=[43.0] * 3, name="mine")
    [part] = touched_part(Console(), [record, record.isel(grasp=[1])])
    assert part["grasp"].values.tolist() == ["a"]
    assert "mine: 2 left out: no contact" in capsys.readouterr().err
    with pytest.raises(UserError, match="no grasp shows a contact"):
        touched_part(Console(), [record.isel(grasp=[1, 2])])


@pytest.fixture
def school(bench: Bench, stand_in: StandIn, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Return a bench whose classifiers are stand-ins."""
    model = SimpleNamespace(notes_=("few of wood",), classes_=["iron", "wood"], check_installed=lambda: None)
    made = SimpleNamespace(bench=bench, model=model, fitted=[], saved=[])
    model.fit = made.fitted.append
    made.record = record_of(["a", "b", "c"], split=["train", "train", "test"])
    made.read = stand_in("thermogrip.cli.grasp_arguments.read_grasp_files", lambda paths: [made.record])
    made.warned = stand_in("thermogrip.cli.options.warn_of_contacts")
    stand_in("thermogrip.cli.classify.touched_part", lambda console, records: records)
    made.asked = stand_in("thermogrip.classify.estimators.registry.make_classifier", model)
    made.can = stand_in("thermogrip.classify.estimators.registry.can_be_saved", lambda _: made.savable)
    made.written = stand_in("thermogrip.classify.estimators.registry.save_classifier")
    made.savable = True
    return made


def test_a_classifier_is_trained_saved_and_reported(school: SimpleNamespace, stand_in: StandIn) -> None:
    words = ["train", "grasps.csv", "--classifier", "bayes", "--out", "m"]
    done = school.bench.run(*words, "--quick", "--seed", "4", "--split", "all")
    assert (done.code, done.out) == (0, "trained bayes on 3 grasps of iron, wood; wrote m\n"), done
    assert (school.asked[0].args, school.asked[0].quick, school.asked[0].seed) == (("bayes",), True, 4)
    assert (school.fitted[0], school.written[0].args) == ([school.record], (school.model, Path("m")))
    assert "warning: few of wood" in done.err
    assert shares(done.err, "train") == [0]
    found = json.loads(school.bench.run(*words, "--json").out)
    assert found == {
        "classifier": "bayes", "grasps": 2, "materials": ["iron", "wood"], "stop_sure": None, "out": "m",
    }  # fmt: skip
    assert (school.asked[1].quick, school.asked[1].seed) == (False, 0)
    saved: list[Path] = []
    rule = SimpleNamespace(sure=0.9876, save=saved.append)
    stand_in("thermogrip.classify.evaluation.splits.scored_apart", lambda record: False)
    learnt = stand_in("thermogrip.classify.decisions.stopping_rule.learn_stop_rule", rule)
    done = school.bench.run(*words, "--stop-error", "0.1")
    assert "a contact ends once a material has probability 0.988 (--early, --stop-early)\n" in done.out
    assert (learnt[0].args[0], learnt[0].error, saved) == (school.model, 0.1, [Path("m/stop_rule.json")])
    assert json.loads(school.bench.run(*words, "--stop-error", "0.1", "--json").out)["stop_sure"] == 0.9876
    school.savable = False
    refused = school.bench.run(*words)
    assert (refused.code, "bayes cannot be saved as data alone; compare it" in refused.said[0]) == (2, True)


def test_a_stop_rule_is_learnt_from_grasps_of_known_temperature(
    school: SimpleNamespace, stand_in: StandIn
) -> None:
    def learn(*_: Any, progress: Any, **__: Any) -> SimpleNamespace:
        progress(0.5, "fold")
        return SimpleNamespace(sure=0.9, save=lambda _: None)

    asked = stand_in("thermogrip.classify.decisions.stopping_rule.learn_stop_rule", learn)
    stand_in("thermogrip.classify.evaluation.splits.scored_apart", lambda record: record is apart)
    known, apart = records = [record_of(["a"]), record_of(["b"])]
    stand_in("thermogrip.cli.grasp_arguments.read_grasp_files", lambda paths: records)
    words = ["train", "grasps.csv", "--classifier", "bayes", "--split", "all", "--stop-error", "0.1"]
    done = school.bench.run(*words, "--out", "m")
    ((model, (learnt_from,)),) = [call.args for call in asked]
    assert (model is school.model, learnt_from is known, asked[0].error) == (True, True, 0.1)
    assert shares(done.err, "stop rule") == [50]
    del records[0]
    refused = school.bench.run(*words, "--out", "m").said[0]
    assert "no training grasp has an object temperature; leave --stop-error out" in refused


ANSWERS = (
    Answer(
        grasp_id="a", material="iron", probabilities={"iron": 0.75, "wood": 0.25}, p_unknown=0.125,
        decided_at=9.0, misfit_sd=4.5, deviates="too cold for iron",
        notes=(Note("far", "far"), Note("odd", "odd")),
    ),
    Answer(
        grasp_id="b", material="", probabilities={"iron": None, "wood": None}, p_unknown=None, decided_at=8.0,
        notes=(Note("readings", "no contact"),),
    ),
)  # fmt: skip


@pytest.fixture
def named(bench: Bench, stand_in: StandIn) -> SimpleNamespace:
    """Return a bench whose classifier and its answers are stand-ins."""
    made = SimpleNamespace(bench=bench, record=record_of(["a", "b"]), model="a model")
    (bench.path / "m").mkdir()
    verb._answerer.cache_clear()
    of_files(stand_in, lambda: [made.record])
    stand_in("thermogrip.cli.grasp_arguments.read_grasp_files", lambda paths: [made.record])
    made.warned = stand_in("thermogrip.cli.options.warn_of_contacts")
    made.ranged = stand_in("thermogrip.sysid.effusivity.data.with_object_range", lambda *_: "ranged")
    made.loaded = stand_in("thermogrip.classify.estimators.registry.load_classifier", lambda _: made.model)
    made.rules = stand_in("thermogrip.classify.decisions.stopping_rule.load_stop_rule", "a rule")
    made.asked = stand_in(
        "thermogrip.classify.decisions.predict.answer_record", lambda *_, **__: ([*ANSWERS], "quality")
    )
    return made


def test_answers_are_printed_written_and_answered(named: SimpleNamespace) -> None:
    words = ["classify", "m", "grasps.csv", "--out", "p.csv"]
    done = named.bench.run(*words, "--materials", "iron,wood", "--object-range", "0,12")
    assert done.code == 0, done
    [asked] = named.asked
    assert asked.args == ("a model", named.record, ("iron", "wood"), None, (0.0, 12.0))
    assert not asked.nearest
    assert named.loaded[0].args == (Path("m"),)
    assert named.warned[0].args[1:] == ([named.record], ["quality"])
    said = words_of(done.out)
    assert "grasp material p nearest p unknown decided at [s]" in said
    assert "a iron 0.75 0.125 9 b - - 8" in said
    assert said.count("far; odd: a no contact, so no name: b") == 1
    assert said.endswith(": too cold for iron wrote p.csv")
    assert (named.bench.path / "p.csv").read_text().splitlines()[1].startswith("a,iron,0.75,0.25,0.125,9")
    answer = json.loads(named.bench.run(*words, "--json").out)
    assert answer == {
        "grasps": [one.row() for one in ANSWERS], "strange": {"a": "too cold for iron"}, "out": "p.csv"
    }  # fmt: skip
    assert (answer["grasps"][0]["note"], answer["grasps"][0]["note_codes"]) == ("far; odd", "far odd")
    assert named.bench.run(*words, "--nearest").code == 0
    assert named.asked[-1].nearest


def test_a_single_grasp_is_named(named: SimpleNamespace, stand_in: StandIn) -> None:
    one = replace(ANSWERS[0], deviates="", notes=())
    stand_in("thermogrip.classify.decisions.predict.answer_record", ([one], "quality"))
    done = named.bench.run("classify", "m", "grasps.csv", "--early", "--out", "p.csv")
    assert (done.code, "a iron 0.75 0.125 9 wrote p.csv" in words_of(done.out)) == (0, True), done
    verb._answerer.cache_clear()
    stand_in(
        "thermogrip.classify.decisions.predict.answer_record",
        ([replace(one, material="unknown", p_unknown=0.625)], "quality"),
    )
    done = named.bench.run("classify", "m", "grasps.csv", "--early", "--out", "p.csv")
    assert "a unknown, nearest iron 0.75 0.625 9 wrote p.csv" in words_of(done.out)


@pytest.mark.parametrize(
    "words", [[], ["grasps.csv"], ["--out", "p.csv"], ["grasps.csv", "--out", "p.csv", "--serve"],
              ["--serve", "--out", "p.csv"], ["grasps.csv", "--out", "p.csv", "--port", "0"]]
)  # fmt: skip
def test_grasps_come_from_files_or_from_requests(words: list[str], named: SimpleNamespace) -> None:
    refused = named.bench.run("classify", "m", *words)
    assert (refused.code, "give GRASPS and --out, or --serve alone" in refused.said[0]) == (2, True)


def test_requests_are_answered_by_lines_or_over_http(named: SimpleNamespace, stand_in: StandIn) -> None:
    lines = stand_in("thermogrip.classify.decisions.serve.serve_lines")
    ran: list[Any] = []
    served = stand_in(
        "thermogrip.classify.decisions.serve.server", SimpleNamespace(run=lambda sockets: ran.extend(sockets))
    )
    assert named.bench.run("classify", "m", "--serve", "--materials", "iron,wood").code == 0
    assert lines[0].args[0](named.record)[0]["material"] == "iron"
    assert named.asked[0].args[2] == ("iron", "wood")
    done = named.bench.run("classify", "m", "--serve", "--port", "0")
    assert (done.code, ran == [served[0].args[1]]) == (0, True), done
    assert f"answers at http://127.0.0.1:{ran[0].getsockname()[1]}/\n" in done.err
    ran[0].close()
    refused = named.bench.run("classify", "m", "--serve", "--workers", "2")
    assert (refused.code, "leave --workers and --cluster out" in refused.said[0]) == (2, True)
    stand_in("thermogrip.cli.classify.find_spec")
    refused = named.bench.run("classify", "m", "--serve", "--port", "0")
    assert (refused.code, "thermogrip[live]" in refused.said[0]) == (2, True)


@pytest.mark.parametrize(("n", "more"), [(1, ""), (SHOWN, ""), (SHOWN + 1, " and 1 more")])
def test_grasps_of_one_note_are_named_in_one_line_up_to_a_number(
    n: int, more: str, capsys: pytest.CaptureFixture[str]
) -> None:
    say_names(Console(), [*(("no contact", f"g{k}") for k in range(n)), ("short", "h")])
    names = ", ".join(f"g{k}" for k in range(min(n, SHOWN)))
    assert words_of(capsys.readouterr().out) == words_of(f"no contact: {names}{more} short: h")


def test_materials_are_listed_by_their_effusivity(bench: Bench) -> None:
    known = load_materials()
    done = bench.run("materials")
    assert words_of(done.out).startswith(f"{len(known)} materials, effusivity in W s^0.5 m^-2 K^-1")
    # a row a material where no terminal reads
    names = [line.split("  ")[0] for line in done.out.splitlines()]
    assert set(known) <= set(names)
    listed = json.loads(bench.run("materials", "--json").out)["materials"]
    assert [row["effusivity"] for row in listed] == sorted(m.effusivity for m in known.values())
    copper = known["copper"]
    said = words_of(bench.run("materials", "copper").out)
    assert said.startswith("1 material, effusivity")
    sd = 100 * copper.effusivity_sd_ln
    shown = map(short, (copper.k, copper.rho, copper.c_p, copper.effusivity, sd))
    assert f"copper {' '.join(shown)} " in said
    assert json.loads(bench.run("materials", "copper", "--json").out) == {
        "materials": [asdict(copper) | {"aliases": list(copper.aliases)}]
    }
