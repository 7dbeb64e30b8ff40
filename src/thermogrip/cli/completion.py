"""What the shell completes in a place of the command line: names that it takes, and files of its kind.

A place is known by its option and by what it is called in the help, as in :mod:`thermogrip.cli.kinds`.  Where
nothing fits, nothing is offered, and the shell completes files as it always does.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable

from thermogrip.cli.kinds import BOTH, TAKES, kind_of

#: Candidate models of identify.
MODELS = ("arx", "oe", "armax", "bj", "subspace", "parsim", "sindy", "neural", "network")
#: What a rig on a port may speak.
PROTOCOLS = ("thermogrip", "tclab")


def completer(option: str, metavar: str) -> Callable[[str], list[str]]:
    """Return what completes the value of an option, or of an argument (whose option is "")."""
    choices = metavar.split("|") if metavar.islower() and "|" in metavar else []
    names = (lambda: choices) if choices else _NAMES.get(option or metavar, tuple)
    several = option in ("--models", "--classifiers", "--materials")

    def complete(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",") if several else ("", "", incomplete)
        named = [before + comma + name for name in names() if name.startswith(last)]
        return named + _files(TAKES.get(metavar, ""), incomplete)

    return complete


def _files(kind: str, incomplete: str) -> list[str]:
    """Return the files of a kind whose path begins so."""
    folder, slash, last = incomplete.rpartition("/")
    if not kind or not os.path.isdir(place := folder + slash or "."):
        return []
    paths = [folder + slash + name for name in sorted(os.listdir(place)) if name.startswith(last)]
    found = {path: kind_of(path) for path in paths}
    return [path for path in paths if found[path] == kind or {found[path], kind} in BOTH]


def _networks() -> Iterable[str]:
    from thermogrip.sysid.models.network_spec import builtin_networks

    return builtin_networks()


def _classifiers() -> Iterable[str]:
    from thermogrip.classify.estimators import CLASSIFIERS

    return CLASSIFIERS


def _materials() -> Iterable[str]:
    from thermogrip.datasets.materials import load_materials

    return [name for name in load_materials() if " " not in name]  # which shells would take apart


_NAMES: dict[str, Callable[[], Iterable[str]]] = {
    "--network": lambda: (*_networks(), "none"),
    "--like": _networks,
    "--models": lambda: MODELS,
    "--classifier": _classifiers,
    "--classifiers": _classifiers,
    "--material": _materials,
    "--materials": _materials,
    "[NAME]": _materials,
    "--protocol": lambda: PROTOCOLS,
}
