"""A run that must be whole has no skip but those that are allowed, each with its reason."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

MODULES = {
    "test_gcc.py": "import pytest\n@pytest.mark.skipif(True, reason='no gcc here')\ndef test_c(): pass\n",
    "test_body.py": "import pytest\ndef test_cxx(): pytest.skip('no g++ on this computer')\n",
    "test_door.py": "import pytest\npytest.importorskip('not_a_package')\ndef test_it(): pass\n",
    "test_data.py": "import pytest\ndef test_d(): pytest.skip('no measurements of other labs in /x')\n",
    "test_known.py": "import pytest\n@pytest.mark.xfail(strict=True)\ndef test_x(): assert False\n",
}


@pytest.mark.parametrize(
    ("skips", "counts", "shared"),
    [("listed", "1 failed, 1 skipped, 1 xfailed, 2 errors", ["-n", "1"]), ("", "4 skipped, 1 xfailed", [])],
    ids=["listed", "any"],
)
def test_a_skip_that_is_not_allowed_is_a_failure(
    tmp_path: Path, skips: str, counts: str, shared: list[str]
) -> None:
    shutil.copy(Path(__file__).with_name("conftest.py"), tmp_path)
    for name, text in MODULES.items():
        (tmp_path / name).write_text(text)
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *shared]
    done = subprocess.run(
        [*words, "--continue-on-collection-errors"], cwd=tmp_path, capture_output=True, text=True,
        env=os.environ | {"THERMOGRIP_SKIPS": skips}, check=False,
    )  # fmt: skip
    assert counts in done.stdout
    assert ("unexpected skip: no gcc here; install what is missing" in done.stdout) == bool(skips)
