"""Build the sdist and the wheel of the checkout in OUT, the same to the last byte wherever it is run.

    SOURCE_DATE_EPOCH=... python .ci/build.py OUT       with setuptools of constraints.txt

setuptools stamps an sdist with the time of its building; here every member has the time of SOURCE_DATE_EPOCH.
"""

import contextlib
import gzip
import io
import os
import shutil
import sys
import tarfile
from pathlib import Path

from setuptools import build_meta


def main(out: Path) -> None:
    """Build both, from nothing."""
    out.mkdir(parents=True, exist_ok=True)
    with contextlib.redirect_stdout(io.StringIO()):
        for build in (build_meta.build_sdist, build_meta.build_wheel):
            shutil.rmtree("build", ignore_errors=True)
            shutil.rmtree("thermogrip.egg-info", ignore_errors=True)
            name = build(str(out))
            if name.endswith(".tar.gz"):
                stamp(out / name, int(os.environ["SOURCE_DATE_EPOCH"]))


def stamp(path: Path, when: int) -> None:
    """Pack an sdist again: members in order, of one time and nobody's."""
    packed = io.BytesIO()
    with tarfile.open(path) as old, tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as new:
        for member in sorted(old.getmembers(), key=lambda member: member.name):
            content = old.extractfile(member)
            member.mtime, member.pax_headers = when, {}
            member.uid = member.gid = 0
            member.uname = member.gname = ""
            member.mode = 0o755 if member.isdir() else 0o644
            new.addfile(member, content)
    path.write_bytes(gzip.compress(packed.getvalue(), mtime=when))


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
