"""The compiled code of a kernel, kept so that it runs before its compiler is imported.

Numba takes longer to be imported, and to look at its own cache, than a grasp to be answered.  What it has
compiled of a kernel is an object file, which refers to the C library and, where it is called from Python, to
Numba; the part that computes refers to the C library alone.  So the object file is kept once, with the types
of its arguments, and the next program links it by llvmlite and calls that part.  It does so only with the
same sources of all kernels, versions and processor, arguments of the same types, and a file whose digest is
right; otherwise Numba is asked, as it is on a computer other than Linux.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import platform
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

from llvmlite import binding

from thermogrip.datasets.atomic_files import write_atomic
from thermogrip.datasets.code_cache import code_cache

_LONGEST = 4 << 20  # bytes of a file
_STATUS_OK = 0
#: What of numba's the part that computes may call: for arrays that it has not made they do nothing.
_COUNTS = ("NRT_incref", "NRT_decref")
_LIBRARY = ("acos", "asin", "atan", "atan2", "cos", "cosh", "exp", "expm1", "fmod", "log", "log1p", "memcpy",
            "memset", "pow", "sin", "sinh", "sqrt", "tan", "tanh")  # fmt: skip
#: Versions of numba whose calling convention this is; it is nobody's promise.
_TRIED = ("0.63.",)
#: What must be as when the code was compiled, beside the sources of the kernels.
_OWN_SETTINGS = ("NUMBA_CACHE_DIR", "NUMBA_NUM_THREADS")

_engines: list[Any] = []  # code lives as long as what linked it


def possible() -> bool:
    """Return whether this process may link kept code: on Linux, with a numba that was tried, as it comes."""
    others = [name for name in os.environ if name.startswith("NUMBA_") and name not in _OWN_SETTINGS]
    here = sys.platform == "linux" and platform.machine() in ("x86_64", "aarch64")
    return here and not others and version("numba").startswith(_TRIED)


def folders(source: Path) -> list[Path]:
    """Return where the code of a module's kernels is kept: the first of these that can be written."""
    if own := os.environ.get("NUMBA_CACHE_DIR"):
        return [Path(own, "thermogrip")]
    return [source.parent / "__pycache__", code_cache()]


def keep(overload: Any, file: str, source: Path, digest: str) -> bool:
    """Write what numba has just compiled of a kernel; return whether it could be kept."""
    arguments = [_argument(kind) for kind in overload.signature.args]
    library, symbol = overload.library, overload.fndesc.llvm_func_name
    if None in arguments or str(overload.signature.return_type) != "none":
        return False
    module = library._final_module
    called = set(re.findall(r'call [^@\n]*@"?([\w.$]+)"?\(', str(module.get_function(symbol))))
    if not all(name in (*_COUNTS, *_LIBRARY) or name.startswith("llvm.") for name in called):
        return False
    elsewhere = [f.name for f in module.functions if f.is_declaration and not f.name.startswith("llvm.")]
    elsewhere += [v.name for v in module.global_variables if v.is_declaration]
    code = library._get_compiled_object()
    head = _made_by(digest) | {"arguments": arguments, "symbol": symbol, "elsewhere": sorted(elsewhere)}
    head["sha256"] = hashlib.sha256(code).hexdigest()
    for folder in folders(source):
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            write_atomic(folder / file, json.dumps(head).encode() + b"\n" + code)
            return True
    return False


def linked(file: str, source: Path, digest: str) -> Callable[..., bool] | None:
    """Return what runs a kept kernel, None where there is none for this process.

    It returns whether the arguments were of its types, and does nothing where they were not.
    """
    for folder in folders(source):
        with suppress(OSError, ValueError, KeyError, RuntimeError):
            path = folder / file
            if path.stat().st_size > _LONGEST:
                continue
            first, _, code = path.read_bytes().partition(b"\n")
            head = json.loads(first)
            sound = head["sha256"] == hashlib.sha256(code).hexdigest()
            if sound and _made_by(digest).items() <= head.items():
                return _called(_address(code, head["symbol"], head["elsewhere"]), head["arguments"])
    return None


def _made_by(digest: str) -> dict[str, Any]:
    """Return what code must have been made by to run here."""
    cpu = [binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()]
    versions = [version(name) for name in ("numba", "llvmlite")]
    return {"sources": digest, "cpu": cpu, "versions": versions, "python": list(sys.version_info[:2])}


def _argument(kind: Any) -> list[Any] | None:
    """Return what an argument of a signature is: a number, or an array of a type and a number of dimensions;
    None where it is neither, or its rows may lie elsewhere."""
    if str(kind) == "float64":
        return ["float64", -1]
    if getattr(kind, "layout", "") == "C" and kind.mutable and kind.aligned:
        return [str(kind.dtype), int(kind.ndim)]
    return None


def _address(code: bytes, symbol: str, elsewhere: list[str]) -> int:
    """Return where a function of an object file is once it is linked."""
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    target = binding.Target.from_triple(binding.get_process_triple())
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), target.create_target_machine())
    for name in elsewhere:
        if not binding.address_of_symbol(
            name
        ):  # of numba: where it is not called from Python, nothing calls it
            if not name.startswith(("NRT_", "numba_")):
                raise ValueError(f"no {name}")
            binding.add_symbol(name, ctypes.cast(ctypes.CDLL(None).abort, ctypes.c_void_p).value)
    engine.add_object_file(binding.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _engines.append(engine)
    address = int(engine.get_function_address(symbol))
    if not address:
        raise ValueError(f"no {symbol}")
    return address


def _called(address: int, arguments: list[list[Any]]) -> Callable[..., bool]:
    """Return a call of numba's own convention: the places of the result and of a fault, and of each array two
    owners, its sizes, its data, shape and strides, one by one."""
    place, whole = ctypes.c_void_p, ctypes.c_ssize_t
    kinds: list[Any] = [place, place]
    for _, n_dim in arguments:
        array = [place, place, whole, whole, place, *[whole] * (2 * n_dim)]
        kinds += [ctypes.c_double] if n_dim < 0 else array
    function = ctypes.PYFUNCTYPE(ctypes.c_int, *kinds)(address)
    result, fault = (place * 1)(), (place * 1)()

    def call(*given: Any) -> bool:
        flat: list[Any] = [ctypes.addressof(result), ctypes.addressof(fault)]
        for (kind, n_dim), value in zip(arguments, given, strict=True):
            if n_dim < 0:
                flat.append(float(value))
                continue
            if value.dtype.name != kind or value.ndim != n_dim or not value.flags.carray:
                return False
            flat += (None, None, value.size, value.itemsize, value.ctypes.data, *value.shape, *value.strides)
        if function(*flat) != _STATUS_OK:
            raise RuntimeError("a kernel failed")
        return True

    return call
