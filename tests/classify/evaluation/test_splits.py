"""Who trains and who is tested: never the same grasp, never in silence."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from thermogrip.classify.estimators.base import pick
from thermogrip.classify.evaluation.splits import _alike, _copied_records, plan_folds, scored_apart
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Grasps, make_grasps

Maker = Callable[..., Grasps]


def ids(grasps: Grasps) -> set[str]:
    return set(grasps["grasp"].values.tolist())


def test_the_shipped_split_is_the_column(three: Grasps) -> None:
    [fold] = plan_folds([three]).folds
    assert ids(fold.train) == ids(pick(three, three["split"].values == "train"))
    assert ids(fold.test) == ids(pick(three, three["split"].values == "test"))
    assert fold.candidates == ("copper", "iron", "wood")


def test_random_splits_share_no_grasp_and_differ(three: Grasps) -> None:
    folds = plan_folds([three], split="random", repeats=4, train_per_class=5, seed=1).folds
    for fold in folds:
        assert ids(fold.train) | ids(fold.test) == ids(three)
        assert not ids(fold.train) & ids(fold.test)
        assert np.unique(fold.train["material"].values, return_counts=True)[1].tolist() == [5, 5, 5]
    assert len({frozenset(ids(f.test)) for f in folds}) == 4
    again = plan_folds([three], split="random", repeats=4, train_per_class=5, seed=1).folds
    assert [ids(f.test) for f in again] == [ids(f.test) for f in folds]


def test_conditions_of_one_size_are_split_differently_and_trained_on_together(make_touches: Maker) -> None:
    both = [make_touches(name=n, seed=k) for k, n in enumerate(("warm", "cold"))]
    plan = plan_folds(both, split="random", repeats=3, train_per_class=5, seed=4)
    assert [(f.condition, f.repeat) for f in plan.folds] == [
        (n, k) for n in ("warm", "cold") for k in range(3)
    ]
    places = [[i.split("-")[1] for i in f.train["grasp"].values] for f in plan.folds]
    assert all(a != b for a, b in zip(places[:3], places[3:]))
    for repeat, parts in enumerate(plan.training):
        assert [ids(part) for part in parts] == [ids(f.train) for f in plan.folds if f.repeat == repeat]
    assert len(plan.training) == 3
    of_one = pick(both[1], both[1]["material"].values == "iron")
    plan = plan_folds([both[0], of_one], split="random", repeats=1)
    assert plan.notes == ("cold: grasps of one material: left out",)
    with pytest.raises(UserError, match="0 repeats; give at least one"):
        plan_folds(both, split="random", repeats=0)
    with pytest.raises(UserError, match="0 training grasps a material; give at least one"):
        plan_folds(both, split="random", train_per_class=0)


@pytest.mark.parametrize(("split", "label"), [("shipped", "split"), ("random", "material")])
def test_touches_of_a_block_that_differ_in_what_is_split_by_are_refused(
    three: Grasps, split: str, label: str
) -> None:
    groups = np.full(three.sizes["grasp"], "", dtype="<U4")
    labels = three[label].values
    groups[[0, int(np.argmax(labels != labels[0]))]] = "torn"
    with pytest.raises(UserError, match=f"touches of 'torn' differ in {label}"):
        plan_folds([three.assign(touch_group=("grasp", groups))], split=split)


def test_a_copy_under_another_name_is_noted_where_its_samples_speak() -> None:
    """Ten values that differ do; lost samples are none."""
    rows = [np.arange(12.0) % 10, np.arange(12.0) % 9, np.where(np.arange(12) < 9, np.arange(12.0), np.nan)]
    a, b, c = (make_grasps(np.arange(12) * 0.1 - 0.5, rows, [n + i for i in "012"], name=n) for n in "abc")
    copies = _copied_records([a, b, c])
    assert list(copies) == ["b", "c"]
    assert copies["c"].startswith("1 grasp(s) have the samples of another, c0 of a/a0 first")


def test_a_copy_in_the_training_and_the_test_file_is_refused(three: Grasps, make_touches: Maker) -> None:
    copy = three.assign_coords(grasp=[f"other-{i}" for i in range(24)]).assign_attrs(name="fresh")
    with pytest.raises(
        UserError, match=r"fresh.*24 .* the samples of another, other-0 of touches/touches-0.*leave one of"
    ):
        plan_folds([three.drop_vars("split")], test=[copy])
    trainer = three.assign_coords(grasp=copy["grasp"].values).assign_attrs(name="more").drop_vars("split")
    plan = plan_folds([three, trainer], split="random", repeats=1)  # of the training: a caution
    assert [(c.code, c.condition) for c in plan.cautions] == [("leak", "more")]
    fresh = plan_folds([three], test=[make_touches(name="fresh", seed=2)])  # one training file needs no match
    assert fresh.notes == ("fresh: candidates and training grasps are those of touches",)
    strange = plan_folds([three], test=[make_touches(("zinc",), name="strange", seed=2)])
    assert strange.notes[1] == "strange: nothing to score, as no training grasp is of zinc"


def alike(name: str, materials: str, *, kin: str = "", t_object: float = 18.0, skin: float = 23.0) -> Grasps:
    """Return a record of grasps that hold still."""
    n = len(materials)
    about = {"experiment": [kin] * n, "t_object": [t_object] * n, "t_gripper": [skin] * n}
    return make_grasps(
        [0, 0.1], np.ones((n, 2)), list(materials), name=name, material=list(materials), **about
    )


@pytest.mark.parametrize(
    ("trains", "expected"),
    [
        ([alike("rich", "abc"), alike("kin", "ab", kin="e2"), alike("x", "a")], "x"),
        ([alike("rich", "abc"), alike("kin", "ab", kin="e2"), alike("y", "a", kin="e1")], "kin"),
        ([alike("poor", "ab"), alike("rich", "abc", kin="e1"), alike("later", "abd")], "rich"),
        ([alike("x", "a", t_object=18.06), alike("x", "a", skin=23.2), alike("n", "a", t_object=17.96)], "n"),
        ([alike("x", "ab", kin="e2", skin=24.0), alike("x", "ab", t_object=-18.0)], None),
        ([alike("x", "ab").drop_vars("t_object")], None),
    ],
)  # fmt: skip
def test_training_is_borrowed_at_its_temperatures_by_name_by_experiment_or_of_the_most_materials(
    trains: list[Grasps], expected: str | None
) -> None:
    found = _alike(alike("x", "z", kin="e2"), trains)
    assert (found if found is None else found.attrs["name"]) == expected
    if expected == "rich":  # no experiment is not a common one
        assert _alike(alike("w", "z"), trains).attrs["name"] == expected  # type: ignore[union-attr]


def test_a_condition_that_nobody_can_train_is_left_out_with_a_note(make_touches: Maker) -> None:
    known, cold = make_touches(name="known"), make_touches(name="cold", t_object=18.0, seed=1)
    cold = pick(cold, cold["split"].values == "test")
    wood = make_touches(name="one", t_object=33.0, seed=2)
    wood = pick(wood, (wood["material"].values == "wood") | (wood["split"].values == "test"))
    plan = plan_folds([known, cold, wood])
    assert [f.condition for f in plan.folds] == ["known"]
    assert plan.notes == (
        "cold: no training grasps, nor a condition at its temperatures: left out",
        "one: its training grasps are of one material: left out",
    )
    with pytest.raises(UserError, match=r"cold: no condition has a split .*left out; fill the column"):
        plan_folds([cold])


def test_both_touches_of_a_block_are_on_one_side(three: Grasps) -> None:
    groups = [f"p{i // 2}" for i in range(24)]
    paired = three.assign(touch_group=("grasp", groups)).drop_vars("split")
    assert scored_apart(paired)
    for fold in plan_folds([paired], split="random", repeats=5, train_per_class=2).folds:
        assert fold.apart
        assert not set(fold.train["touch_group"].values) & set(fold.test["touch_group"].values)


def test_an_unknown_object_temperature_is_scored_apart(three: Grasps) -> None:
    unknown = three.copy(deep=True)
    unknown["t_object"].values[3] = np.nan
    assert scored_apart(unknown)
    assert scored_apart(three.drop_vars("t_object"))
    assert not scored_apart(three)


def test_a_grasp_in_training_and_test_is_refused(three: Grasps) -> None:
    test = pick(three, [0, 9]).assign_attrs(name="fresh")
    with pytest.raises(
        UserError, match=r"fresh, column grasp_id: grasp_id 'touches-0' is in training \(touches\)"
    ):
        plan_folds([three], test=[test])


def test_a_record_given_twice_is_refused(three: Grasps, make_touches: Maker) -> None:
    with pytest.raises(UserError, match="two conditions are called 'touches'"):
        plan_folds([three, three])
    with pytest.raises(UserError, match="grasp touches-0 is in touches too"):
        plan_folds([three, three.assign_attrs(name="copy")])
    fresh = make_touches(name="fresh", seed=2)
    with pytest.raises(UserError, match="two conditions are called 'fresh'"):
        plan_folds([three], test=[fresh, fresh])
    with pytest.raises(UserError, match="grasp fresh-0 is in fresh too"):
        plan_folds([three], test=[fresh, fresh.assign_attrs(name="copy")])


def test_too_few_grasps_are_reported_not_dropped(three: Grasps, make_touches: Maker) -> None:
    few = make_touches(each=3, name="few", seed=4)
    plan = plan_folds([three, few], split="random", repeats=1)
    assert {f.condition for f in plan.folds} == {"touches"}
    assert "few: grasps of two materials are needed" in plan.notes[0]
    assert "copper is left out: 3 grasp(s) cannot give 5 to train and one to test" in plan.notes[0]
    with pytest.raises(UserError, match="no condition can be split; few: grasps of two materials"):
        plan_folds([few], split="random")
    with pytest.raises(UserError, match="its training grasps are of one material"):
        plan_folds([pick(three, three["material"].values == "iron")])


def test_a_material_with_too_few_grasps_is_left_out_and_the_rest_is_split(three: Grasps) -> None:
    iron = np.flatnonzero(three["material"].values == "iron")
    tiny = pick(three, np.setdiff1d(np.arange(three.sizes["grasp"]), iron[1:]))
    plan = plan_folds([tiny], split="random", repeats=2, train_per_class=3)
    assert [fold.candidates for fold in plan.folds] == [("copper", "wood")] * 2
    assert not any("iron" in fold.test["material"].values for fold in plan.folds)
    [caution] = plan.cautions
    assert (caution.code, caution.condition) == ("excluded_material", tiny.attrs["name"])
    assert caution.words == "iron is left out: 1 grasp(s) cannot give 3 to train and one to test"


def test_a_condition_without_a_test_part_only_trains(three: Grasps, make_touches: Maker) -> None:
    trainer = pick(make_touches(name="more", seed=7), np.arange(5)).assign_attrs(name="more")
    plan = plan_folds([three, trainer])
    assert len(plan.folds) == 1
    assert [g.attrs["name"] for g in plan.training[0]] == ["touches", "more"]
    assert plan.notes == ("more: no grasp is marked 'test' in its split, so it only trains",)


def test_a_test_file_is_matched_by_its_temperatures(make_touches: Maker) -> None:
    hot, cold = make_touches(name="hot"), make_touches(name="cold", t_object=18.0, seed=1)
    fresh = make_touches(name="fresh", t_object=18.0, seed=2)
    plan = plan_folds([hot, cold], test=[fresh])
    [fold] = plan.folds
    assert fold.train.attrs["name"] == "cold"
    assert fold.train.sizes["grasp"] == 15
    assert len(plan.training[0]) == 2
    with pytest.raises(UserError, match="no training condition has its object and gripper temperatures"):
        plan_folds([hot, cold], test=[make_touches(name="warm", t_object=33.0)])


def test_a_test_file_of_other_materials_borrows_the_training_of_its_temperatures(make_touches: Maker) -> None:
    known = make_touches(("copper", "wood"), name="known")
    strange = make_touches(("zinc",), name="strange", seed=3)
    strange = strange.assign(split=("grasp", np.full(8, "test")))
    plan = plan_folds([known, strange])
    assert [f.condition for f in plan.folds] == ["known", "strange"]
    assert plan.folds[1].candidates == ("copper", "wood")
    assert "those of known are used" in plan.notes[0]


@pytest.mark.parametrize(
    ("split", "message"), [("weekly", "split 'weekly' is unknown"), ("shipped", "no condition")]
)
def test_a_split_that_is_not_there_is_refused(three: Grasps, split: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        plan_folds([three.drop_vars("split")], split=split)


def test_a_session_is_held_out_in_every_condition_at_once(make_touches: Maker) -> None:
    days = ("grasp", [f"day{k % 4}" for k in range(24)])
    warm, cold = (make_touches(seed=k, name=n).assign(session=days) for k, n in enumerate(("warm", "cold")))
    plan = plan_folds([warm, cold], split="session")
    assert len(plan.folds) == 8
    for fold in plan.folds:
        held = set(fold.test["session"].values)
        assert len(held) == 1
        for part in plan.training[fold.repeat]:
            assert not held & set(part["session"].values)
    tested = [i for f in plan.folds if f.condition == "warm" for i in f.test["grasp"].values]
    assert sorted(tested) == sorted(warm["grasp"].values)  # each once


def test_a_block_is_held_out_in_every_condition_at_once(make_touches: Maker) -> None:
    blocks = ("grasp", [f"b{k % 2}" for k in range(24)])
    both = [make_touches(seed=k, name=n).assign(block=blocks) for k, n in enumerate(("warm", "cold"))]
    plan = plan_folds(both, split="block")
    assert len(plan.training) == 2
    for fold in plan.folds:
        out = set(zip(fold.test["material"].values, fold.test["block"].values))
        assert {m for m, _ in out} == {"copper", "iron", "wood"}
        for part in plan.training[fold.repeat]:
            assert not out & set(zip(part["material"].values, part["block"].values))


def test_grasps_without_a_session_or_block_are_of_their_file_or_one_block(make_touches: Maker) -> None:
    warm, cold = make_touches(name="warm"), make_touches(("iron", "zinc"), name="cold", seed=1)
    days = np.where(np.arange(24) % 4 == 0, "monday", "")
    plan = plan_folds([warm.assign(session=("grasp", days)), cold], split="session")
    held = [(f.condition, f.repeat, f.test.sizes["grasp"], f.train.sizes["grasp"]) for f in plan.folds]
    assert held == [("warm", 1, 6, 18), ("warm", 2, 18, 6)]  # cold, monday, warm
    assert [[part.sizes["grasp"] for part in parts] for parts in plan.training] == [[24], [18, 16], [6, 16]]
    assert plan.notes == ("cold: without cold too little is left to train on",)
    blocks = np.where(np.arange(24) % 3 == 0, "b1", np.where(np.arange(24) % 3 == 1, "b2", ""))
    plan = plan_folds([warm.assign(block=("grasp", blocks))], split="block", seed=3)
    out = [sorted(zip(f.test["material"].values, f.test["block"].values)) for f in plan.folds]
    assert sum(map(len, out)) == 24  # each grasp is tested once
    assert all(len(set(o)) == 3 for o in out)
    other = plan_folds([warm.assign(block=("grasp", blocks))], split="block", seed=5)
    assert [ids(f.test) for f in other.folds] != [ids(f.test) for f in plan.folds]


def test_a_split_by_what_there_is_one_of_is_refused(three: Grasps) -> None:
    with pytest.raises(UserError, match="there is one block of copper; give the column block"):
        plan_folds([three], split="block")
    with pytest.raises(UserError, match="no condition can be split by session; touches: without touches too"):
        plan_folds([three], split="session")
    torn = three.assign(touch_group=("grasp", ["g"] * 2 + [""] * 22), session=("grasp", ["a"] + ["b"] * 23))
    with pytest.raises(UserError, match="touches of 'g' differ in session"):
        plan_folds([torn], split="session")
