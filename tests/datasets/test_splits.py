"""Training and test share nothing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import make_grasps
from thermogrip.datasets.splits import by_grasp, shipped


def record(material, **labels):
    n = len(material)
    return make_grasps(
        [-0.1, 0.0, 0.1],
        np.full((n, 3), 25.0),
        [f"g{i}" for i in range(n)],
        name="made",
        material=material,
        **labels,
    )


@st.composite
def records(draw):
    """Records with unequal classes, unlabelled grasps and touch groups within a material."""
    counts = draw(st.lists(st.integers(4, 9), min_size=1, max_size=4))
    material, group = [], []
    for kind, count in enumerate(counts):
        for unit in range(count):
            touches = draw(st.integers(1, 3))
            material += [f"m{kind}"] * touches
            group += [f"p{kind}-{unit}" if touches > 1 else ""] * touches
    blank = draw(st.integers(0, 3))
    material, group = material + [""] * blank, group + [""] * blank
    order = draw(st.permutations(range(len(material))))
    return record([material[i] for i in order], touch_group=[group[i] for i in order])


def check_apart(grasps, train, test):
    """Assert that no grasp, no touch group and no unlabelled grasp is on both sides or on either."""
    assert np.intersect1d(train, test).size == 0
    assert train.size
    assert test.size
    assert (np.diff(train) > 0).all()
    assert (np.diff(test) > 0).all()
    group = grasps["touch_group"].values if "touch_group" in grasps else np.full(grasps.sizes["grasp"], "")
    assert not (set(group[train]) & set(group[test])) - {""}
    both = np.concatenate([train, test])
    assert (grasps["material"].values[both] != "").all()


@settings(max_examples=60, deadline=None)
@given(records(), st.integers(1, 3), st.integers(0, 5))
def test_random_splits_never_overlap_and_use_every_labelled_grasp(grasps, train_per_class, seed):
    for train, test in by_grasp(grasps, train_per_class=train_per_class, repeats=3, seed=seed):
        check_apart(grasps, train, test)
        assert train.size + test.size == (grasps["material"].values != "").sum()
        material, group = grasps["material"].values, grasps["touch_group"].values
        for name in set(material) - {""}:
            chosen = train[material[train] == name]
            units = {group[i] or f"alone-{i}" for i in chosen}
            assert len(units) == train_per_class


def test_the_same_seed_gives_the_same_splits_and_another_does_not():
    grasps = load_example_grasps()["exp1A_obj43_grip23"]
    first, again = list(by_grasp(grasps, seed=1)), list(by_grasp(grasps, seed=1))
    assert all((a[0] == b[0]).all() for a, b in zip(first, again))
    assert any((a[0] != b[0]).any() for a, b in zip(first, by_grasp(grasps, seed=2)))
    assert any((first[0][0] != train).any() for train, _ in first[1:])


def test_twenty_splits_of_five_a_material_from_seed_0_are_the_default():
    grasps = load_example_grasps()["exp1A_obj43_grip23"]
    found = [train.tolist() for train, _ in by_grasp(grasps)]
    asked = by_grasp(grasps, train_per_class=5, repeats=20, seed=0)
    assert (len(found), len(found[0])) == (20, 25)  # of five materials
    assert found == [train.tolist() for train, _ in asked]


def test_every_grasp_gets_its_turn_in_training():
    grasps = load_example_grasps()["exp2_dT20"]
    counts = np.zeros(grasps.sizes["grasp"])
    for train, _ in by_grasp(grasps, repeats=400):
        counts[train] += 1
    # binomial with p = 5/8: sd 9.7, so 250 +- 5 sd
    assert np.abs(counts - 250).max() < 49


def test_the_shipped_split_is_that_of_the_column():
    for name, grasps in load_example_grasps().items():
        if name.startswith("exp6"):  # materials that are met in the test alone
            with pytest.raises(UserError, match="0 training and 18 test"):
                shipped(grasps)
            continue
        train, test = shipped(grasps)
        check_apart(grasps, train, test)
        assert (grasps["split"].values[train] == "train").all()
        assert (grasps["split"].values[test] == "test").all()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: by_grasp(record(["a"] * 3), train_per_class=3), "3 grasp(s) of a cannot give 3 to train"),
        (lambda: by_grasp(record(["a"] * 3), train_per_class=0), "0 training grasps a material; give"),
        (lambda: by_grasp(record(["", ""]), train_per_class=1), "no grasp has a material"),
        (lambda: by_grasp(record(["a", "b"], touch_group=["p", "p"])), "is in material 'a' and 'b'"),
    ],
)
def test_a_split_that_cannot_be_is_one_line(call, words):
    with pytest.raises(UserError) as fault:
        list(call())
    assert words in str(fault.value)
    assert "made" in str(fault.value) or "0 training" in words


@pytest.mark.parametrize(("part", "counts"), [("test", "0 training and 2"), ("train", "2 training and 0")])
def test_a_part_without_a_grasp_is_no_split(part, counts):
    with pytest.raises(UserError, match=f"made: column split gives {counts} test grasps; write train and"):
        shipped(record(["a", "a"], split=[part] * 2))
    train, test = shipped(record(["a"] * 4, split=["test", "spare", "train", "test"]))
    assert (train.tolist(), test.tolist()) == ([2], [0, 3])


def test_a_shipped_split_that_is_missing_or_leaks_is_refused():
    with pytest.raises(UserError, match="0 training and 0 test"):
        shipped(record(["a", "a"]))
    with pytest.raises(UserError, match="is in split 'test' and 'train'"):
        shipped(record(["a", "a"], split=["train", "test"], touch_group=["p", "p"]))
