"""What users import is documented in full: every argument, units, what is returned and raised, an example."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import textwrap
from dataclasses import is_dataclass
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from thermogrip import classify, datasets, mpc, rig, sysid

ROOMS = ("datasets", "sysid", "mpc", "rig", "classify")
FOLDERS = ("sysid.export",)  # folders whose exports are for users as well
METHODS = (  # of the Python contract
    *("sysid.Plant.load", "sysid.Plant.simulate", "mpc.Controller.load"),
    *("mpc.Controller.reset", "mpc.Controller.step"),
)
SECTIONS = ("Parameters", "Attributes", "Returns", "Yields", "Raises", "Examples", "Notes", "References")
#: Words that take the place of a unit in brackets.
NO_UNIT = re.compile(
    r"\[[^\]]+\]|\b(seconds?|minutes|hours|degC|kelvin|units?|percent|share|probability|factor|level|ratio"
    r"|number|count|weight|times|multiple|as for|see|scale|confidence|correlation|fraction)\b",
    re.IGNORECASE,
)


def doors() -> list[str]:
    """Return every exported function and class, and the methods of the contract, by dotted name."""
    found = []
    for room in (*ROOMS, *FOLDERS):
        module = importlib.import_module(f"thermogrip.{room}")
        for name in module.__all__:
            item = getattr(module, name)
            if (inspect.isfunction(item) or inspect.isclass(item)) and not _is_record(item):
                found.append(f"{room}.{name}")
    return [*found, *METHODS]


def _is_record(item: Any) -> bool:
    """Say whether this is another package's class, or an exception with nothing but its message."""
    return not item.__module__.startswith("thermogrip") or (
        inspect.isclass(item) and issubclass(item, Exception)
    )


def _door(name: str) -> Any:
    room = next(r for r in sorted((*ROOMS, *FOLDERS), key=len, reverse=True) if name.startswith(f"{r}."))
    item: Any = importlib.import_module(f"thermogrip.{room}")
    for part in name.removeprefix(f"{room}.").split("."):
        item = getattr(item, part)
    return item


def sections(item: Any) -> dict[str, str]:
    """Return a docstring's sections by title."""
    text = inspect.getdoc(item) or ""
    parts = re.split(rf"^({'|'.join(SECTIONS)})\n-+\n", text, flags=re.MULTILINE)
    return {"": parts[0]} | dict(zip(parts[1::2], parts[2::2]))


def described(section: str) -> dict[str, str]:
    """Return what a section says of each name, its type among it."""
    out: dict[str, str] = {}
    names: list[str] = []
    for line in section.splitlines():
        if re.match(r"[\w*]", line):
            head, _, kind = line.partition(" : ")
            names = [name.strip(" *") for name in head.split(",")]
            out |= dict.fromkeys(names, kind)
        else:
            out |= {name: f"{out[name]} {line.strip()}" for name in names}
    return out


def lacks(item: Any) -> set[str]:
    """Return what the docstring of a function or class lacks."""
    found, out = sections(item), set()
    arguments = {} if _is_protocol(item) else dict(inspect.signature(item).parameters)
    documented = described(found.get("Parameters", "") + "\n" + found.get("Attributes", ""))
    for name, parameter in arguments.items():
        if name == "self" or parameter.kind is parameter.VAR_KEYWORD:
            continue
        if name not in documented:
            out.add(f"argument {name}")
        elif _is_quantity(parameter) and not NO_UNIT.search(documented[name]):
            out.add(f"unit of {name}")
    if inspect.isfunction(item) or inspect.ismethod(item):
        returned = inspect.signature(item).return_annotation
        said = {"Returns", "Yields"} & set(found) or "return" in found[
            ""
        ].lower()  # the sentence may say what
        if returned not in ("None", None) and not said:
            out.add("Returns")
        if "Raises" not in found and _raises(item):
            out.add("Raises")
    if ">>>" not in (inspect.getdoc(item) or "") and not is_dataclass(item) and not _is_protocol(item):
        out.add("Examples")  # a record is shown by what returns it
    return out


def _is_protocol(item: Any) -> bool:
    return bool(getattr(item, "_is_protocol", False))


def _is_quantity(parameter: inspect.Parameter) -> bool:
    kind = str(parameter.annotation)
    return re.fullmatch(r"(float|ArrayLike|Array|Floats)( \| None)?", kind) is not None


def _raises(function: Any) -> bool:
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    return any(isinstance(node, ast.Raise) and node.exc is not None for node in ast.walk(tree))


STUBS = sorted(Path(str(sysid.__file__)).parent.glob("**/__init__.pyi"))


def test_what_a_stub_names_is_loaded_and_listed_and_nothing_else() -> None:
    assert len(STUBS) == 8
    for stub in STUBS:
        folder = ".".join(stub.parent.relative_to(Path(str(sysid.__file__)).parent).parts)
        package = importlib.import_module(f"thermogrip.sysid.{folder}".rstrip("."))
        lines = stub.read_text(encoding="utf-8").splitlines()
        names = sorted(line.split(" as ")[1] for line in lines if line.startswith("from"))
        assert names == package.__all__ == dir(package)
        assert all(getattr(package, name) is not None for name in names)
        with pytest.raises(AttributeError, match=f"module '{package.__name__}' has no attribute 'nothing'"):
            package.nothing  # noqa: B018


@pytest.mark.parametrize("package", [classify, datasets, mpc, rig])
def test_a_door_of_an_older_version_is_found_and_not_listed(package: ModuleType) -> None:
    stub = Path(str(package.__file__)).with_suffix(".pyi").read_text(encoding="utf-8")
    names = [line.split(" as ")[1] for line in stub.splitlines() if line.startswith("    from")]
    assert names
    for name in names:
        assert getattr(package, name) is not None
        assert name not in package.__all__


@pytest.mark.parametrize("name", doors())
def test_a_door_is_documented_in_full(name: str) -> None:
    assert lacks(_door(name)) == set()


BENCHMARKS = sorted((Path(__file__).parents[1] / "benchmarks").glob("*/*.py"))


@pytest.mark.parametrize("file", BENCHMARKS, ids=lambda file: f"{file.parent.name}/{file.stem}")
def test_what_a_benchmark_imports_of_us_exists(file: Path) -> None:
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("thermogrip"):
            module = importlib.import_module(str(node.module))
            for alias in node.names:
                folder = getattr(module, "__path__", None) and f"{node.module}.{alias.name}"
                assert hasattr(module, alias.name) or (folder and find_spec(folder)), alias.name
