"""CPU time of a call into C, read in C as DAQP's own time is: the way there from Python is not in it, nor
what it takes to read the clock of a thread (0.4 us; DAQP reads one that takes 0.02)."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np

from thermogrip.mpc.native.runtime import build_library

__all__ = ["Stopwatch"]

_SOURCE = """
#define _POSIX_C_SOURCE 200112L
#include <time.h>
typedef int (*pointers)(void *, void *, void *, void *, void *, void *, void *, void *, void *, void *,
                        void *, void *, void *, void *, void *);
typedef void (*step)(void *, double, void *, void *, void *, void *, void *, void *, void *);
static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}
double clock_alone(void)
{
    double least = 1.0;
    for (int i = 0; i < 10000; i++) {
        const double began = now(), took = now() - began;
        least = took < least ? took : least;
    }
    return least;
}
int timed_call(pointers f, double *took, void **p)
{
    const double began = now();
    const int answer = f(p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9], p[10], p[11], p[12],
                         p[13], p[14]);
    *took = now() - began;
    return answer;
}
void timed_step(step f, double *took, void *c, double time_s, void **p)
{
    const double began = now();
    f(c, time_s, p[0], p[1], p[2], p[3], p[4], p[5], p[6]);
    *took = now() - began;
}
"""


class Stopwatch:
    """Calls functions of a library and keeps how long each call took, in ``seconds``."""

    def __init__(self) -> None:
        self._library = ctypes.CDLL(str(build_library({"stopwatch.c": _SOURCE})))
        self._library.clock_alone.restype = ctypes.c_double
        self._alone = float(self._library.clock_alone())
        self._took = np.zeros(1)
        self.seconds: list[float] = []

    def of(self, function: Any) -> Callable[..., int]:
        """Return a function of up to 15 pointers, timed."""
        code, into = self._pointers(function)

        def timed(*arguments: Any) -> int:
            places = (ctypes.c_void_p * 15)(*(_address(item) for item in arguments))
            answer = self._library.timed_call(code, into, places)
            self.seconds.append(float(self._took[0]) - self._alone)
            return int(answer)

        return timed

    def of_step(self, function: Any) -> Callable[..., None]:
        """Return the whole step, timed: the controller, a double, and seven pointers."""
        code, into = self._pointers(function)

        def timed(controller: Any, time_s: Any, *arguments: Any) -> None:
            places = (ctypes.c_void_p * 7)(*(_address(item) for item in arguments))
            self._library.timed_step(code, into, controller, time_s, places)
            self.seconds.append(float(self._took[0]) - self._alone)

        return timed

    def _pointers(self, function: Any) -> tuple[ctypes.c_void_p, ctypes.c_void_p]:
        return ctypes.cast(function, ctypes.c_void_p), ctypes.c_void_p(self._took.ctypes.data)


def _address(item: Any) -> int | None:
    """Return where an argument points."""
    if item is None:
        return None
    if isinstance(item, ctypes.c_void_p):
        return item.value
    return ctypes.cast(item, ctypes.c_void_p).value
