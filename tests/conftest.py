"""Before any test: one thread for linear algebra, whose matrices are small; the same examples in each run.

What is collected stays to the end, so Python's collector of garbage need not look through it again and again:
that was a third of the collection's time and a seventh of the tests'.  Compiled modules are kept, which every
process that a test starts imports.

And Ctrl-C: a shell that starts the tests in the background has them ignore it, and so would the programs that
they start.

Where ``THERMOGRIP_SKIPS`` is ``listed``, as in ``.ci/run``, a skip that is not among ``ALLOWED_SKIPS`` is a
failure: a missing compiler or package must not take hundreds of tests out of a green run.
"""

from __future__ import annotations

import gc
import os
import re
import shutil
import signal
import sys
from collections.abc import Generator
from typing import Any

import pytest
from hypothesis import settings
from threadpoolctl import threadpool_limits

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
if "numpy" in sys.modules:  # a plugin of another package imported it, which has read them already
    threadpool_limits(1)
for _name in ("FORCE_COLOR", "NO_COLOR", "COLUMNS"):  # what a program shows is not what this terminal wishes
    os.environ.pop(_name, None)

sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
gc.disable()  # until all tests are collected

settings.register_profile("steady", derandomize=True, deadline=None)
settings.load_profile("steady")

#: What a skip may say (from its beginning), and why no machine that runs everything is asked for it.
ALLOWED_SKIPS = {
    r"no measurements of other labs": "they are not ours to hand out",
    r"not installed: ": "a compiler and a simulator of Arduino's chips, of the distribution",
    r"(no mkfs|no mount on|nothing may be mounted)": "a small disk to fill needs an administrator's rights",
    r"needs POSIX and two processors": "one core shares no work",
    r"no browser: ": "the distribution's chromium, which `.ci/run` installs where it may",
}


@pytest.fixture(scope="session")
def chromium() -> Generator[Any, None, None]:
    """Return a browser without a window."""
    playwright = pytest.importorskip("playwright.sync_api", reason="no browser: playwright is not installed")
    program = next(filter(None, map(shutil.which, ("chromium", "google-chrome"))), None)
    if program is None:
        pytest.skip("no browser: chromium is not installed")
    flags = (
        "--no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
        "--disable-component-update --disable-sync"
    )
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=program, args=flags.split())
        yield browser
        browser.close()


def pytest_collection_finish() -> None:
    """Look for garbage again, in what the tests make, and not after each 700 objects."""
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
    gc.enable()


def unexpected_skip(reason: str) -> str:
    """Return what to say of a skip for this reason; empty where it may be."""
    listed = os.environ.get("THERMOGRIP_SKIPS") == "listed"
    reason = reason.removeprefix("Skipped: ")
    if not listed or any(re.match(pattern, reason) for pattern in ALLOWED_SKIPS):
        return ""
    return f"unexpected skip: {reason}; install what is missing, or allow it in tests/conftest.py"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Make an unexpected skip of a test a failure."""
    report = yield
    if report.skipped and not hasattr(report, "wasxfail") and isinstance(report.longrepr, tuple):
        _fail(report, report.longrepr)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Make an unexpected skip of a module a failure."""
    report = yield
    if report.skipped and isinstance(report.longrepr, tuple):
        _fail(report, report.longrepr)
    return report


def _fail(report: pytest.TestReport | pytest.CollectReport, where: tuple[str, int, str]) -> None:
    if words := unexpected_skip(where[2]):
        report.outcome, report.longrepr = "failed", f"{where[0]}:{where[1]}: {words}"


if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
