"""What ``mkdocs build`` adds to ``docs/``: README, CHANGELOG, every verb's help, public doors, notebooks.

Nothing is kept twice: the home page is README, the reference is read from the program, notebooks are run.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
ROOMS = ("datasets", "sysid", "mpc", "rig", "classify")
#: Pages of the site that are files outside of docs/.
PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "VISION.md": "vision.md",
    "SECURITY.md": "security.md",
    "examples/README.md": "examples.md",
    "CITATION.cff": "CITATION.cff",
}
NOTEBOOKS = ROOT / "build" / "notebooks"


def on_startup(command: str, dirty: bool) -> None:
    """Lay the rooms out as the package, for the tool that reads docstrings from the sources."""
    package = Path(tempfile.mkdtemp()) / "thermogrip"
    package.mkdir()
    for path in (ROOT / "src" / "thermogrip").iterdir():
        (package / path.name).symlink_to(path)
    for room in ROOMS:
        (package / room).symlink_to(ROOT / room)
    sys.path.insert(0, str(package.parent))


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that lie outside of docs/, and the notebooks as they ran."""
    from mkdocs.structure.files import File

    for source, page in PAGES.items():
        files.append(File.generated(config, page, content=moved((ROOT / source).read_text(encoding="utf-8"))))
    sources = sorted((ROOT / "notebooks").glob("*.py"))
    if missing := [path.stem for path in sources if not (NOTEBOOKS / f"{path.stem}.md").is_file()]:
        raise SystemExit(f"not run yet: {', '.join(missing)}; python .ci/notebooks.py")
    for path in sorted(NOTEBOOKS.iterdir()):
        files.append(File.generated(config, f"notebooks/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Fill in what a page takes from the program."""
    if page.file.src_uri == "reference/cli.md":
        return markdown + "\n" + help_of_verbs()
    return re.sub(r"<!-- doors of thermogrip\.(\w+) -->", lambda found: doors(found[1]), markdown)


def moved(text: str) -> str:
    """Return a page with its links as they are from the top of the site."""
    for source, page in PAGES.items():
        text = text.replace(f"]({source}", f"]({page}")
    return text.replace("](docs/", "](").replace("](notebooks)", "](notebooks/identify.md)")


def doors(room: str) -> str:
    """Return what documents every name that a room exports."""
    module = importlib.import_module(f"thermogrip.{room}")
    ours = {name: getattr(getattr(module, name), "__module__", "") for name in module.__all__}
    documented = [name for name, home in ours.items() if home.startswith("thermogrip.")]
    others = [f"`{name}`" for name in ours if name not in documented]
    also = f"Beside these: {', '.join(others)}.\n\n" if others else ""
    return also + "\n\n".join(f"::: {ours[name]}.{name}" for name in documented)


def help_of_verbs() -> str:
    """Return what ``thermogrip VERB --help`` prints, a section a verb."""
    from thermogrip.cli.main import main
    from thermogrip.cli.verbs import VERBS

    os.environ["COLUMNS"] = "100"
    parts = []
    for verb in VERBS:
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            main([verb, "--help"])
        text = re.sub(r"\n  (?:--seed N|--json|-h, --help) .*(?:\n {20,}.*)*", "", out.getvalue().rstrip())
        lines = "\n".join(line.rstrip() for line in text.splitlines())
        parts.append(f"## {verb}\n\n```text\n{lines}\n```\n")
    return "\n".join(parts)
