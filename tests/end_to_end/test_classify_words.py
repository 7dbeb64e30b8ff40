"""What classify says of many grasps: one line a note, and the cheaper answer."""

from __future__ import annotations

import pytest

from thermogrip.cli.classify import SHOWN, _answer_or_unknown, _say_notes
from thermogrip.report.console import Console


@pytest.mark.parametrize(("n", "more"), [(1, ""), (SHOWN, ""), (SHOWN + 1, " and 1 more")])
def test_grasps_of_one_note_are_named_in_one_line_up_to_a_number(
    n: int, more: str, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [{"grasp_id": f"g{k}", "material": "", "note": "no contact"} for k in range(n)]
    said = {"grasp_id": "h", "material": "wood", "note": "short"}
    _say_notes(Console(), [*rows, said, {"grasp_id": "i", "material": "wood", "note": ""}])
    names = ", ".join(f"g{k}" for k in range(min(n, SHOWN)))
    assert capsys.readouterr().out == f"no contact, so no name: {names}{more}\nshort: h\n"


def test_the_cheaper_answer_is_the_likeliest_candidate_or_unknown() -> None:
    rows = [
        {"p_iron": 0.9, "p_wood": 0.1, "p_unknown": 0.05},
        {"p_iron": 0.1, "p_wood": 0.9, "p_unknown": 0.05},
        {"p_iron": 0.9, "p_wood": 0.1, "p_unknown": 0.95},
        {"p_iron": None, "p_wood": None, "p_unknown": None},
    ]
    _answer_or_unknown(rows)
    assert [row["answer"] for row in rows] == ["iron", "wood", "unknown", "unknown"]
