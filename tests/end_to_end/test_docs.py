"""The documents say what the program does: their commands are understood, their links lead somewhere."""

from __future__ import annotations

import ast
import contextlib
import importlib.util
import io
import re
import shlex
import tomllib
from functools import cache
from pathlib import Path

import pytest

from thermogrip import __version__
from thermogrip.cli.main import main
from thermogrip.sysid.models.user_model import load_object

ROOT = Path(__file__).parents[2]
SITE = ROOT / ".ci" / "docs_site.py"


@cache
def help_of(verb: str) -> str:
    """Return what ``thermogrip VERB --help`` prints."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        assert main([verb, "--help"]) == 0, f"no verb {verb}"
    return "\n".join(line.rstrip() for line in out.getvalue().strip().splitlines())


def commands_in(path: Path) -> list[str]:
    """Return the thermogrip command lines in the code blocks of a page."""
    blocks = re.findall(r"```\w*\n(.*?)```", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    found = [
        re.split(r"\s(?:&&|#|;)\s", line.split("thermogrip ", 1)[1])[0]
        for line in lines
        if "thermogrip " in line
    ]
    return [line for line in found if re.match(r"[a-z]+( |$)", line) and not line.startswith("usage")]


PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
WRITTEN_BY_HAND = [page for page in PAGES if page.name != "cli.md" and page.parent.name != "python"]
WRITTEN = [(page, line) for page in WRITTEN_BY_HAND for line in commands_in(page)]
ROOMS = ("datasets", "sysid", "mpc", "rig", "classify")


@pytest.fixture(autouse=True)
def _a_wide_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")


@pytest.mark.parametrize("page", ["cli.md", *(f"python/{room}.md" for room in ROOMS)])
def test_the_reference_is_what_the_program_says(page: str) -> None:
    path = ROOT / "docs" / "reference" / page
    made = load_object(ROOT / ".ci" / "reference.py", "pages")()[path]
    assert path.read_text(encoding="utf-8") == made, "not up to date: run python .ci/reference.py"


def test_every_module_and_folder_of_the_architecture_is_there() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    modules = [path for room in (*ROOMS, "src/thermogrip") for path in (ROOT / room).rglob("*.py")]
    places = {place for path in modules for place in (path, path.parent)}
    names = {path.relative_to(ROOT).as_posix().removeprefix("src/thermogrip/") for path in places}
    rows = re.findall(r"^\| `([\w/]+)/` \|(.*)$", text, flags=re.MULTILINE)
    listed = [(room, name) for room, row in rows for name in re.findall(r"`([\w/]+)`", row)]
    for room, name in listed:
        inside = [place.stem for place in places if place.is_relative_to(ROOT / room)]
        assert name.rstrip("/") in inside, f"{room} has no {name}"
    for name in re.findall(r"`([\w/]+\.py|\w+/[\w/]+/)`", text):
        inside = any(f"/{each}".endswith(f"/{name.rstrip('/')}") for each in names)
        assert inside or (ROOT / name).exists(), f"there is no {name}"
    assert len(listed) > 40


def test_the_menu_of_the_site_has_every_page() -> None:
    menu = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    notebooks = {f"notebooks/{path.stem}.md" for path in (ROOT / "notebooks").glob("*.py")}
    elsewhere = {page for page in load_object(SITE, "PAGES").values() if page.endswith(".md")}
    assert set(re.findall(r"[\w/.-]+\.md", menu)) == pages | notebooks | elsewhere


@pytest.mark.parametrize(("page", "line"), WRITTEN, ids=[f"{p.name}: {line[:60]}" for p, line in WRITTEN])
def test_a_command_in_the_documents_uses_verbs_and_options_that_exist(page: Path, line: str) -> None:
    verb, *words = shlex.split(line)
    for word in words:
        if word.startswith("--"):
            assert word in help_of(verb), f"{page.name}: {verb} has no {word}"
    assert help_of(verb)


@pytest.mark.parametrize("page", PAGES, ids=[page.name for page in PAGES])
def test_links_between_the_documents_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            path, _, heading = target.partition("#")
            where = page.parent / path if path else page
            assert where.exists(), f"{page.name} links to {target}"
            assert not heading or heading in headings(where), f"{page.name}: {path} has no heading {heading}"


def headings(page: Path) -> list[str]:
    """Return the names by which a page's headings are linked to."""
    titles = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return [re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles]


def imports_in(code: str) -> list[tuple[str, str]]:
    """Return (module, name) of what a piece of Python takes from thermogrip; raise where it is no Python."""
    nodes = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.ImportFrom)]
    ours = [node for node in nodes if (node.module or "").split(".")[0] == "thermogrip"]
    return [(str(node.module), alias.name) for node in ours for alias in node.names]


PYTHON = [
    (page, code)
    for page in PAGES
    for code in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL)
]


@pytest.mark.parametrize(("page", "code"), PYTHON, ids=[f"{p.name} {k}" for k, (p, _) in enumerate(PYTHON)])
def test_python_in_the_documents_takes_what_there_is(page: Path, code: str) -> None:
    for module, name in imports_in(code):
        found = importlib.import_module(module)
        submodule = importlib.util.find_spec(f"{module}.{name}") if hasattr(found, "__path__") else None
        assert hasattr(found, name) or submodule, f"{page.name}: {module} has no {name}"


@pytest.mark.parametrize("page", WRITTEN_BY_HAND, ids=[page.name for page in WRITTEN_BY_HAND])
def test_files_and_modules_that_the_documents_name_are_there(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    rooms = "benchmarks|classify|datasets|examples|mpc|rig|src|sysid|tests"
    for name in re.findall(rf"(?<![\w/.-])((?:{rooms})/[\w/.-]+\.(?:py|toml|txt|cpp|h|ino))\b", text):
        assert (ROOT / name).is_file(), f"{page.name} names {name}"
    for name in re.findall(r"`thermogrip((?:\.\w+)+)(?=[`(])", text):
        module, _, last = f"thermogrip{name}".rpartition(".")
        spec = importlib.util.find_spec(f"{module}.{last}") if _is_package(module) else None
        assert spec or hasattr(importlib.import_module(module), last), f"{page.name} names thermogrip{name}"


#: What a module has that starts processes.
STARTS = re.compile(
    r"^\s*(?:import|from) (?:subprocess|pty)\b|ProcessPoolExecutor\(|get_reusable_executor\(|LocalCluster\(|"
    r"multiprocessing.*\b(?:Process|Pool)\b|"
    r"\bos\.(?:system|popen|fork|startfile|(?:exec|spawn|posix_spawn)\w*)\(|create_subprocess_",
    flags=re.MULTILINE,
)


def test_the_security_page_lists_every_module_that_starts_a_process() -> None:
    sources = {
        path: path.read_text("utf-8") for room in (*ROOMS, "src") for path in (ROOT / room).rglob("*.py")
    }
    starting = {path.relative_to(ROOT).as_posix() for path, text in sources.items() if STARTS.search(text)}
    table = (ROOT / "SECURITY.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^\| `([\w/]+\.py)`", table, flags=re.MULTILINE)) == starting


def test_one_version_stands_everywhere() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["version"] == __version__
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    heads = re.findall(r"^## \[(.*?)\]", changes, flags=re.MULTILINE)
    assert next(head for head in heads if head != "Unreleased") == __version__


def test_the_tests_that_are_repeated_with_another_processors_kernels_are_there() -> None:
    for name in (ROOT / ".ci" / "numeric_tests").read_text(encoding="utf-8").split():
        assert (ROOT / name).is_file(), name


def _is_package(module: str) -> bool:
    return hasattr(importlib.import_module(module), "__path__")
