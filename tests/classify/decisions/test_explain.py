"""Why a grasp looks like no known material: the one thing that was changed is the one that is named."""

from __future__ import annotations

import pytest

from thermogrip.classify import classify_grasps, make_classifier, reasons
from thermogrip.classify.decisions.explain import strain_words, strains
from thermogrip.classify.estimators.posterior import PosteriorClassifier
from thermogrip.datasets.examples import load_example_grasps
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity.gripper_model import GripperModel, load_default_gripper

from ...sysid.effusivity.makers import simulated_blocks

FIVE = ["brass", "copper", "iron", "wood", "zinc"]


@pytest.fixture(scope="module")
def device() -> GripperModel:
    return load_default_gripper()


def drawn(device: GripperModel, *, ln_h: float = 0.0, ln_e: float = 0.0, n: int = 12) -> Grasps:
    block = device.blocks["iron"]
    return simulated_blocks(
        device,
        ln_e=[block.ln_effusivity + ln_e] * n,
        ln_h=[block.ln_h + ln_h] * n,
        ln_rho_c=[15.088] * n,
        t_gripper=43.0,
        t_object=23.0,
        material=["iron"] * n,
        seed=5,
    )[0]


def test_usual_grasps_ask_for_nothing_unusual(device: GripperModel) -> None:
    rows = strains(device, drawn(device, n=30), ["iron"] * 30)
    assert sum(strain_words("iron", row) != "" for row in rows) <= 2


def test_a_contact_half_as_good_is_named(device: GripperModel) -> None:
    rows = strains(device, drawn(device, ln_h=-0.7), ["iron"] * 12)
    first = [row[0].words for row in rows]
    assert sum("times the usual contact conductance" in words for words in first) >= 11
    assert all("0.4" <= words[:3] <= "0.7" for words in first if "conductance" in words)


@pytest.mark.parametrize(("off", "word"), [(2.5, "colder"), (-2.5, "warmer")])
def test_a_wrong_dial_is_named_with_its_sign(device: GripperModel, off: float, word: str) -> None:
    grasps = drawn(device)
    rows = strains(device, grasps.assign(t_object=grasps["t_object"] + off), ["iron"] * 12)
    assert sum(f"{word} than its dial" in row[0].words for row in rows) >= 11


def test_a_trace_that_no_block_gives_is_named(device: GripperModel) -> None:
    grasps = drawn(device)
    saw = grasps.assign(t_surface=grasps["t_surface"] + 0.5 * (grasps["time"] % 1.0))
    assert all("trace" in row[0].words for row in strains(device, saw, ["iron"] * 12))


def test_reasons_stand_beside_strange_grasps_alone(device: GripperModel) -> None:
    model = PosteriorClassifier().with_device(device)
    files = load_example_grasps()
    known = files["exp1A_obj43_grip23"].isel(grasp=[0, 8, 16])
    cork = files["exp6_other_materials_obj43_grip23"]
    cork = cork.isel(grasp=cork["material"].values == "cork")
    rows = classify_grasps(model, [known, cork], FIVE)
    words = reasons(model, [known, cork], rows)
    assert words[:3] == ["", "", ""]
    assert len(words) == 3 + cork.sizes["grasp"] > 3
    assert all(text.startswith("as wood it needs 0.3") and "effusivity" in text for text in words[3:])


def test_a_classifier_without_physics_gives_no_reasons() -> None:
    record = load_example_grasps()["exp2_dT20"]
    model = make_classifier("features-lda").fit(record)
    rows = classify_grasps(model, record)
    assert set(reasons(model, record, rows)) == {""}
