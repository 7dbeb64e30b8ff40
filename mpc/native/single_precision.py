"""The exported C with numbers of four bytes, for processors that compute no others fast.

The source is written once, in ``double``; here each ``double`` becomes a ``float``, each constant ends in f,
and functions are those of ``tgmath.h``.  Seconds since the start stay eight bytes long (``tg_time``): after
two days a float would count them in sixtieths.  ``TG_SINGLE`` selects the tolerances of the program, whose
theory is in ``csource/tg_qp.c``: a float has a step of 6e-8, so that what keeps the factor of dependent rows
regular is 3e-7 of a row in place of 1e-11, and refinement is repeated where that shows.
"""

from __future__ import annotations

import re

__all__ = ["in_single"]

_TOKEN = re.compile(
    r"(?P<kept>/\*.*?\*/|//[^\n]*|\"(?:\\.|[^\"\\])*\"|typedef double tg_time;)"
    r"|(?P<kind>\bdouble\b)"
    r"|(?P<number>(?<![\w.])(?:\d+\.\d*(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)(?![\w.]))",
    re.DOTALL,
)
_SMALLEST, _LARGEST = 1.2e-38, 3.4e38  # of a float


def in_single(files: dict[str, str]) -> dict[str, str]:
    """Return files of an export, by name, with single numbers; what is no C stays."""
    return {name: _rewritten(name, text) for name, text in files.items()}


def _rewritten(name: str, text: str) -> str:
    if name == "Makefile":
        return text.replace("-Wconversion", "-Wfloat-conversion")
    if name.endswith(".ino"):
        return re.sub(r"\bdouble\b", "float", text)
    if not name.endswith((".c", ".h")):
        return text
    text = _TOKEN.sub(_token, text).replace("#include <math.h>", "#include <tgmath.h>")
    guard = "#define TG_CONFIG_H\n"
    return text.replace(guard, f"{guard}\n#define TG_SINGLE\n") if name == "tg_config.h" else text


def _token(found: re.Match[str]) -> str:
    if found["kind"]:
        return "float"
    if not found["number"]:
        return found[0]
    value = float(found[0])
    if value > _LARGEST:  # in what double numbers alone use, or gcc refuses it
        return found[0]
    return f"{found[0]}f" if value >= _SMALLEST else "0.0f"
