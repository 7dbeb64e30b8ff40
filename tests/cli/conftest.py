"""What the tests of the verbs share: a bench of small files, and stand-ins for what the rooms do."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import import_module
from pkgutil import walk_packages
from types import SimpleNamespace
from typing import Any

import pytest

from tests.end_to_end.conftest import Bench, bench
from thermogrip import classify, mpc, rig, sysid

#: A module that is imported while a stand-in is in place would keep it: all of them are imported before.
for _room in (classify, mpc, rig, sysid):
    for _module in walk_packages(_room.__path__, f"{_room.__name__}."):
        import_module(_module.name)

Calls = list[SimpleNamespace]
StandIn = Callable[..., Calls]


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> StandIn:
    """Return what replaces a function: the stand-in keeps its calls and returns what it is given."""

    def make(place: str, result: Any = None) -> Calls:
        calls: Calls = []

        def called(*args: Any, **options: Any) -> Any:
            calls.append(SimpleNamespace(args=args, **options))
            if isinstance(result, BaseException):
                raise result
            return result(*args, **options) if callable(result) else result

        path, name = place.rsplit(".", 1)
        try:
            owner: Any = import_module(path)  # a package may export a function of a module's name
        except ModuleNotFoundError:
            module, attribute = path.rsplit(".", 1)
            owner = getattr(import_module(module), attribute)
        monkeypatch.setattr(owner, name, called)
        return calls

    return make


def shares(err: str, title: str) -> list[int]:
    """Return the percentages of the lines of progress, in order."""
    return [int(found) for found in re.findall(rf"^{title} +(\d+) %", err, flags=re.MULTILINE)]


def words_of(text: str) -> str:
    """Return printed text with every run of spaces and line breaks as one space."""
    return " ".join(text.split())


__all__ = ["Bench", "Calls", "StandIn", "bench", "shares", "words_of"]
