"""C files to a shared library: built once, found again.

A library lies in the user's cache directory, named by the hash of all that went into it: sources, flags, and
what the compiler says of the machine.  The same files are found there; anything else is built beside them.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from thermogrip.mpc.native.codegen import ModelCode

#: The C files that every export shares.
SOURCES = ("tg_qp.h", "tg_qp.c", "tg_controller.h", "tg_controller.c", "tg_observer.c", "tg_optimiser.c")

# sums may be done in any order and pairs of operations at once; NaN keeps its meaning
_FLAGS = (
    "-std=c99",
    "-O3",
    "-march=native",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-signed-zeros",
    "-fassociative-math",
    "-ffp-contract=fast",
    "-fPIC",
    "-shared",
)


def compiler() -> str | None:
    """Return the path of gcc, None where there is none."""
    return shutil.which("gcc")


def wanted() -> bool:
    """Return whether compiled code is to be used: gcc is there, and nobody said no."""
    return os.environ.get("THERMOGRIP_COMPILED", "1") != "0" and compiler() is not None


def c_source(name: str) -> str:
    """Return a C file of the package."""
    return (resources.files("thermogrip.mpc.native") / "csource" / name).read_text(encoding="utf-8")


def model_header(code: ModelCode, name: str) -> str:
    """Return the header of a model's C, which C++ may include."""
    guard = f"{name.upper()}_H"
    begin, end = '#ifdef __cplusplus\nextern "C" {\n#endif\n', "#ifdef __cplusplus\n}\n#endif\n"
    return f"#ifndef {guard}\n#define {guard}\n\n{begin}\n{code.header}\n{end}\n#endif\n"


def model_source(code: ModelCode, name: str) -> str:
    """Return a model's C file."""
    return f'#include "{name}.h"\n\n#include <math.h>\n\n{code.source}'


def build_library(files: dict[str, str]) -> Path:
    """Return a shared library of these C files, from the cache where it was built before; a RuntimeError
    has the first words of a compiler that refuses.
    """
    gcc = compiler()
    if gcc is None:
        raise RuntimeError("no gcc")
    text = "\n".join(f"{name}\n{content}" for name, content in sorted(files.items()))
    key = hashlib.sha256("\n".join([*_FLAGS, _machine(gcc), text]).encode()).hexdigest()[:32]
    path = _cache() / f"mpc-{key}.so"
    if path.is_file():
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        for name, content in files.items():
            (Path(folder) / name).write_text(content, encoding="utf-8")
        units = [name for name in files if name.endswith(".c")]
        command = [gcc, *_FLAGS, *units, "-lm", "-o", "built.so"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"gcc refused: {done.stderr.strip()[:300]}")
        os.replace(Path(folder) / "built.so", path)  # whole, or not there
    return path


def _cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "thermogrip"


@cache
def _machine(gcc: str) -> str:
    """Return what the compiler says of itself and of this machine."""
    command = [gcc, "-march=native", "-dM", "-E", "-x", "c", os.devnull]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout
