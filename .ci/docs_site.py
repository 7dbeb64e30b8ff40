"""What ``mkdocs build`` adds to ``docs/``: README, CHANGELOG and their like, and notebooks as they ran."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
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
#: What tells how something came to be answers no question on how to use it.
NOT_SEARCHED = ("records/", "decisions/", "changelog.md")


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


def on_page_markdown(_markdown: str, page: Page, **_: object) -> None:
    """Leave pages of the past out of the site's search."""
    if page.file.src_uri.startswith(NOT_SEARCHED):
        page.meta["search"] = {"exclude": True}


def moved(text: str) -> str:
    """Return a page with its links as they are from the top of the site."""
    for source, page in PAGES.items():
        text = text.replace(f"]({source}", f"]({page}")
    return text.replace("](docs/", "](").replace("](notebooks)", "](notebooks/identify.md)")
