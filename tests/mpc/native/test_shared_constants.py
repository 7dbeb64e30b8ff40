"""A number that Python and C share is written once, in Python, and every build of the C has it."""

from __future__ import annotations

import ast
import re
from contextlib import suppress
from pathlib import Path

import pytest

from thermogrip.mpc.native import design_struct, shared_constants
from thermogrip.mpc.native.shared_constants import shared_definitions
from thermogrip.mpc.optimiser import rti

MPC = Path(str(design_struct.__file__)).parents[1]
SOURCES = sorted((MPC / "native" / "csource").glob("tg_*.[ch]"))
NUMBER = re.compile(r"^#define (?:TG_)?(\w+)[ ]+\(?(-?[\d.]+(?:e-?\d+)?)\)?(?:\s|$)", re.MULTILINE)


def in_python() -> set[tuple[str, float]]:
    """Return names, without a leading underscore, and values of numbers at the top of modules of ``mpc``."""
    out: set[tuple[str, float]] = set()
    for path in MPC.rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if not isinstance(node, ast.Assign):
                continue
            names = [n.id for target in node.targets for n in ast.walk(target) if isinstance(n, ast.Name)]
            values = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
            for name, value in zip(names, values):
                with suppress(ValueError, TypeError):
                    out.add((name.lstrip("_"), float(ast.literal_eval(value))))
    return out


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.name)
def test_no_number_of_python_is_written_into_c(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    found = {(name, float(value)) for name, value in NUMBER.findall(text)}
    assert not found & in_python()
    assert not {name for name, _ in found} & shared_constants.shared_constants().keys()


def test_every_shared_constant_is_used_in_c() -> None:
    text = "".join(path.read_text(encoding="utf-8") for path in SOURCES)
    lost = {name for name in shared_constants.shared_constants() if not re.search(rf"\bTG_{name}\b", text)}
    assert not lost


def test_another_value_is_another_header(monkeypatch: pytest.MonkeyPatch) -> None:
    # which is hashed into the name of a compiled library
    before = shared_definitions()
    monkeypatch.setattr(rti, "SAFE", 0.8)
    changed = set(shared_definitions()) - set(before)
    assert changed == {"#define TG_SAFE 0.8"}
    assert "#define TG_SHARES {0.5, 0.25, 0.1, 0.0}" in before
